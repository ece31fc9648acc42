"""The commands, their options and their help; `__main__` runs them."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import hybridkin

EXIT_CODES = """\
exit codes: 0 all is well; 1 what was asked for did not come out (points not reached, errors above
--fail-above, a log that does not pass its check in `describe`); 2 an error of input, a log among
them that does not pass its check before a fit; 130 interrupted."""

_EPILOG = f"""\
a model is a file that `fit` wrote, its folder, or a robot description (TOML) for the mechanical
model alone.

examples:
  hybridkin fit log.csv --robot robot.toml --groups motion --out model
  hybridkin evaluate model other_log.csv
  hybridkin track model --shape figure-eight --size 40,20 --unit mm --out track
  hybridkin animate model track --out track.mp4

{EXIT_CODES}
"""

_PAPER = """\
Reproduce the paper on the simulated trunk: Table 1, error histogram, workspace, a figure eight and
a spiral tracked with the mechanical and with the hybrid model, and what the paper's samples tell
about the trunk's geometry. Needs the extra `sim` (MuJoCo)."""

_FIT = """\
Check a measured log, calibrate the robot to it, compare mechanical, data-driven and hybrid models
on motions that they have not seen, and save the best with a report."""

_FIT_EXAMPLES = """\
examples:
  hybridkin fit log.csv --robot robot.toml --groups motion --out model
  hybridkin fit log.npz --robot robot.toml --q cables --x tip --q-unit mm --out model

The robot description names its geometry and the columns and units of its logs:

  [[segment]]
  radius = 0.0045       # of the tendon circle [m]
  length = 0.060        # [m]; leave out for extensible segments
  repeat = 3

  [log]
  q = ["t1", "t2", "t3", "t4", "t5", "t6", "t7", "t8", "t9"]
  x = ["tip_x", "tip_y", "tip_z"]
  q_unit = "mm"
  x_unit = "mm"
  q_sign = -1           # the log counts a pulled tendon as positive
  groups = "motion"     # column that names the motion of a row

With --play auto the rows of a motion are commands in the order of time, and backlash and dry
friction are looked for: the tip then depends on where the tendons came from. Kept only where that
predicts other motions better. Poses taken in any order have no play to find.

All keys: python -c "import hybridkin; help(hybridkin.robots.read_description)"

The log is checked first. Errors (a frozen sensor, wrong units, NaN) stop the fit with advice and
exit code 2; warnings are printed and stand in the report.
"""

_EVALUATE = "Tell the errors of a model on a log, motion by motion, and draw where it errs."
_EVALUATE_EXAMPLES = """\
examples:
  hybridkin evaluate model log.csv --out evaluation
  hybridkin evaluate robot.toml log.csv            # the mechanical model alone
  hybridkin evaluate model log.csv --json --fail-above 3.5 > errors.json
"""

_TRACK = """\
Compute the commands that lead the tip along a path, a CSV file of points or a shape, and write them
as track.csv in the units, names and sign of the robot's logs, with a figure."""
_TRACK_EXAMPLES = """\
examples:
  hybridkin track model path.csv --unit mm --out track
  hybridkin track model --shape figure-eight --size 40,20 --unit mm --duration 8 --out track
  hybridkin track model --shape spiral --size 5,20 --unit mm --turns 3 --out track
  hybridkin track model --shape line --size 0,30,0 --unit mm --q-min=-8 --q-max 8 --out track

A path file has columns t, x, y, z, or x, y, z together with --dt. --q-min and --q-max are in the
unit and sign of the robot's logs (m without a description), one number or one for each actuator.
By default the robot keeps to its limits and to the range that the model was fitted on. Of a model
with play, track.csv has what to send, and in the columns effective_... what the actuators do.
"""

_ANIMATE = "Make a film (mp4, gif) or an interactive page (html) of a robot that follows a track."
_ANIMATE_EXAMPLES = """\
examples:
  hybridkin animate model track --out track.mp4
  hybridkin animate model track/track.csv --out track.html --frames 80
  hybridkin animate robot.toml log.csv --out log.gif      # the commands of a log
"""

_BENCHMARK = "Measure how fast a model is on this machine, by default that of the paper's trunk."
_BENCHMARK_EXAMPLES = """\
examples:
  hybridkin benchmark
  hybridkin benchmark model --batches 1,1000 --json
"""

_DESCRIBE = """\
Tell what a model is: geometry, what it was fitted on, where it may be trusted, its errors and what
was chosen. Of a log, with --robot: what its check finds."""
_DESCRIBE_EXAMPLES = """\
examples:
  hybridkin describe model
  hybridkin describe robot.toml
  hybridkin describe log.csv --robot robot.toml
"""


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line; ``command`` is the name of what to run."""
    top = _Parser(
        prog="hybridkin",
        description="Hybrid mechanical and data-driven kinematics of soft robots.",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    top.add_argument("--version", action="version", version=f"hybridkin {hybridkin.__version__}")
    commands = top.add_subparsers(required=True, metavar="COMMAND", dest="command")
    _paper(commands)
    _fit(commands)
    _evaluate(commands)
    _track(commands)
    _animate(commands)
    _benchmark(commands)
    _describe(commands)
    return top


class _Parser(argparse.ArgumentParser):
    """Errors as the rest of the command line tells them."""

    def error(self, message: str) -> Any:
        self.exit(2, f"hybridkin: error: {message}; see `{self.prog} --help`\n")


def _paper(commands: Any) -> None:
    paper = _command(commands, "paper", "reproduce the paper on the simulated trunk", _PAPER, "")
    paper.add_argument("--out", type=Path, default=Path("results"), help="folder (results)")
    paper.add_argument("--splits", type=count, default=20, help="random test sets (20)")
    paper.add_argument("--points", type=count, default=151, help="time steps per path (151)")
    _work(paper)


def _fit(commands: Any) -> None:
    fit = _command(commands, "fit", "fit a hybrid model to a measured log", _FIT, _FIT_EXAMPLES)
    fit.add_argument("log", type=Path, metavar="LOG", help="CSV, npz or parquet file")
    fit.add_argument("--robot", type=Path, required=True, metavar="ROBOT.toml")
    fit.add_argument("--out", type=Path, required=True, help="folder for model and report")
    _log(fit)
    fit.add_argument(
        "--loss",
        default="linear",
        choices=("linear", "soft_l1", "huber", "cauchy", "arctan"),
        help="loss of the calibration; all but linear bound outliers (linear)",
    )
    fit.add_argument(
        "--coverage",
        type=share,
        help="share of tips, such as 0.9, that the model shall tell a radius for; slow",
    )
    fit.add_argument("--folds", type=count, default=5, help="parts to hold out in turn (5)")
    fit.add_argument(
        "--no-auto", action="store_true", help="leave out the hybrid that chooses for itself: fast"
    )
    fit.add_argument(
        "--play",
        type=play,
        metavar="auto|WIDTH",
        help="play of the actuators that the hybrid which chooses for itself knows: total width in "
        "the unit of q, or auto, found by motions left out; the rows of a motion must be in the "
        "order of time (none)",
    )
    fit.add_argument(
        "--max-rows",
        type=int,
        default=2000,
        metavar="N",
        help="of a longer log take every k-th row, N at most; 0: all (2000)",
    )
    _work(fit)


def _evaluate(commands: Any) -> None:
    line = "errors of a model on a log"
    evaluate = _command(commands, "evaluate", line, _EVALUATE, _EVALUATE_EXAMPLES)
    evaluate.add_argument("model", type=Path, metavar="MODEL")
    evaluate.add_argument("log", type=Path, metavar="LOG", help="CSV, npz or parquet file")
    _robot(evaluate)
    evaluate.add_argument("--out", type=Path, help="folder for report and figures (none)")
    evaluate.add_argument(
        "--fail-above", type=float, metavar="MM", help="exit with 1 if the mean error is larger"
    )
    _log(evaluate)


def _track(commands: Any) -> None:
    track = _command(commands, "track", "commands that follow a path", _TRACK, _TRACK_EXAMPLES)
    track.add_argument("model", type=Path, metavar="MODEL")
    track.add_argument("path", type=Path, nargs="?", metavar="PATH.csv", help="points to pass")
    _robot(track)
    track.add_argument("--out", type=Path, required=True, help="folder for commands and figure")
    track.add_argument("--shape", choices=("figure-eight", "spiral", "line"))
    track.add_argument(
        "--center",
        type=numbers,
        metavar="X,Y,Z",
        help="centre of the shape (the mean tip of random commands)",
    )
    track.add_argument(
        "--size",
        type=numbers,
        help="W,H of a figure eight; radii R0,R1 of a spiral; X,Y,Z from end to end of a line",
    )
    track.add_argument("--normal", type=numbers, metavar="X,Y,Z", help="of its plane (base z)")
    track.add_argument("--turns", type=float, default=3.0, help="of a spiral (3)")
    track.add_argument("--rise", type=float, default=0.0, help="of a spiral, along the normal (0)")
    track.add_argument("--duration", type=positive, default=10.0, help="of the shape [s] (10)")
    track.add_argument("--dt", type=positive, help="time between points [s] (0.02 of a shape)")
    track.add_argument("--unit", choices=("m", "cm", "mm"), help="of path and shape (the log's x)")
    track.add_argument("--q-min", type=numbers, help="least q, in the unit and sign of the log")
    track.add_argument("--q-max", type=numbers, help="largest q")
    track.add_argument("--dq-max", type=numbers, help="largest speed of an actuator, per second")
    track.add_argument("--tol", type=positive, default=0.1, help="error that is reached [mm] (0.1)")


def _animate(commands: Any) -> None:
    animate = _command(commands, "animate", "film of a track", _ANIMATE, _ANIMATE_EXAMPLES)
    animate.add_argument("model", type=Path, metavar="MODEL")
    animate.add_argument("track", type=Path, metavar="TRACK", help="track.csv or its folder")
    _robot(animate)
    animate.add_argument("--out", type=Path, required=True, metavar="FILE", help=".mp4 .gif .html")
    animate.add_argument("--unit", choices=("m", "cm", "mm"), default="mm", help="of the axes (mm)")
    animate.add_argument("--speed", type=positive, default=1.0, help="times real time (1)")
    animate.add_argument("--frames", type=count, default=150, help="at most (150)")


def _benchmark(commands: Any) -> None:
    line = "speed of a model on this machine"
    benchmark = _command(commands, "benchmark", line, _BENCHMARK, _BENCHMARK_EXAMPLES)
    benchmark.add_argument("model", type=Path, nargs="?", metavar="MODEL")
    _robot(benchmark)
    benchmark.add_argument(
        "--batches", type=counts, default=(1, 100, 10_000, 100_000), help="(1,100,10000,100000)"
    )
    benchmark.add_argument(
        "--seconds", type=positive, default=0.3, help="of every measurement (0.3)"
    )


def _describe(commands: Any) -> None:
    line = "what a model is, or what is wrong with a log"
    describe = _command(commands, "describe", line, _DESCRIBE, _DESCRIBE_EXAMPLES)
    describe.add_argument("what", type=Path, metavar="MODEL|ROBOT.toml|LOG")
    _robot(describe)
    _log(describe)


def _command(commands: Any, name: str, line: str, text: str, examples: str) -> Any:
    command = commands.add_parser(
        name,
        help=line,
        description=text,
        epilog=f"{examples}\n{EXIT_CODES}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    command.add_argument(
        "--json", action="store_true", help="print one JSON document and nothing else"
    )
    return command


def _work(command: Any) -> None:
    command.add_argument("--seeds", type=count, default=5, help="random networks (5)")
    command.add_argument("--jobs", type=int, default=-1, help="processes; -1: all cores (-1)")


def _robot(command: Any) -> None:
    command.add_argument(
        "--robot",
        type=Path,
        metavar="ROBOT.toml",
        help="description with [log] and [limits] (that beside the model)",
    )


def _log(command: Any) -> None:
    log = command.add_argument_group("how the log is written, over what [log] of the robot says")
    log.add_argument("--q", type=names, metavar="A,B,...", help="columns of the actuators")
    log.add_argument("--x", type=names, metavar="X,Y,Z", help="columns of the tip")
    log.add_argument("--q-unit", choices=("m", "cm", "mm"))
    log.add_argument("--x-unit", choices=("m", "cm", "mm"))
    log.add_argument("--q-sign", type=int, choices=(1, -1), help="-1: pulled counts as positive")
    log.add_argument("--groups", metavar="COLUMN", help="column that names the motion of a row")
    log.add_argument("--time", metavar="COLUMN", help="column of the time stamp [s]")
    log.add_argument("--delimiter", help="separator of a text file (found out)")
    log.add_argument(
        "--exclude",
        action="append",
        default=[],
        metavar="PATTERN",
        help="motions to leave out, such as '*tendon*'; may be repeated",
    )
    log.add_argument("--drop-invalid", action="store_true", help="leave out rows with gaps or NaN")
    log.add_argument(
        "--drop-frozen", action="store_true", help="leave out rows whose tip is frozen"
    )
    log.add_argument("--force", action="store_true", help="go on in spite of errors in the log")


def count(text: str) -> int:
    """Return a whole number of at least 1."""
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f"must be at least 1, got {value}")
    return value


def counts(text: str) -> Sequence[int]:
    """Return whole numbers of at least 1, separated by commas."""
    return tuple(count(part) for part in text.split(","))


def numbers(text: str) -> Sequence[float]:
    """Return numbers separated by commas."""
    return tuple(float(part) for part in text.split(","))


def names(text: str) -> Sequence[str]:
    """Return names separated by commas."""
    return tuple(part.strip() for part in text.split(","))


def play(text: str) -> float | str:
    """Return "auto" or a width, zero or more."""
    if text == "auto":
        return text
    value = float(text)
    if not 0.0 <= value < float("inf"):
        raise argparse.ArgumentTypeError(f"must be auto or a width, zero or more, got {text}")
    return value


def positive(text: str) -> float:
    """Return a positive number."""
    value = float(text)
    if not 0.0 < value < float("inf"):
        raise argparse.ArgumentTypeError(f"must be positive, got {text}")
    return value


def share(text: str) -> float:
    """Return a number between 0 and 1."""
    value = float(text)
    if not 0.0 < value < 1.0:
        raise argparse.ArgumentTypeError(f"must lie between 0 and 1, got {text}")
    return value
