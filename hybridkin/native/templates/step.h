
enum { @GUARD@_TARGET = @WIDTH@, @GUARD@_ROWS = @TASK@ }; /* lengths of a target, and of its error */

/* State of a controller between two periods. */
typedef struct {
    @REAL@ q[@N@];    /* the present command */
    @REAL@ dq[@N@];   /* the last step; the limit of acceleration refers to it */
    @REAL@ x[@WIDTH@];    /* of the model at the start of the last step, as a target */
    @REAL@ error;   /* distance of that x, or of the measured one, to the target [m] */
    @REAL@ sigma_min, damping; /* smallest singular value of J there (NaN: the robot was held), and
                                 the damping of the step in the same unit (0: none) */
    unsigned char held[@N@]; /* actuators that the step held at a limit of motion */
    unsigned char stopped;   /* whether limits of the tip changed its motion */
    @REAL@ offset[@TASK@]; /* measured minus predicted, by the measurements so far [m] */
    @REAL@ rest[3 + 2 * @TASK@]; /* what the last steps showed of the model, to rest out of reach */
    @REAL@ memory;  /* time constant [s] of the offset without measurements; INFINITY: it stays */
    @REAL@ delay;   /* age [s] of measurements when they come, of at most 63 periods; with time
                       stamps, that of the next one */
    unsigned char rejected;  /* whether the last measurement was not used, as it is not plausible */
    @REAL@ seen[@SEEN@]; /* of measurements, and of x in the last 64 periods */
@LEAD_FIELD@@CLEAR_FIELD@} @NAME@_state;

/* Start at rest at the actuator vector q, as read from the robot@WITHOUT@; sets memory to INFINITY
   and delay to 0. */
void @NAME@_reset(@NAME@_state *state, const @REAL@ *q);

/* One period of @DT@ s: q of the state becomes the next command, within the limits of README.md.

   target: @ABOUT_TARGET@
   dx: velocity of its @TASK@ rows [m/s], may be NULL (at rest);
   measured: measured x, as a target; NULL or NaN: none. One that is older than 63 periods, or of the
   future, counts as none. */
void @NAME@_step(@NAME@_state *state, const @REAL@ *target, const @REAL@ *dx,
    const @REAL@ *measured);
@CLEAR_FUNCTION@