
/* What a controller remembers from one period to the next. */
typedef struct {
    @REAL@ q[@N@];    /* the present command */
    @REAL@ dq[@N@];   /* the last step, from which the limit of acceleration counts */
    @REAL@ x[3];    /* the model's tip where the last step started from [m] */
    @REAL@ error;   /* distance of that tip, or of the measured one, to the target [m] */
    @REAL@ sigma_min, damping; /* smallest singular value of J there (NaN: the step held still), and
                                 the damping of the step in its unit (0: none) */
    unsigned char held[@N@]; /* which actuators the step held at a limit of motion */
    @REAL@ offset[3]; /* of the model's tip at the last reading [m] */
    @REAL@ memory;  /* time constant [s] of the offset while readings are NaN; 0: it is not used */
} @NAME@_state;

/* Start at rest from the actuator vector q, as read from the robot; the memory is 0. */
void @NAME@_reset(@NAME@_state *state, const @REAL@ *q);

/* One period of @DT@ s: q of the state becomes the next command, which is within the limits.

   target: where the tip should be now [m]; dx: its velocity [m/s], may be NULL (at rest);
   measured: the measured tip [m], may be NULL (the model's), NaN where there is no reading. */
void @NAME@_step(@NAME@_state *state, const @REAL@ *target, const @REAL@ *dx,
    const @REAL@ *measured);
