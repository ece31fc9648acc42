"""The commands, their options and their help; `main` runs them.

The docstring of each function that adds a command is its help; the first line stands in the list of
commands.
"""

from __future__ import annotations

import argparse
import inspect
import json
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NoReturn

import hybridkin
from hybridkin._core.units import METRES, UNITS

EXIT_CODES = """\
exit codes: 0 success; 1 the result is not as asked for (points not reached, errors above
--fail-above, a log that does not pass its check in `describe`); 2 an error of input, among them a
log that does not pass its check before a fit, and a path out of reach; 130 interrupted, 143
terminated."""


def parser() -> argparse.ArgumentParser:
    """Hybrid mechanical and data-driven kinematics of soft robots.

    A model is a file that `fit` wrote, its folder, or a robot description (TOML) for the mechanical
    model alone.

    Some examples:
      hybridkin next robot.toml -n 50 --out plan
      hybridkin fit log.csv --robot robot.toml --groups motion --out model
      hybridkin evaluate model other_log.csv
      hybridkin track model --shape figure-eight --size 40,20 --unit mm --out track
      hybridkin animate model track --out track.mp4
    """
    top = _Parser(prog="hybridkin", **_help(parser))
    top.add_argument("--version", action="version", version=f"hybridkin {hybridkin.__version__}")
    commands = top.add_subparsers(required=True, metavar="COMMAND", dest="command")
    for add_options in (_paper, _next, _fit, _evaluate, _track, _animate, _export, _describe):
        text = _help(add_options)
        line = text["description"].partition("\n")[0].rstrip(".")
        command = commands.add_parser(add_options.__name__[1:], help=line, **text)
        command.add_argument(
            "--json", action="store_true", help="print one JSON document and nothing else"
        )
        add_options(command)
    return top


def _help(function: Callable[..., Any]) -> dict[str, Any]:
    return {
        "description": inspect.getdoc(function),
        "epilog": EXIT_CODES,
        "formatter_class": argparse.RawDescriptionHelpFormatter,
    }


class _Parser(argparse.ArgumentParser):
    """Errors in the form of all others of the command line."""

    def error(self, message: str) -> NoReturn:
        message = f"error: {message}; see `{self.prog} --help`"
        raise SystemExit(failed(message, 2, "--json" in sys.argv))


def failed(message: str, code: int, as_json: bool) -> int:
    """Print why a command failed, with --json also as a document, and return the exit code."""
    print(f"hybridkin: {message}", file=sys.stderr)
    if as_json:
        print(json.dumps({"error": message.removeprefix("error: "), "exit_code": code}, indent=2))
    return code


def _paper(command: argparse.ArgumentParser) -> None:
    """Reproduce the paper on the simulated trunk.

    Table 1, error histogram, workspace, a figure eight and a spiral tracked with the mechanical and
    with the hybrid model, and how well the paper's samples identify the trunk's geometry. Needs the
    extra `sim` (MuJoCo).
    """
    add = command.add_argument
    add("--out", type=Path, default=Path("results"), help="folder (results)")
    add("--splits", type=_count, default=20, help="random test sets (20)")
    add("--points", type=_count, default=151, help="time steps per path (151)")
    _add_work(command)


def _next(command: argparse.ArgumentParser) -> None:
    """Choose the configurations to measure next.

    Those that leave a hybrid model the least expected error, everywhere within the limits or along
    a path. They go to next.csv in the units, names and sign of the robot's logs, in the order
    chosen, with the expected error that remains after each.

    Some examples:
      hybridkin next robot.toml -n 50 --out plan
      hybridkin next model -n 20 --measured log.csv --out plan
      hybridkin next model -n 20 --path path.csv --unit mm --out plan
      hybridkin next robot.toml --q-min 0 --q-max 8 --out plan

    --q-min and --q-max are in the unit and sign of the robot's logs. By default the limits are
    those of the robot description, else the range that the model was fitted on. Tendons of a
    segment do not pull against each other. A path file is as for `track`.
    """
    add = command.add_argument
    _add_model(command)
    add("--out", type=Path, required=True, help="folder for next.csv")
    add("-n", type=_count, default=50, help="configurations (50)")
    add("--measured", type=Path, dest="log", metavar="LOG", help="log of what is measured already")
    add("--path", type=Path, metavar="PATH.csv", help="where the error is to be small (everywhere)")
    add("--dt", type=_positive, help="time between points of the path [s]")
    add("--unit", choices=METRES, help="of the path (the log's x)")
    _add_limits(command)
    _add_log(command)


def _fit(command: argparse.ArgumentParser) -> None:
    """Fit a hybrid model to a measured log.

    Check the log, calibrate the robot to it, compare mechanical, data-driven and hybrid models on
    held-out motions, and save the best with a report. What to calibrate is chosen by the errors on
    the log, unless the robot description lists it as `calibrate`.

    Some examples:
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

    With --play auto the rows of a motion are commands in the order of time, and the fit looks for
    backlash and dry friction: the tip then depends on where the tendons came from. They are kept
    only where they predict held-out motions better. Poses taken in any order have no play to find.

    All keys: python -c "import hybridkin; help(hybridkin.robots.read_description)"

    The log is checked first. Errors (a frozen sensor, wrong units, NaN) stop the fit with advice
    and exit code 2; warnings are printed and stand in the report.
    """
    add = command.add_argument
    add("log", type=Path, metavar="LOG", help="CSV, npz or parquet file")
    add("--robot", type=Path, required=True, metavar="ROBOT.toml")
    add("--out", type=Path, required=True, help="folder for model and report")
    _add_log(command)
    add(
        "--loss",
        default="linear",
        choices=("linear", "soft_l1", "huber", "cauchy", "arctan"),
        help="loss of the calibration; all but linear bound outliers (linear)",
    )
    radius = "estimate an error radius that covers this share of tips, such as 0.9; slow"
    add("--coverage", type=_share, help=radius)
    folds, rows = _between(1, float("inf"), int), _between(-1, float("inf"), int)
    add("--folds", type=folds, default=5, dest="n_folds", help="parts to hold out in turn (5)")
    fast = "leave out the hybrid that chooses for itself: fast"
    add("--no-auto", action="store_false", dest="auto", help=fast)
    add(
        "--play",
        type=_play,
        metavar="auto|WIDTH",
        help="backlash (play) of the actuators in the hybrid that chooses for itself: total width "
        "in the unit of q, or auto, found on held-out motions; the rows of a motion must be in the "
        "order of time (none)",
    )
    few = "of a longer log take every k-th row, N at most; 0: all (2000)"
    add("--max-rows", type=rows, default=2000, metavar="N", help=few)
    _add_work(command)


def _evaluate(command: argparse.ArgumentParser) -> None:
    """Show the errors of a model on a log.

    Motion by motion, with figures of where it errs. Take a log of other motions than those of the
    fit: rows that were fitted are recognised, and their errors reported apart as training errors.
    --fail-above looks at the other rows, or where all were fitted at the errors on held-out
    motions.

    Some examples:
      hybridkin evaluate model next_day.csv --out evaluation
      hybridkin evaluate robot.toml log.csv            # the mechanical model alone
      hybridkin evaluate model next_day.csv --json --fail-above 3.5 > errors.json
    """
    add = command.add_argument
    _add_model(command)
    add("log", type=Path, metavar="LOG", help="CSV, npz or parquet file")
    add("--out", type=Path, help="folder for report and figures (none)")
    add("--fail-above", type=float, metavar="MM", help="exit with 1 if the mean error is larger")
    _add_log(command)


def _track(command: argparse.ArgumentParser) -> None:
    """Compute the commands that lead the tip along a path.

    The path is a CSV file of points or a shape. The commands go to track.csv in the units, names
    and sign of the robot's logs, with a figure.

    Some examples:
      hybridkin track model path.csv --unit mm --out track
      hybridkin track model --shape figure-eight --size 40,20 --unit mm --duration 8 --out track
      hybridkin track model --shape spiral --size 5,20 --unit mm --turns 3 --out track
      hybridkin track model --shape line --size 0,30,0 --unit mm --q-min=-8 --q-max 8 --out track

    A path file has columns t, x, y, z, or x, y, z together with --dt. --q-min and --q-max are in
    the unit and sign of the robot's logs (m without a description), one number or one for each
    actuator. By default the robot keeps to its limits and to the range that the model was fitted
    on. A path that leaves the reach of the robot within them ends with exit code 2 and the largest
    size that does not; --force goes as near as the tip can.

    The first rows, with the status LEAD_IN, lead to the path from where the robot stands: --from
    rest (no tendon pulled), --from=A,B,... with a value of every actuator in the unit and sign of
    the log, or --from path (no lead-in). Of a model with play, track.csv has what to send, and in
    the columns effective_... what the actuators do.
    """
    add = command.add_argument
    _add_model(command)
    add("path", type=Path, nargs="?", metavar="PATH.csv", help="points to pass")
    add("--out", type=Path, required=True, help="folder for commands and figure")
    add("--shape", choices=("figure-eight", "spiral", "line"))
    center = "centre of the shape (a tip in the middle of the workspace)"
    add("--center", type=_numbers, metavar="X,Y,Z", help=center)
    size = "W,H of a figure eight; radii R0,R1 of a spiral; X,Y,Z from end to end of a line"
    add("--size", type=_numbers, help=size)
    add("--scale", type=_positive, default=1.0, help="about the path's centre (1)")
    add("--normal", type=_numbers, metavar="X,Y,Z", help="of its plane (base z)")
    add("--turns", type=float, default=3.0, help="of a spiral (3)")
    add("--rise", type=float, default=0.0, help="of a spiral, along the normal (0)")
    add("--duration", type=_positive, default=10.0, help="of the shape [s] (10)")
    add("--dt", type=_positive, help="time between points [s] (0.02 of a shape)")
    add("--unit", choices=METRES, help="of path and shape (the log's x)")
    _add_limits(command)
    add("--tol", type=_positive, default=0.1, help="error that is reached [mm] (0.1)")
    where, values = "where the robot stands (rest)", "rest|path|A,B,..."
    add("--from", type=_start, default="rest", dest="start", metavar=values, help=where)
    add("--force", action="store_true", help="go as near as the tip can")


def _animate(command: argparse.ArgumentParser) -> None:
    """Make a film (mp4, gif) or an interactive page (html) of a track.

    Some examples:
      hybridkin animate model track --out track.mp4
      hybridkin animate model track/track.csv --out track.html --frames 80
      hybridkin animate robot.toml log.csv --out log.gif      # the commands of a log
    """
    add = command.add_argument
    _add_model(command)
    add("track", type=Path, metavar="TRACK", help="track.csv or its folder")
    add("--out", type=Path, required=True, metavar="FILE", help=".mp4 .gif .html")
    add("--unit", choices=METRES, default="mm", help="of the axes (mm)")
    add("--speed", type=_positive, default=1.0, help="times real time (1)")
    add("--frames", type=_count, default=150, help="at most (150)")


def _export(command: argparse.ArgumentParser) -> None:
    """Write a model as C code for a controller.

    Header, source, test and a CMakeLists.txt, without any library but math.h. With --dt the step of
    inverse kinematics is written too, within the limits of the robot description and of the fit.

    Some examples:
      hybridkin export model --out robot_c --name robot
      hybridkin export model --out robot_c --name robot --dtype float32 --dt 0.001
    """
    add = command.add_argument
    _add_model(command)
    add("--out", type=Path, required=True, help="folder for the code")
    add("--name", default="model", help="of files and functions (model)")
    add("--dtype", choices=("float64", "float32"), default="float64", help="numbers (float64)")
    add("--dt", type=_positive, help="control period [s], for the step (no step)")
    _add_limits(command)


def _describe(command: argparse.ArgumentParser) -> None:
    """Describe a model, or check a log.

    Of a model: its geometry, what it was fitted on, its domain, its errors and what was chosen. Of
    a log, with --robot: what its check finds.

    Some examples:
      hybridkin describe model
      hybridkin describe robot.toml
      hybridkin describe log.csv --robot robot.toml
    """
    _add_model(command, "log", "MODEL|ROBOT.toml|LOG")
    _add_log(command)


def _add_limits(command: argparse.ArgumentParser) -> None:
    add = command.add_argument
    add("--q-min", type=_numbers, help="least q, in the unit and sign of the log")
    add("--q-max", type=_numbers, help="largest q")
    add("--dq-max", type=_numbers, help="largest speed of an actuator, per second")
    add("--ddq-max", type=_numbers, help="largest acceleration, per second squared")


def _add_work(command: argparse.ArgumentParser) -> None:
    add = command.add_argument
    add("--seeds", type=_count, default=5, dest="n_seeds", help="random networks (5)")
    add("--jobs", type=int, default=-1, help="processes; -1: all cores (-1)")


def _add_model(
    command: argparse.ArgumentParser, name: str = "model", metavar: str = "MODEL"
) -> None:
    command.add_argument(name, type=Path, metavar=metavar)
    known = "description with [log] and [limits] (that beside the model)"
    command.add_argument("--robot", type=Path, metavar="ROBOT.toml", help=known)


def _add_log(command: argparse.ArgumentParser) -> None:
    log = command.add_argument_group("how the log is written, over what [log] of the robot says")
    add = log.add_argument
    add("--q", type=_names, metavar="A,B,...", help="columns of the actuators")
    add("--x", type=_names, metavar="X,Y,Z", help="columns of the tip")
    add("--q-unit", choices=UNITS)
    add("--x-unit", choices=METRES)
    add("--q-sign", type=int, choices=(1, -1), help="-1: pulled counts as positive")
    add("--groups", metavar="COLUMN", help="column that names the motion; or none")
    add("--time", metavar="COLUMN", help="column of the time stamp [s]; or none")
    add("--delimiter", help="separator of a text file (found out)")
    some = "motions to leave out, such as '*tendon*'; may be repeated"
    add("--exclude", action="append", default=[], metavar="PATTERN", help=some)
    add("--drop-invalid", action="store_true", help="leave out rows with gaps or NaN")
    add("--drop-frozen", action="store_true", help="leave out rows whose tip is frozen")
    add("--force", action="store_true", help="go on in spite of errors in the log")


def _numbers(text: str) -> Sequence[float]:
    try:
        return tuple(float(part) for part in text.split(","))
    except ValueError:
        raise argparse.ArgumentTypeError(f"must be numbers, as in 1.5,2, got {text!r}") from None


def _start(text: str) -> Sequence[float] | str:
    return text if text in ("rest", "path") else _numbers(text)


def _names(text: str) -> Sequence[str]:
    return tuple(part.strip() for part in text.split(","))


def _play(text: str) -> float | str:
    if text == "auto":
        return text
    value = float(text)
    if not 0.0 <= value < float("inf"):
        raise argparse.ArgumentTypeError(f"must be auto or a width, zero or more, got {text}")
    return value


def _between(low: float, high: float, kind: type = float) -> Callable[[str], Any]:
    """Return a type of options: a number between two others."""

    def number(text: str) -> Any:
        value = kind(text)
        if not low < value < high:
            need = f"must be more than {low:g} and less than {high:g}"
            raise argparse.ArgumentTypeError(f"{need}, got {text}")
        return value

    return number


_positive, _share = _between(0.0, float("inf")), _between(0.0, 1.0)
_count = _between(0, float("inf"), int)
