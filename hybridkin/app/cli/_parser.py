"""The commands, their options and their help; `main` runs them.

The docstring of each function that adds a command is its help; the first line stands in the list of
commands.
"""

from __future__ import annotations

import argparse
import inspect
import json
import math
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple, NoReturn

import hybridkin
from hybridkin.app.cli._init import QUESTIONS
from hybridkin.app.cli._terminal import write
from hybridkin.app.cli._values import (
    between,
    count,
    hysteresis,
    length,
    names,
    not_negative,
    numbers,
    positive,
    share,
    signs,
    start,
)
from hybridkin.formats import FRAMES, METRES, SECONDS, UNITS

EXIT_CODES = """\
exit codes: 0 success; 1 the result is not as requested (a fifth of the points of a path not
reached, errors above --fail-above or a promise, or `describe` and `init` found errors in a log);
2 invalid input, a log with errors before a fit, or a path out of reach; 130 interrupted;
143 terminated."""

_DECIMALS = (".", ",")


class _File(NamedTuple):
    """An argument that names a file to read: its name in the help; whether it can be a folder."""

    shown: str
    or_folder: bool


def parser() -> argparse.ArgumentParser:
    """Hybrid mechanical and data-driven kinematics of soft robots.

    To see what it does, on simulated data and in about a minute: hybridkin demo

    Start with your own robot and a log of it, a table of actuator values and measured tips:
      hybridkin init robot.toml --log log.csv
      hybridkin fit log.csv --robot robot.toml --out model
      hybridkin evaluate model other_log.csv
      hybridkin track model --shape figure-eight --size 40,20 --unit mm --out track
      hybridkin animate model track --out track.gif

    MODEL is a model file written by `fit`, its folder, or a robot description (TOML), which stands
    for the mechanical model alone.
    """
    top = _Parser(prog="hybridkin", **_help(parser))
    top.add_argument("--version", action="version", version=f"hybridkin {hybridkin.__version__}")
    commands = top.add_subparsers(required=True, metavar="COMMAND", dest="command")
    begin = (_demo, _merge, _init, _describe, _fit, _evaluate)
    use = (_view, _track, _verify, _animate)
    for add_options in (*begin, *use, _next, _export):
        text = _help(add_options)
        line = text["description"].partition("\n")[0].rstrip(".")
        command = commands.add_parser(add_options.__name__[1:], help=line, **text)
        command.set_defaults(files={})
        add_options(command)
        add = command.add_argument
        add(
            "--json",
            action="store_true",
            help="print one JSON document and nothing else",
        )
        add(
            "--quiet",
            action="store_true",
            help="print results, warnings and errors only",
        )
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
    write(f"hybridkin: {message}", sys.stderr, indent="  ")
    if as_json:
        record = {"error": message.removeprefix("error: "), "exit_code": code}
        write(json.dumps(record, indent=2), sys.stdout)
    return code


def _demo(command: argparse.ArgumentParser) -> None:
    """Show the way from a log to a track, on simulated data.

    Writes a log of a simulated pneumatic trunk and runs the commands that a user runs: `init`,
    `fit`, `track` and `animate`. Prints what each step does, how good the models are, and where the
    files are. Needs no robot, no network and about a minute.

    Some examples:
      hybridkin demo
      hybridkin demo --out first_try
    """
    add = command.add_argument
    add(
        "--out",
        type=Path,
        default=Path("demo"),
        metavar="DIR",
        help="new folder (demo)",
    )


def _init(command: argparse.ArgumentParser) -> None:
    """Write a robot description.

    The file has the geometry of the robot and the columns and units of its logs, each with a
    comment. `fit` can read it at once. If an option without a default is missing, the command asks
    on a terminal for it and for all others that are not given. With --log it proposes the columns
    by their names and the zeros of tendons by the first rows of the motions, and checks the log
    against the description, as `fit` does.

    Some examples:
      hybridkin init robot.toml --log log.csv
      hybridkin init --kind tendons --segments 2 --radius 8 --length 80 --q-sign -1
      hybridkin init --kind chambers --segments 3 --radius 100,93,79 --q-unit m --x-unit m
      hybridkin init --kind tendons --q-unit counts --spool-radius 6 --counts-per-turn 4096

    Rough values of the geometry are enough: `fit` calibrates them. Default: 3 actuators in each
    segment, units mm, and the columns q1, q2, ..., x, y, z or those of the log. Actuators whose
    unit is no length need --spool-radius (motors) or --gain.
    """
    add = command.add_argument
    name = "robot.toml"
    add(
        "out",
        type=Path,
        nargs="?",
        default=Path(name),
        metavar=name,
        help="file (robot.toml)",
    )
    for question in QUESTIONS:
        option = f"--{question.name.replace('_', '-')}"
        value = question.name.rpartition("_")[2].upper()
        add(option, type=question.parse, metavar=value, help=question.text)
    _add_text_form(command)
    add("--force", action="store_true", help="replace the file if it exists")


def _merge(command: argparse.ArgumentParser) -> None:
    """Write one log from a file of the motors and one of a camera.

    Gives each tip of the camera the command of its time. The clocks of the two files may differ:
    the lag between them is that at which the commands explain the tips best, and is printed. A
    motion that repeats, or motions of equal duration, can have several such lags: give --lag, 0 if
    both files share a clock.

    Some examples:
      hybridkin merge motors.csv camera.csv --q m1,m2,m3 --x X,Y,Z --time t --out log.csv
      hybridkin merge motors.csv camera.csv --q m1,m2,m3 --x X,Y,Z --time t --lag 0 --out log.csv

    A camera's own name of the time is given by --camera-time, for example "Time (Seconds)".

    Names, units and signs of the columns stay as they are in the files.
    """
    add = command.add_argument
    _add_file(command, "motors", "MOTORS", "file of the motors")
    _add_file(command, "camera", "CAMERA", "file of the camera")
    add("--out", type=Path, required=True, metavar="LOG.csv", help="log to write")
    text = "columns of the actuators"
    add("--q", type=names, required=True, metavar="A,B,...", help=text)
    text = "columns of the tip"
    add("--x", type=names, required=True, metavar="X,Y,Z", help=text)
    text = "column of the time of the motors [s]"
    add("--time", required=True, metavar="COLUMN", help=text)
    text = "column of the time of the camera [s] (of the same name)"
    add("--camera-time", metavar="COLUMN", help=text)
    add("--groups", metavar="COLUMN", help="column of the motion, with the motors")
    text = "how much later the clock of the camera is [s] (estimated)"
    add("--lag", type=float, metavar="S", help=text)
    text = "longest time between two motor rows [s]; tips in longer gaps are left out (5 periods)"
    add("--tolerance", type=positive, metavar="S", help=text)
    text = "a command holds until the next one (linear between two rows)"
    add("--hold", action="store_true", help=text)
    text = "separator of text files (comma, semicolon or tab, by the header)"
    add("--delimiter", metavar="CHAR", help=text)
    add("--decimal", choices=_DECIMALS, help="decimal sign of text files (.)")
    text = "numbers of the camera that stand for missing values, such as 9999.999"
    add("--missing", type=numbers, metavar="A,...", help=text)
    add("--force", action="store_true", help="replace the log if it exists")


def _next(command: argparse.ArgumentParser) -> None:
    """Choose the configurations to measure next.

    Chooses the configurations after which a hybrid model has the least expected error, everywhere
    within the limits or along a path. Writes them to next.csv in the units, names and sign of the
    robot's logs, in the order of choice, each with the expected error that remains after it. With
    --measured, it also names motions that show which parameters of the robot are wrong, where the
    log leaves that open, and writes them to separating.csv.

    Some examples:
      hybridkin next robot.toml -n 50 --out plan
      hybridkin next model -n 20 --measured log.csv --out plan
      hybridkin next model -n 20 --path path.csv --unit mm --out plan
      hybridkin next robot.toml --q-min 0 --q-max 8 --out plan

    The limits --q-min and --q-max are in the unit and sign of the robot's logs. Default: those of
    the robot description, else the training range of the model. The tendons of a segment never pull
    against each other. The format of a path file is that of `track`.
    """
    add = command.add_argument
    _add_model(command)
    _add_out(command, "folder for next.csv", required=True)
    add("-n", type=count, default=50, help="number of configurations (50)")
    _add_file(command, "--measured", "LOG", "log of what is measured so far", dest="log")
    _add_path(command, "where the error matters (everywhere)")
    _add_limits(command)
    _add_log(command)


def _fit(command: argparse.ArgumentParser) -> None:
    """Fit a hybrid model to a measured log.

    Checks the log, calibrates the robot, compares mechanical, data-driven and hybrid models on
    held-out motions, and saves the hybrid that chooses its error model itself, with a report.
    Errors on held-out motions also decide what to calibrate, unless the robot description lists it
    as `calibrate`.

    Some examples:
      hybridkin fit log.csv --robot robot.toml --groups motion --out model
      hybridkin fit log.npz --robot robot.toml --q cables --x tip --q-unit mm --out model

    The robot description (`hybridkin init` writes one) has the geometry and the columns and units
    of the logs:

      [[segment]]
      radius = 0.0045       # of the circle on which the tendons lie [m]
      length = 0.060        # [m]; leave out for extensible segments
      repeat = 3

      [log]
      q = ["t1", "t2", "t3", "t4", "t5", "t6", "t7", "t8", "t9"]
      x = ["tip_x", "tip_y", "tip_z"]
      q_unit = "mm"
      x_unit = "mm"
      q_sign = -1           # the log counts a pulled tendon as positive
      groups = "motion"     # column that names the motion of a row

    All keys: python -c "import hybridkin; help(hybridkin.robots.read_description)"

    The check of the log comes first. Errors (a frozen sensor, wrong units, NaN) stop the fit with
    advice and exit code 2. Warnings are printed and stand in the report.

    The fit looks for backlash (also called play), smooth friction and creep: the tip then depends
    on where the tendons came from. They are kept only if they lower the errors on held-out motions.
    Motions must have names, and their rows must be in the order of time; creep also needs --time.
    --hysteresis 0: none of these.
    """
    add = command.add_argument
    _add_file(command, "log", "LOG", "CSV, npz or parquet file")
    _add_file(command, "--robot", "ROBOT.toml", "robot description", required=True)
    _add_out(command, "folder for model and report", required=True)
    _add_log(command)
    add(
        "--loss",
        default="linear",
        choices=("linear", "soft_l1", "cauchy"),
        help="loss of the calibration; all but linear limit the effect of outliers (linear)",
    )
    radius = "also estimate the error radius that covers this share of tips, such as 0.9; slow"
    add("--coverage", type=share, metavar="SHARE", help=radius)
    folds = "number of parts, each held out in turn (5)"
    number = between(1, float("inf"), int)
    add("--folds", type=number, default=5, dest="n_folds", metavar="N", help=folds)
    fast = 'without the hybrid that chooses its error model itself ("auto"); fast; saves the best'
    add("--no-auto", action="store_false", dest="auto", help=fast)
    add(
        "--hysteresis",
        type=hysteresis,
        default="detect",
        metavar="auto|WIDTH",
        help='hysteresis of the actuators in the "auto" hybrid: the total width of backlash, in '
        "the unit of q; auto: backlash, friction and creep, found in every fold (auto if the "
        "log shows any)",
    )
    few = "use the tips of at most N rows, spread over motions; 0: of all rows (2000)"
    number = between(-1, float("inf"), int)
    add("--max-rows", type=number, default=2000, metavar="N", help=few)
    add(
        "--jobs",
        type=int,
        default=-1,
        metavar="N",
        help="processes; -1: one per core (-1)",
    )


def _evaluate(command: argparse.ArgumentParser) -> None:
    """Show the errors of a model on a log.

    Shows the errors motion by motion, with figures. Use a log with other motions than those of the
    fit. Rows that were fitted are recognised, and their errors are reported as training errors.

    Some examples:
      hybridkin evaluate model next_day.csv --out evaluation
      hybridkin evaluate robot.toml log.csv            # the mechanical model alone
      hybridkin evaluate model next_day.csv --json --fail-above 3.5 > errors.json

    --fail-above compares the mean error of the rows that were not fitted. If all were fitted, it
    compares the mean error on held-out motions of the fit.
    """
    add = command.add_argument
    _add_model(command)
    _add_file(command, "log", "LOG", "CSV, npz or parquet file")
    _add_out(command, "folder for report and figures (none)")
    add(
        "--fail-above",
        type=float,
        default=float("inf"),
        metavar="MM",
        help="exit with 1 if the mean error is larger",
    )
    _add_log(command)


def _view(command: argparse.ArgumentParser) -> None:
    """Show the robot in the browser, to drag its tip and move its actuators.

    Opens a page of this machine with the robot in 3D. Drag the target, and the tip follows; move a
    slider, and an actuator moves. "Wiggle every actuator" shows whether a description bends the
    right way. With a log its tips are coloured by the error of the model, and a click on one moves
    the robot there. Obstacles can be dragged, and the body keeps clear of them while it follows the
    target. Ctrl-C ends it.

    Some examples:
      hybridkin view model
      hybridkin view model --path path.csv --unit mm   # a button follows it, in a loop
      hybridkin view robot.toml log.csv
      hybridkin view model --q-min=-8 --q-max 8 --dq-max 20
      hybridkin view model --obstacles scene.toml --clearance 5mm
      hybridkin view model --no-browser --port 9000    # over ssh: forward this port

    Limits are in the unit and sign of the robot's logs. Default: those of `track`; without any, the
    range of the log. Only this machine can open the page, unless --host says otherwise; it has no
    password.
    """
    add = command.add_argument
    _add_model(command)
    _add_file(command, "log", "LOG", "measured rows to show", nargs="?")
    _add_path(command, "path of the tip to follow in a loop")
    add(
        "--host",
        default="127.0.0.1",
        metavar="ADDRESS",
        help="listen here (this machine)",
    )
    add("--port", type=count, default=8080, help="port, or the next free one (8080)")
    add("--no-browser", action="store_true", help="print the address, open nothing")
    _add_limits(command)
    _add_obstacles(command)
    _add_log(command)


def _add_delay(command: argparse.ArgumentParser, use: str) -> None:
    command.add_argument(
        "--delay",
        type=not_negative,
        metavar="SECONDS",
        help=f"how much later than its command a tip is read [s]; {use}",
    )


def _track(command: argparse.ArgumentParser) -> None:
    """Compute the commands that lead the tip along a path.

    The path is a CSV file of points or a shape. Writes the commands to track.csv in the units,
    names and sign of the robot's logs, with a figure.

    Some examples:
      hybridkin track model path.csv --unit mm --out track
      hybridkin track model --shape figure-eight --size 40,20 --unit mm --duration 8 --out track
      hybridkin track model --shape spiral --size 5,20 --unit mm --turns 3 --out track
      hybridkin track model --shape line --size 0,30,0 --unit mm --q-min=-8 --q-max 8 --out track
      hybridkin track model path.csv --obstacles scene.toml --clearance 5mm --out track

    A path file has the columns t, x, y, z, or x, y, z together with --dt.

    The limits --q-min and --q-max are in the unit and sign of the robot's logs (m without a
    description), one number or one for each actuator. Default: the limits of the robot description
    within the training range of the model. If more than a tenth of the path leaves the reach of the
    robot, the command ends with exit code 2 and names the largest scale that does not. With
    --out-of-reach the tip goes as near as it can. The last line says how many points are reached
    and missed, by how much, and the error to expect over all of them; a point that only --round
    misses counts as reached. The exit code is 1 if a fifth of the points are missed or outside the
    log, with --fail-missed if one is missed.

    With --obstacles the whole body keeps clear of what a file describes:

      [[sphere]]
      center = [0.0, 0.08, 0.5]     # [m], in the frame of the tip
      radius = 0.03

    and [[box]], [[capsule]], [[half_space]]; all keys:
    python -c "import hybridkin; help(hybridkin.obstacles.read_scene)". The report gives the least
    distance of the body to each, and the number of points with the status BLOCKED, where an
    obstacle is in the way.

    The first rows have the status LEAD_IN. They lead to the path from where the robot stands:
    --from rest (no tendon pulled), --from=A,B,... (a value of every actuator in the unit and sign
    of the log), or --from path (no such rows). For a model with backlash or creep the columns of
    the actuators are what to send, and the columns effective_... what the actuators do.
    """
    add = command.add_argument
    _add_model(command)
    _add_file(command, "path", "PATH.csv", "file of points", nargs="?")
    _add_out(command, "folder for commands and figure", required=True)
    add(
        "--shape",
        choices=("figure-eight", "spiral", "line"),
        help="shape instead of a file",
    )
    add(
        "--center",
        type=numbers,
        metavar="X,Y,Z",
        help="centre of the shape (mid-workspace)",
    )
    size = "figure eight: width along x, height; spiral: two radii; line: X,Y,Z from end to end"
    add("--size", type=numbers, metavar="A,B", help=size)
    add(
        "--scale",
        type=positive,
        default=1.0,
        metavar="F",
        help="factor of the size (1)",
    )
    add(
        "--normal",
        type=numbers,
        metavar="X,Y,Z",
        help="normal of its plane (of that of the tips)",
    )
    add("--turns", type=float, default=3.0, metavar="N", help="turns of a spiral (3)")
    add("--rise", type=float, default=0.0, metavar="H", help="height of a spiral (0)")
    add(
        "--duration",
        type=positive,
        default=10.0,
        metavar="S",
        help="time for the shape [s] (10)",
    )
    add(
        "--dt",
        type=positive,
        metavar="S",
        help="time between points [s] (0.02 for a shape)",
    )
    add("--unit", choices=METRES, help="unit of path and shape (that of x in the log)")
    _add_limits(command)
    add(
        "--tol",
        type=positive,
        default=0.1,
        metavar="MM",
        help="accepted error [mm] (0.1)",
    )
    _add_obstacles(command)
    _add_delay(command, "kept for `verify`; the commands do not depend on it (0)")
    where = "where the robot stands before the path (rest)"
    stand: Any = {"default": "rest", "dest": "start", "metavar": "rest|path|A,B,..."}
    add("--from", type=start, help=where, **stand)
    whole = "round commands to the whole numbers of the log, or to steps of STEP in its unit"
    add(
        "--round",
        nargs="?",
        type=positive,
        const=True,
        default=False,
        metavar="STEP",
        help=whole,
    )
    near = "write commands although points are missed: the tip goes as near as it can"
    add("--out-of-reach", action="store_true", help=near)
    add("--fail-missed", action="store_true", help="exit code 1 if a point is missed")
    add("--force", action="store_true", help=_REPLACE_OTHERS)


def _verify(command: argparse.ArgumentParser) -> None:
    """Compare what a track promised with what the robot did.

    Compares the error that the model promised with that of the measured tips, in parts of the path,
    and names the likely cause of a larger one: unit or axes of the tips, a late camera, a moved
    base, the zero, gain, sign or place of an actuator, a slip, a dead actuator, a payload,
    backlash, creep, misread rows, commands outside the log. It says how large the cause is, what
    explains as much, and which motion tells them apart.

    Some examples:
      hybridkin verify model track measured.csv
      hybridkin verify model track measured.csv --time stamp --out verification

    MEASURED has the columns of the log of the model, or those of the tip alone, one row for each
    row of the track. With other rows, --time names the column of the time: its first row is the
    first row of the track. Where the tips agree clearly better with earlier commands, the report
    says how late the camera is.
    """
    _add_model(command)
    _add_file(command, "track", "TRACK", "track.csv or its folder", or_folder=True)
    _add_file(command, "log", "MEASURED", "measured tips, with commands or without")
    _add_delay(command, "each is compared with the command of its time (that of the track)")
    _add_out(command, "folder for the report (none)")
    _add_log(command)


def _animate(command: argparse.ArgumentParser) -> None:
    """Make a film (gif, mp4) or an interactive page (html) of a track.

    It begins where the path begins, after the lead-in.

    Some examples:
      hybridkin animate model track --out track.gif
      hybridkin animate model track/track.csv --out track.html --frames 80
      hybridkin animate model track --out track.mp4           # needs the program ffmpeg
      hybridkin animate robot.toml log.csv --out log.gif      # the commands of a log
      hybridkin animate model track --obstacles scene.toml --out track.html
    """
    add = command.add_argument
    _add_model(command)
    _add_file(command, "track", "TRACK", "track.csv, its folder, or a log", or_folder=True)
    add(
        "--out",
        type=Path,
        required=True,
        metavar="FILE",
        help="file: .gif, .html, or .mp4 (needs ffmpeg)",
    )
    add("--unit", choices=METRES, default="mm", help="unit of the axes (mm)")
    add(
        "--speed",
        type=positive,
        default=1.0,
        metavar="F",
        help="speed; 1: real time (1)",
    )
    add(
        "--frames",
        type=count,
        default=150,
        metavar="N",
        help="largest number of frames (150)",
    )
    _add_file(command, "--obstacles", "SCENE.toml", "obstacles to show (none)")
    add("--force", action="store_true", help=_REPLACE_OTHERS)


def _export(command: argparse.ArgumentParser) -> None:
    """Write a model as C code, for MATLAB, or as a functional mock-up unit.

    Writes a header, a source file, a test and a CMakeLists.txt. The code needs only math.h. With
    --dt it also has the step of inverse kinematics, within the limits of the robot description and
    the training range. --fmu writes a unit for Simulink and other tools instead (FMI 3.0), --mex a
    C file and its help for MATLAB and Octave.

    Some examples:
      hybridkin export model --out robot_c --name robot
      hybridkin export model --out robot_c --name robot --dtype float32 --dt 0.001
      hybridkin export model --fmu robot.fmu --name robot --dt 0.01
      hybridkin export model --mex --out matlab --name robot --dt 0.01
      hybridkin export model --out robot_c --dt 0.01 --obstacles scene.toml --clearance 5mm
    """
    add = command.add_argument
    _add_model(command)
    where = command.add_mutually_exclusive_group(required=True)
    where.add_argument("--out", type=Path, metavar="DIR", help="folder for the code")
    where.add_argument("--fmu", type=Path, metavar="FILE", help="write this unit")
    add("--mex", action="store_true", help="for MATLAB and Octave")
    add("--name", default="model", help="name of files and functions (model)")
    add(
        "--dtype",
        choices=("float64", "float32"),
        default="float64",
        help="numbers (float64)",
    )
    add(
        "--dt",
        type=positive,
        metavar="S",
        help="control period [s] of the step (no step)",
    )
    add("--force", action="store_true", help=_REPLACE_OTHERS)
    _add_limits(command)
    _add_obstacles(command)


def _describe(command: argparse.ArgumentParser) -> None:
    """Describe a model, or check a log.

    For a model: its geometry, what it was fitted to, its domain, its errors and what was chosen.
    For a log, with --robot: what the check of the log finds.

    Some examples:
      hybridkin describe model
      hybridkin describe robot.toml
      hybridkin describe log.csv --robot robot.toml
    """
    _add_model(command, "log", "MODEL|ROBOT.toml|LOG", "model, robot description or log")
    _add_log(command)


def _add_file(
    command: argparse.ArgumentParser,
    name: str,
    metavar: str,
    text: str,
    *,
    or_folder: bool = False,
    **options: Any,
) -> None:
    """Add an argument that names a file to read, which `check_files` looks for."""
    action = command.add_argument(name, type=Path, metavar=metavar, help=text, **options)
    shown = name if name.startswith("-") else metavar
    files = {**command.get_default("files"), action.dest: _File(shown, or_folder)}
    command.set_defaults(files=files)


def check_files(arguments: argparse.Namespace) -> None:
    """Raise if a file to read does not exist, by the name of its argument in the help."""
    for name, file in arguments.files.items():
        path = getattr(arguments, name)
        if path is None:
            continue
        need = "file or a folder" if file.or_folder else "file"
        if not path.exists():
            raise FileNotFoundError(f"{file.shown} must be a {need}, there is none at {path}.")
        if path.is_dir() and not file.or_folder:
            raise IsADirectoryError(f"{file.shown} must be a file, got the folder {path}.")


def _add_out(command: argparse.ArgumentParser, text: str, required: bool = False) -> None:
    add = command.add_argument
    add("--out", type=Path, required=required, metavar="DIR", help=text)


def _add_path(command: argparse.ArgumentParser, text: str) -> None:
    add = command.add_argument
    _add_file(command, "--path", "PATH.csv", text)
    add("--dt", type=positive, metavar="S", help="time between points of the path [s]")
    add("--unit", choices=METRES, help="unit of the path (that of x in the log)")


def _add_limits(command: argparse.ArgumentParser) -> None:
    add = command.add_argument
    add(
        "--q-min",
        type=numbers,
        default=-math.inf,
        metavar="A,...",
        help="least q, in the unit and sign of the log",
    )
    largest = {
        "--q-max": "largest q",
        "--dq-max": "largest speed of q, per second",
        "--ddq-max": "largest acceleration, per second squared",
    }
    for name, text in largest.items():
        add(name, type=numbers, default=math.inf, metavar="A,...", help=text)


def _add_obstacles(command: argparse.ArgumentParser) -> None:
    """Add the scene around the robot, and the distance to it."""
    add = command.add_argument
    text = "obstacles that the whole body keeps clear of (none)"
    _add_file(command, "--obstacles", "SCENE.toml", text)
    text = "least distance between body and obstacles, such as 5mm (0)"
    add("--clearance", type=length, default=0.0, metavar="LENGTH", help=text)


def _add_model(
    command: argparse.ArgumentParser,
    name: str = "model",
    metavar: str = "MODEL",
    text: str = "model file, its folder, or a robot description",
) -> None:
    _add_file(command, name, metavar, text, or_folder=True)
    default = "robot description with [log] and [limits] (the one beside the model)"
    _add_file(command, "--robot", "ROBOT.toml", default)


_REPLACE_OTHERS = "replace files that another command or program wrote"


def _add_text_form(command: argparse._ActionsContainer) -> None:
    """Add the options of how a text file is written."""
    add = command.add_argument
    text = "separator of a text file (comma, semicolon or tab, by the header)"
    add("--delimiter", metavar="CHAR", help=text)
    text = (
        "line of the header of a text file, from 1 (blocks of Motive, Vicon and Qualisys are "
        "known, else line 1)"
    )
    add("--header-line", type=count, metavar="N", help=text)
    add("--decimal", choices=_DECIMALS, help="decimal sign of a text file (.)")
    text = "numbers that stand for missing values, such as 9999.999; 0: a marker at 0, 0, 0"
    add("--missing", type=numbers, metavar="A,...", help=text)


def _add_log(command: argparse.ArgumentParser) -> None:
    log = command.add_argument_group("log file; options replace [log] of the robot description")
    add = log.add_argument
    add("--q", type=names, metavar="A,B,...", help="columns of the actuators")
    add("--x", type=names, metavar="X,Y,Z", help="columns of the tip")
    add("--q-unit", choices=UNITS, help="unit of the actuators")
    add("--x-unit", choices=METRES, help="unit of the tip")
    pulled = "-1: a pulled tendon counts as positive; one, or one for each actuator"
    add("--q-sign", type=signs, metavar="SIGN", help=pulled)
    wraps = "correct encoders that wrap, lose turns, or read whole turns off; the period, such as "
    wraps += "4096 or 360 (without: usual ones)"
    add("--unwrap", type=positive, nargs="?", const=True, metavar="PERIOD", help=wraps)
    add(
        "--groups",
        metavar="COLUMN",
        help="column that names the motion of a row; or none",
    )
    text = "column that names the run, motions without a break between them; or none"
    add("--runs", metavar="COLUMN", help=text)
    add("--time", metavar="COLUMN", help="column of the time; or none")
    add("--time-unit", choices=(*SECONDS, FRAMES), help="unit of the time (s)")
    text = "frames per second, for --time-unit frames"
    add("--rate", type=positive, metavar="HZ", help=text)
    _add_text_form(log)
    text = "leave out motions by name, such as '*tendon*'; may be repeated"
    add("--exclude", action="append", default=[], metavar="PATTERN", help=text)
    add(
        "--drop-invalid",
        action="store_true",
        help="leave out rows with missing values or NaN",
    )
    add("--drop-frozen", action="store_true", help="leave out rows with a frozen tip")
    despite = f"go on despite errors in the log; {_REPLACE_OTHERS}"
    add("--force", action="store_true", help=despite)
