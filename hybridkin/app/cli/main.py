"""The command line: `hybridkin COMMAND`, or `python -m hybridkin COMMAND`."""

from __future__ import annotations

import argparse
import contextlib
import os
import shlex
import signal
import sys
import tempfile
import threading
import warnings
import webbrowser
from collections.abc import Iterator, Sequence
from dataclasses import fields, replace
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from threadpoolctl import threadpool_limits

import hybridkin  # its folders are opened when used: help comes at once
from hybridkin.app.cli import _demo as demo
from hybridkin.app.cli._init import answered, description, unused_columns, with_zeros
from hybridkin.app.cli._parser import check_files, failed, parser
from hybridkin.app.cli._terminal import Stages, write
from hybridkin.formats import FRAMES, METRES, check_outputs, visible, write_file

if TYPE_CHECKING:
    from hybridkin import (
        ForwardModel,
        HybridForwardModel,
        obstacles,
        robots,
        trajectories,
    )
    from hybridkin.app import LogReport
    from hybridkin.app.workflow import (
        Counts,
        PathLimits,
        Report,
    )
    from hybridkin.app.workflow.log import MeasuredLog
    from hybridkin.datasets import Log

_DT = 0.02
_LIGHT = ("describe", "init")  # commands that compute little
_INSIDE = 0.8  # least share of a path reached, and in the domain; else the exit code is 1
# What the user can correct is printed without a traceback.
_OF_INPUT = (ValueError, TypeError, OSError, ImportError, MemoryError)


_Result = tuple["Report[Any]", int]
"""The report of a command, and its exit code."""
_LISTED = 12  # columns that a log has and `init` does not use


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit code, see `hybridkin --help`."""
    arguments = parser().parse_args(argv)
    stages = Stages(arguments.quiet)
    try:
        check_files(arguments)
        with contextlib.closing(stages), warnings.catch_warnings():
            warnings.filterwarnings("default", category=UserWarning)
            warnings.showwarning = stages.warn
            # Loads the libraries whose threads are limited.
            if arguments.command in _LIGHT:
                _ = hybridkin.robots
            else:
                _ = hybridkin.HybridForwardModel
            # Several threads cost many times the CPU time: the matrices are small.
            with _interruptible(), threadpool_limits(limits=1):
                report, code = _RUN[arguments.command](arguments, stages)
    except _Terminated:
        return failed("interrupted", 143, arguments.json)
    except (KeyboardInterrupt, EOFError):  # EOFError: no answer to a question
        return failed("interrupted", 130, arguments.json)
    except _OF_INPUT as error:
        return failed(f"error: {error}", 2, arguments.json)
    text = report.json() if arguments.json else report.plain()
    if report.paths and not arguments.json:
        text = "\n  ".join([f"{text}\n\nWrote", *map(visible, report.paths)])
    try:
        write(text, sys.stdout)
    except BrokenPipeError:  # `head` has what it wants
        # For the flush at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    return code


class _Terminated(KeyboardInterrupt):
    """The process was asked to end."""


@contextlib.contextmanager
def _interruptible() -> Iterator[None]:
    """Let SIGTERM interrupt as SIGINT does, unless the caller handles these signals.

    An error after a signal is the interrupt: C code turns it into an ImportError during an import.
    """
    usual = {signal.SIGTERM: signal.SIG_DFL, signal.SIGINT: signal.default_int_handler}
    if threading.current_thread() is not threading.main_thread():
        usual = {}
    ours = [n for n, handler in usual.items() if signal.getsignal(n) is handler]
    caught: list[KeyboardInterrupt] = []

    def stop(number: int, _: object) -> None:
        caught.append(_Terminated() if number == signal.SIGTERM else KeyboardInterrupt())
        raise caught[-1]

    for number in ours:
        signal.signal(number, stop)
    try:
        yield
    except _OF_INPUT as error:
        if caught:
            raise caught[-1] from error
        raise
    finally:
        for number in ours:
            signal.signal(number, usual[number])


def _next(arguments: argparse.Namespace, stages: Stages) -> _Result:
    workflow = hybridkin.app.workflow
    model = _model_of(arguments)
    measured = None
    if arguments.log is not None:
        measured = _log_of(model, arguments, stages, chain=model.module_.robot)
        measured.check(arguments.force)
    report = workflow.next_rows(
        model,
        arguments.out,
        n=arguments.n,
        limits=_limits(arguments, model, within_fit=False),
        measured=measured,
        path=_path_of(arguments, model),
        force=arguments.force,
        progress=stages,
    )
    return report, 0


def _merge(arguments: argparse.Namespace, stages: Stages) -> _Result:
    stages("merging the recordings", 0, 1)
    report = hybridkin.app.workflow.merge_files(
        arguments.motors,
        arguments.camera,
        arguments.out,
        q=arguments.q,
        x=arguments.x,
        time=arguments.time,
        camera_time=arguments.camera_time,
        groups=arguments.groups,
        lag=arguments.lag,
        tolerance=arguments.tolerance,
        hold=arguments.hold,
        delimiter=arguments.delimiter,
        decimal=arguments.decimal or ".",
        missing=arguments.missing or (),
        force=arguments.force,
    )
    return report, 0


def _fit(arguments: argparse.Namespace, stages: Stages) -> _Result:
    robot = hybridkin.robots.read_description(arguments.robot)
    log_format = _log_format(arguments, robot.log, arguments.robot)
    hysteresis = arguments.hysteresis
    if isinstance(hysteresis, float):
        hysteresis = abs(log_format.q_factor * hysteresis).tolist()
    settings = hybridkin.app.workflow.FitSettings(
        loss=arguments.loss,
        coverage=arguments.coverage,
        n_folds=arguments.n_folds,
        auto=arguments.auto,
        hysteresis=hysteresis,
        max_rows=arguments.max_rows or None,
    )
    replaced = _replaced_model(arguments)
    log = _read(arguments, log_format, stages, robot.chain, robot.base_is_free)
    _note(log.report, stages)
    report = hybridkin.app.workflow.fit_log(
        log,
        robot,
        arguments.out,
        settings=settings,
        force=arguments.force,
        n_jobs=arguments.jobs,
        progress=stages,
    )
    if replaced:
        stages.note(f"Replaced {replaced}.", important=True)
    return report, 0


def _replaced_model(arguments: argparse.Namespace) -> str:
    """Return the model that a fit replaces, in words; raise if the user refuses on a terminal."""
    model = arguments.out / "model.safetensors"
    if not model.is_file():
        return ""
    words = f"the model of {datetime.fromtimestamp(model.stat().st_mtime):%Y-%m-%d %H:%M}"
    if sys.stdin.isatty() and not arguments.force and not arguments.json:
        question = f"Replace {words} in {visible(arguments.out)}? [y/N]: "
        write(question, sys.stderr, end="")
        if input().strip().lower() not in ("y", "yes"):
            raise FileExistsError(f"{arguments.out} keeps {words}; name another folder by --out.")
    return words


def _evaluate(arguments: argparse.Namespace, stages: Stages) -> _Result:
    model = _model_of(arguments)
    nominal = None if model.description_.created else model.module_.robot
    log = _log_of(model, arguments, stages, chain=nominal)
    _note(log.report.of_evaluation, stages)
    report = hybridkin.app.workflow.evaluate_log(model, log, arguments.out, force=arguments.force)
    mean = 1000.0 * report.record.judged.mean
    return report, int(mean > arguments.fail_above)


def _view(arguments: argparse.Namespace, stages: Stages) -> _Result:
    model = _model_of(arguments)
    log = None
    if arguments.log is not None:
        log = _log_of(model, arguments, stages, base_is_free=True)
    path = _path_of(arguments, model)
    limits = _scaled_limits(arguments, model)
    place = {"host": arguments.host, "port": arguments.port}
    around = {"obstacles": _scene(arguments), "clearance": arguments.clearance}
    options = {**vars(limits), **around, **place}
    with hybridkin.app.view(model, log, path=path, **options) as shown_robot:
        address = shown_robot.address
        words = f"{visible(model.description_.name)} is at {address}. Ctrl-C ends it."
        stages.note(words, important=True)
        if shown_robot.base_is_fitted:
            stages.note(
                "The base is fitted to the log, as the description leaves it open: the robot "
                "stands where its tips were measured.",
                important=True,
            )
        if not arguments.no_browser and "SSH_CONNECTION" not in os.environ:
            webbrowser.open(address)
        with contextlib.suppress(KeyboardInterrupt):
            shown_robot.wait()
    report = hybridkin.app.workflow.Report(
        f"View of {model.description_.name}", {"address": address}
    )
    report.text("The view is closed.")
    return report, 0


def _track(arguments: argparse.Namespace, stages: Stages) -> _Result:
    workflow = hybridkin.app.workflow
    model = _model_of(arguments)
    if (arguments.path is None) == (arguments.shape is None):
        raise ValueError("give either a file of points or --shape, one of the two.")
    log_format = model.description_.log
    limits = _limits(arguments, model)
    path = _path_of(arguments, model)
    if path is None:
        metre = METRES[arguments.unit or log_format.x_unit]
        center = arguments.center
        path = workflow.shape_path(
            model,
            limits,
            arguments.shape,
            np.multiply(metre, arguments.size or ()).tolist(),
            center=None if center is None else np.multiply(metre, center),
            normal=arguments.normal,
            turns=arguments.turns,
            rise=metre * arguments.rise,
            duration=arguments.duration,
            dt=arguments.dt or _DT,
        )
    start = arguments.start
    report = workflow.track_path(
        model,
        workflow.scaled_path(path, arguments.scale),
        arguments.out,
        limits=limits,
        start=start if isinstance(start, str) else log_format.from_log(start),
        tol=1e-3 * arguments.tol,
        delay=arguments.delay or 0.0,
        counts=_counts(arguments, model),
        out_of_reach=arguments.out_of_reach,
        obstacles=_scene(arguments),
        clearance=arguments.clearance,
        force=arguments.force,
        progress=stages,
    )
    track = report.record
    inside = track.in_domain is None or track.in_domain > _INSIDE
    enough = inside and track.reached > _INSIDE * track.n
    good = enough or arguments.out_of_reach
    if arguments.fail_missed:
        good = good and track.missed == 0
    return report, int(not good)


def _counts(arguments: argparse.Namespace, model: HybridForwardModel) -> Counts:
    """Return the numbers to which commands are rounded, any without `--round`."""
    Counts = hybridkin.app.workflow.Counts
    if not arguments.round:
        return Counts()
    if arguments.round is not True:
        n = model.n_features_in_
        return Counts([arguments.round] * n, [0.0] * n)
    counts = Counts.read(model.description_.training)
    if not counts:
        raise ValueError(
            "`--round` needs a model that was fitted by `hybridkin fit` to a log with whole "
            "numbers; give the step of the actuators in the unit of the log: --round 1."
        )
    return counts


def _verify(arguments: argparse.Namespace, stages: Stages) -> _Result:
    model = _model_of(arguments)
    log_format = _log_format(arguments, model.description_.log, arguments.model)
    log = _measured_track(arguments, replace(log_format, groups=None), stages)
    report = hybridkin.app.workflow.verify_track(
        model,
        arguments.track,
        log,
        arguments.out,
        delay=arguments.delay,
        force=arguments.force,
    )
    return report, int(report.record.kept is False)


def _measured_track(
    arguments: argparse.Namespace, log_format: robots.LogFormat, stages: Stages
) -> Log:
    """Return the measured tips of a track, with the commands where the file has them."""
    columns = hybridkin.datasets.log_columns(arguments.log, arguments.delimiter)
    # Columns of an array in an npz file are called name[0], name[1], ...
    held = {name.split("[")[0] for name in columns}
    if held & {name.split("[")[0] for name in log_format.q}:
        return _read(arguments, log_format, stages)
    stages.note("The file holds no commands: they are those of the track.")
    return hybridkin.app.workflow.read_tips(arguments.log, log_format, arguments.delimiter)


def _animate(arguments: argparse.Namespace, stages: Stages) -> _Result:
    report = hybridkin.app.workflow.animate_track(
        _model_of(arguments),
        arguments.track,
        arguments.out,
        unit=arguments.unit,
        speed=arguments.speed,
        n_frames=arguments.frames,
        obstacles=_scene(arguments),
        force=arguments.force,
        progress=stages,
    )
    return report, 0


def _export(arguments: argparse.Namespace, stages: Stages) -> _Result:
    model = _model_of(arguments)
    if arguments.fmu is not None:
        kind = "fmu"
    elif arguments.mex:
        kind = "mex"
    else:
        kind = "c"
    report = hybridkin.app.workflow.export_model(
        model,
        arguments.fmu or arguments.out,
        kind=kind,
        name=arguments.name,
        dtype=arguments.dtype,
        dt=arguments.dt,
        limits=None if arguments.dt is None else _limits(arguments, model),
        obstacles=_scene(arguments),
        clearance=arguments.clearance,
        force=arguments.force,
    )
    return report, 0


def _describe(arguments: argparse.Namespace, stages: Stages) -> _Result:
    workflow = hybridkin.app.workflow
    if arguments.log.suffix.lower() == ".toml":
        robot = hybridkin.robots.read_description(arguments.log)
        return workflow.description.describe_robot(robot), 0
    if not workflow.model.is_log(arguments.log):
        model = hybridkin.open_model(arguments.log, arguments.robot)
        return workflow.describe(model), 0
    if arguments.robot is None:
        raise ValueError(f"{arguments.log} is a log; name its robot: --robot ROBOT.toml.")
    robot = hybridkin.robots.read_description(arguments.robot)
    log_format = _log_format(arguments, robot.log, arguments.robot)
    log = _read(arguments, log_format, stages, robot.chain, robot.base_is_free)
    report = workflow.Report(f"Check of {arguments.log.name}", log.report)
    report.verbatim(str(log.report))
    return report, int(not log.report.ok)


def _init(arguments: argparse.Namespace, stages: Stages) -> _Result:
    workflow = hybridkin.app.workflow
    out = arguments.out
    # Its file is made to be edited: it is the user's, and not one of an earlier `init`.
    check_outputs([out], "init", lambda _: False, force=arguments.force)
    options = vars(arguments)
    answers, missing = answered(options, ask=False)
    if missing and sys.stdin.isatty() and not arguments.json:
        answers, missing = answered(options, ask=True)
    if missing:
        raise ValueError(
            f"`init` needs {', '.join(missing)} where it cannot ask on a terminal; see "
            "`hybridkin init --help`."
        )
    text = description(answers, out.stem)
    robot = _robot_of(text)
    log_format: robots.LogFormat = robot.log
    check = None
    unused = []
    about_zeros = ""
    log = answers["log"]
    if log is not None:
        measured = _log_of_init(arguments, log, robot)
        answers, about_zeros = with_zeros(answers, measured)
        if "zeros" in answers:
            text = description(answers, out.stem)
            robot = _robot_of(text)
            measured = _log_of_init(arguments, log, robot)
        check = measured.report
        _note(check, stages)
        unused = unused_columns(answers, options)
    record = {"columns": log_format, "log_check": check}
    report = workflow.Report(f"{robot.name}: {robot.n_actuators} actuators", record)
    look = ["hybridkin", "view", str(out)]
    if log is not None:
        look.append(str(log))
    fit = ["hybridkin", "fit", str(log or "log.csv"), "--robot", str(out)]
    report.text(
        "Columns: actuators {q}; tip {x}; motion {groups}.",
        "Read through {out}, and look whether every actuator bends the robot the right way:\n"
        "$ {look}",
        "Then fit a model:\n$ {fit} --out model",
        q=", ".join(log_format.q),
        x=", ".join(log_format.x),
        groups=log_format.groups or "(none)",
        out=out,
        look=shlex.join(look),
        fit=shlex.join(fit),
    )
    if unused:
        report.text(
            "Columns not used: {unused}. If one names the motion of a row, or its time, run this "
            "again with --groups COLUMN, --time COLUMN and --force.",
            unused=", ".join(unused[:_LISTED]) + ", ..." * (len(unused) > _LISTED),
        )
    if about_zeros:
        report.text(about_zeros)
    check_outputs([out], "init", lambda _: False, force=arguments.force)
    write_file(out, partial(Path.write_text, data=text, encoding="utf-8"))
    report.paths = [out]
    return report, int(check is not None and not check.ok)


def _log_of_init(arguments: argparse.Namespace, log: Path, robot: Any) -> MeasuredLog:
    """Return the log of a new description, read and checked."""
    return hybridkin.app.workflow.read_log(
        log,
        robot.log,
        chain=robot.chain,
        base_is_free=robot.base_is_free,
        delimiter=arguments.delimiter,
    )


def _robot_of(text: str) -> Any:
    """Return the robot of a description that is not written yet: errors leave no file."""
    with tempfile.TemporaryDirectory() as folder:
        draft = Path(folder) / "robot.toml"
        draft.write_text(text, encoding="utf-8")
        try:
            return hybridkin.robots.read_description(draft)
        except ValueError as error:
            raise ValueError(str(error).removeprefix(f"{draft}: ")) from error


def _demo(arguments: argparse.Namespace, stages: Stages) -> _Result:
    out = arguments.out
    if out.exists() and not (out.is_dir() and not [*out.iterdir()]):
        raise FileExistsError(f"{out} is not an empty folder; name another one by --out.")
    out.mkdir(parents=True, exist_ok=True)
    stages.note("The data of this demo are simulated; no robot was measured.")
    demo.write_log(out / "log.csv")
    paths = [out / "log.csv"]
    worst = 0
    records = {}
    for command, what in demo.steps(out).items():
        stages.note(f"\n{what}\n$ hybridkin {command}")
        parsed = parser().parse_args(shlex.split(command))
        step, code = _RUN[parsed.command](parsed, stages)
        records[parsed.command] = step.record
        paths += step.paths
        worst = max(worst, code)
    report = demo.summary(out, records)
    report.paths = paths
    return report, worst


_COMMANDS = (
    _merge,
    _next,
    _fit,
    _evaluate,
    _view,
    _track,
    _verify,
    _animate,
    _export,
    _describe,
    _init,
    _demo,
)
_RUN = {command.__name__[1:]: command for command in _COMMANDS}


def _scene(arguments: argparse.Namespace) -> list[obstacles.Obstacle]:
    """Return the obstacles of the file that the arguments name; none without."""
    if arguments.obstacles is None:
        return []
    return hybridkin.obstacles.read_scene(arguments.obstacles)


def _model_of(arguments: argparse.Namespace) -> HybridForwardModel:
    """Return the model that the arguments name."""
    return hybridkin.open_model(arguments.model, arguments.robot)


def _limits(
    arguments: argparse.Namespace, model: HybridForwardModel, **options: bool
) -> PathLimits:
    """Return the limits of a track with what the arguments say."""
    scaled = _scaled_limits(arguments, model)
    return hybridkin.app.workflow.path_limits(model, **vars(scaled), **options)


def _scaled_limits(arguments: argparse.Namespace, model: HybridForwardModel) -> robots.Limits:
    """Return the limits of the arguments, in the log's unit and sign, which may swap the ends."""
    limits = hybridkin.robots.Limits(
        arguments.q_min, arguments.q_max, arguments.dq_max, arguments.ddq_max
    )
    return limits.scaled(model.description_.log.q_factor)


def _note(found: LogReport, stages: Stages) -> None:
    """Print what the check of a log found."""
    stages.note(f"{found}\n", important=bool(found.errors or found.warnings))


def _path_of(
    arguments: argparse.Namespace, model: HybridForwardModel
) -> trajectories.Trajectory | None:
    """Return the path of the tip that the arguments name; None without."""
    if arguments.path is None:
        return None
    unit = arguments.unit or model.description_.log.x_unit
    return hybridkin.trajectories.from_csv(arguments.path, unit=unit, dt=arguments.dt)


def _log_of(
    model: HybridForwardModel,
    arguments: argparse.Namespace,
    stages: Stages,
    chain: ForwardModel | None = None,
    base_is_free: bool = False,
) -> MeasuredLog:
    """Return the log of the arguments in the format of a model's robot."""
    described = model.description_.robot.log
    log_format = _log_format(arguments, described, arguments.model)
    return _read(arguments, log_format, stages, chain, base_is_free)


def _read(
    arguments: argparse.Namespace,
    log_format: robots.LogFormat,
    stages: Stages,
    chain: ForwardModel | None = None,
    base_is_free: bool = False,
) -> MeasuredLog:
    """Return the log of the arguments, read and checked."""
    stages("reading and checking the log", 0, 1)
    return hybridkin.app.workflow.read_log(
        arguments.log,
        log_format,
        chain=chain,
        base_is_free=base_is_free,
        exclude=arguments.exclude,
        drop_invalid=arguments.drop_invalid,
        drop_frozen=arguments.drop_frozen,
        delimiter=arguments.delimiter,
    )


def _log_format(
    arguments: argparse.Namespace, described: robots.LogFormat | None, source: Path
) -> robots.LogFormat:
    """Return how the log is written: as described, with what the options say instead."""
    entries = {}
    if arguments.time_unit not in (None, FRAMES):
        entries["rate"] = None  # that of the description is one of frames
    options = vars(arguments)
    names = [field.name for field in fields(hybridkin.robots.LogFormat) if field.name in options]
    for name in names:
        if options[name] is not None:
            entries[name] = None if options[name] == "none" else options[name]
    if described is not None:
        return replace(described, **entries)
    if "q" not in entries or "x" not in entries:
        raise ValueError(
            f"{source} does not say how logs are written: it has no [log] table, as in "
            "help(hybridkin.robots.read_description); or name the columns by --q and --x."
        )
    return hybridkin.robots.LogFormat(**entries)
