"""Numbers that Python and the C kernels share; `c_header` writes them for the C compiler.

Each name is the same in both languages. The build runs this file alone, so it imports nothing of
hybridkin.
"""

from pathlib import Path
from zlib import crc32

# Kinds of the nodes of a plan, numbered from 1; the first four are the chains.
KINDS = (
    "arcs",
    "elastic",
    "rigid",
    "structural",
    "affine",
    "elm",
    "kernel",
    "readout",
    "leverage_guard",
    "quadratic_leverage",
    "hybrid",
    "ik",
    "group_distance",
    "moved",
    "shifted",
    "projected",
    "stacked",
    "with_pose",
    "body",
)
# Stages of hysteresis, numbered from 1: each has its kernel in a header of this name.
SOURCES = Path(__file__).parents[1] / "native" / "src"
STAGES = sorted(path.stem.removeprefix("stage_") for path in SOURCES.glob("stage_*.h"))
ACTIVATIONS = ("logistic", "tanh", "sin", "gaussian")

# Largest sizes that the kernels support; exported code has those of its model.
HK_MAX_N = 64  # actuators
HK_MAX_S = 16  # segments
HK_MAX_M = 64  # outputs of a regressor, or inner coordinates
HK_MAX_F = 2048  # features whose leverage is taken
HK_MAX_R = 12  # rows of a task of inverse kinematics
HK_GROUP = 8  # hidden units, or columns of a leverage, stored together

# Features of a readout that are not those of a network.
HK_QUADRATIC_FEATURES = 1
HK_POSE_FEATURES = 3

# The search for taut tendons.
HK_WHOLE_STEPS = 8  # then one tendon at a time, which always terminates
HK_MOST_TURNS = 12  # 2 to this power bounds the steps if rounding prevents the end

# Shortest elastic arc, relative to its rest length; shorter ones are NaN.
HK_LEAST_LENGTH = 0.1

# Guards of a correction.
HK_FULL = 3.0  # distance from the training rows up to which the weight is 1
HK_LONGEST = 1.5  # bound of a correction, relative to the longest one of a training row

HK_J, HK_DISTANCE = 1, 2  # asked for besides x
HK_IF_SAME = 4  # only if what the plan was made of has not changed

# Entries of a step: its model, flags, normals of a plane, half-spaces, obstacles, the body that
# keeps clear of them (-1: none), then the stages of hysteresis, and rows of their state.
IK_MODEL, IK_FLAGS, IK_N_NORMALS, IK_N_SPACES, IK_N_OBSTACLES, IK_BODY = 0, 1, 2, 3, 4, 5
IK_STAGES, IK_STATE_ROWS = 6, 7
# Entries of a body: its points, pairs of them that can meet, then the models of the points, and the
# first and the second points of these pairs.
IK_N_POINTS, IK_N_MEETING, IK_POINTS = 0, 1, 2

# A step of inverse kinematics.
IK_LIMITED, IK_POSTURE, IK_WEIGHTS, IK_ACCELERATES, IK_PULLS = 1, 2, 4, 8, 16  # flags
IK_POSE = 32  # the task is a pose, and not a vector of coordinates
IK_AXIS = 64  # the task is a position and the direction of an axis of the tip
IK_HALF_TURN = 3.141592653589793  # [rad]
IK_NO_AXIS = 1e-12  # a direction that is shorter is none
HK_ASIDE = 0.6  # a component of a unit vector below which a coordinate axis is not along it
IK_HEALTHY = 0.02  # sigma_min / sigma_max above which no damping is needed
IK_NEWTON = 60  # Newton steps in a box; a handful is usual
IK_CHANGES = 400  # of the active constraints of a step; a handful is usual
IK_CLOSE = 500.0  # rounding by which a step may end beside a bound [eps]
IK_SAME = 64.0  # rounding of a limit that others contradict; more is a contradiction [eps]
IK_SWEEPS = 30  # of Jacobi's method for eigenvalues; six are usual
IK_PROXIMAL = 2  # rounds that remove the effect of the least damping
IK_NORMALS = 6  # most normals of the plane of a log
IK_BALANCE = 30.0  # weight of a motion that leaves the plane, relative to that of the tip
IK_CORRECTIONS = 3  # corrections of a step whose tip must move as promised
IK_SLACK = 0.02  # a tendon that moves the tip less, relative to the most, is slack
IK_SLIP = 1e-4  # motion of the tip that does not count, relative to that of all actuators
IK_LEAST_PULL = 0.01  # shares of the way by which slack tendons are pulled in: from 1 to this
IK_PULL_RATIO = 0.125  # ratio of one share to the one before

# Rest at the point nearest to a target out of reach, eq. (21).
IK_NO_FALL = 1e-12  # of a squared error: smaller falls are rounding
IK_NO_WAY = 1e-7  # of the ranges: what shorter steps show is rounding
IK_CURVED = 1e-6  # of |J|^2: least lambda^2, and least curvature along a step that counts
IK_MOST_CURVED = 1e4  # of |J|^2: largest lambda^2
IK_EASED = 0.7  # factor on the curvature after a step that kept its promise
IK_EASED_WAY = 1e-4  # of the ranges: shorter steps ease it only
IK_STRAIGHT = 0.1  # where they show less than this share of it
IK_JUMP = 0.5  # of an error: a step says nothing about a target that moved more since then
# What is remembered of the last step: the curvature, the squared length of the step, its largest
# share of a range; then the motion of the tip that J promised, and the error that it was made for.
IK_BENT, IK_WAY_SQ, IK_SHARE, IK_PROMISED = 0, 1, 2, 3

# Obstacles, and points of the body that keep clear of them.
IK_OBSTACLE = 19  # numbers of one: center, axes, sides of its box, radius
IK_PAIRS_MOST = 32  # pairs of a point and an obstacle, or of two points, in the law of a step
IK_NEARER = 0.5  # of a gap: the largest part of it that one step takes, to first order
IK_AROUND = 4  # steps that are tried where the curvature of the model would lead into an obstacle
IK_BENT_WAY = 0.25  # of a way: what the curvature of the model may take of a gap in one step
IK_BRAKED = 40  # places on the way to a stop that are looked at, the first 16 period by period
IK_SHORTER = 5  # halvings of a step after that; then it brakes
IK_INSIDE_OBSTACLE = 1e-6  # a body so far in an obstacle has not reached its target [m]

# The way out of a singular configuration, eq. (22).
IK_STUCK = 0.01  # of a motion: a step that promises less does not get there
IK_FLAT = 1e-3  # sine of the angle between error and motion: less changes no error to first order
IK_PROBE = 1e-4  # of the ranges: to see how J changes
IK_BENDS = 1e-5  # of |J|^2: least negative curvature that leads out
IK_BENDS_MOST = 0.02  # of all curvature that was seen: less is the error of the probe
IK_TURNS = 40  # of the power method for its direction
IK_WAY_OUT = 0.05  # of the ranges: the longest first step

# The state of a robot that follows targets: one array.
IK_MODE = 0  # sum of the bits below
IK_PERIOD = 1  # [s]
IK_MEMORY = 2  # [s] of the offset without readings; infinite: it stays
IK_LAST = 3  # period of the step before [s], 0 for none
IK_SIGMA_MIN = 4
IK_DAMPING = 5
IK_DISTANCE = 6  # length of the error
IK_STOPPED = 7  # whether half-spaces changed the motion of the tip
IK_BLOCKED = 8  # whether obstacles changed the step
# Then target, motion of the target in this period, measured tip, last measured tip minus model, x
# and error; q, step, q before, whether it was held (n each); what is remembered of the last step
# (IK_PROMISED + 2 m); and J. Points of a task of m rows have m numbers, poses 16; motions and
# errors m.
# With hysteresis q is the command and q before what the actuators did; then follow its state, and
# one to try. Then follow the obstacles, where they are now.
IK_TARGET = 9
IK_POSE_NUMBERS = 16
IK_HAS_TARGET = 1
IK_HAS_FEED = 2
IK_HAS_TIP = 4
IK_MUST_SEE = 8
IK_FROM_REST = 16
IK_LEADS = 32  # commands lead what the actuators do, by their hysteresis

# Readings of the tip, and their state: one array.
IK_FRACTION = 0.2  # of an innovation that the offset takes; stable up to seven periods late, as
# the bound is 2 sin(pi / (4 d + 2)) for d periods that nobody knows of; .35 for four
IK_RING = 64  # tips of the model that are remembered
IK_RECENT = 8  # periods that a reading may be late without anybody knowing
IK_AGREEING = 5  # consecutive rejected readings that are believed if they agree
IK_ON_TIME = 1e-6  # of a period that makes no difference
IK_AGE = 0  # of a reading when it comes [s]
IK_SINCE = 1  # time since the last tip of the model [s], infinite: at rest until now
IK_NEWEST = 2  # its row in the ring
IK_FILLED = 3  # rows of the ring
IK_WEIGHT = 4  # of the readings in the offset, in readings
IK_DOUBTED = 5  # readings rejected in a row
IK_REJECTED = 6  # whether the last reading was not used
# Then offsets shown by the doubted readings (m each), and rows of the ring: the time since the tip
# before, and the tip.
IK_DOUBTS = 7

# Hysteresis of the actuators.
HK_MAX_CREEPS = 16  # time constants of an operator
HK_CREEP_ROUNDING = 16.0  # of a command, in units of the precision
IK_AT_REST_SHARE = 1e-6  # a command that moves this much farther than its actuator stays

# The search for configurations.
IK_LOWERS, IK_TO_DOMAIN, IK_TO_POSTURE = 1, 2, 4  # modes
IK_REACHED, IK_AT_REST, IK_HELD = 1, 2, 4  # results
IK_LAST_DAMPING = 1e8  # no descent even with this damping: the point is stationary
IK_STATIONARY = 1e-4  # sine of the angle between the error and the directions left by limits
IK_SLOW_STEPS = 8  # consecutive iterations that gain less than IK_SLOW of the tolerance
IK_SLOW = 0.01
IK_NULL_STEPS = 30  # iterations of a descent in the null space
IK_NULL_SLIP = 0.3  # largest error after such a step, per motion of the tip without projection
IK_NULL_GAIN = 1e-8  # smallest gain of such a step, per square of the remaining step
IK_INSIDE = 0.98  # domain distance that points outside the domain are moved to


def c_header() -> str:
    """Return the numbers as a C header, `kinds.h`."""
    numbers: dict[str, float] = {f"HK_{kind.upper()}": 1 + i for i, kind in enumerate(KINDS)}
    numbers |= {f"HK_STAGE_{name.upper()}": 1 + i for i, name in enumerate(STAGES)}
    numbers |= {f"HK_{name.upper()}": i for i, name in enumerate(ACTIVATIONS)}
    numbers |= {name: n for name, n in globals().items() if name.startswith(("HK_", "IK_"))}
    lines = [
        "/* Written by hybridkin/_core/kernel_numbers.py, which says what each number is. */",
        "",
    ]
    for name, number in numbers.items():
        if isinstance(number, float):
            lines.append(f"#define {name} R({number!r})")
        elif name.startswith("HK_MAX_"):
            lines.append(f"#ifndef {name}\n#define {name} {number}\n#endif")
        else:
            lines.append(f"enum {{ {name} = {number} }};")
    return "\n".join([*lines, ""])


def stages_header() -> str:
    """Return the kernels of the stages of hysteresis as a C header, `stages.h`."""
    lines = [f'#include "stage_{name}.h"' for name in STAGES]
    calls = [f"DO(HK_STAGE_{name.upper()}, {name})" for name in STAGES]
    return "\n".join([*lines, f"#define HK_EACH_STAGE(DO) {' '.join(calls)}", ""])


def write_headers(folder: str | Path) -> None:
    """Write the headers that the C sources include and that are no files: kinds.h and stages.h."""
    Path(folder, "kinds.h").write_text(c_header())
    Path(folder, "stages.h").write_text(stages_header())


def checksum(sources: Path) -> int:
    """Return a checksum of the C sources in a folder and of the shared numbers."""
    files = sorted(sources.glob("*.[ch]"))
    return crc32(b"".join([c_header().encode(), *(path.read_bytes() for path in files)]))
