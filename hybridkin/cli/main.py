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
from dataclasses import replace
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

import hybridkin  # its folders are opened when used: help comes at once
from hybridkin._core.files import write_file
from hybridkin._core.turns import one_thread
from hybridkin._core.units import METRES
from hybridkin.cli import _demo as demo
from hybridkin.cli._init import answered, description
from hybridkin.cli._parser import failed, parser
from hybridkin.cli._terminal import Stages, shown

if TYPE_CHECKING:
    from hybridkin.chains.chain import Chain
    from hybridkin.chains.robots import Limits, LogFormat
    from hybridkin.datasets import LogReport
    from hybridkin.workflow import LoadedModel, MeasuredLog, PathLimits

_DT = 0.02
_INSIDE = 0.8  # least share of a path in the domain, else the exit code is 1
# What the user can correct is printed without a traceback.
_OF_INPUT = (ValueError, TypeError, OSError, ImportError, MemoryError)


class _Outcome(NamedTuple):
    record: dict[str, Any]
    text: str
    paths: Sequence[Path] = ()
    code: int = 0


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit code, see `hybridkin --help`."""
    arguments = parser().parse_args(argv)
    before = _stamps(arguments)
    try:
        stages = Stages(arguments.quiet)
        # Several threads cost many times the CPU time: the matrices are small.
        _ = hybridkin.workflow  # loads the libraries whose threads are limited
        with (
            contextlib.closing(stages),
            warnings.catch_warnings(),
            _interruptible(),
            one_thread(),
        ):
            warnings.filterwarnings("default", category=UserWarning)
            warnings.showwarning = stages.warn
            outcome = _RUN[arguments.command](arguments, stages)
    except (KeyboardInterrupt, EOFError) as stop:  # EOFError: no answer to a question
        if _stamps(arguments) == before:
            fate = "nothing was written"
        else:
            fate = "files were written"
        code = 143 if isinstance(stop, _Terminated) else 130
        return failed(f"interrupted; {fate}", code, arguments.json)
    except _OF_INPUT as error:
        return failed(f"error: {error}", 2, arguments.json)
    text = outcome.text
    paths = [*map(str, outcome.paths)]
    if arguments.json:
        written = {"written": paths} if paths else {}
        text = hybridkin.workflow.json_text({**outcome.record, **written})
    elif paths:
        text = "\n  ".join([f"{text}\n\nWrote", *paths])
    try:
        print(text, flush=True)
    except OSError as error:
        # For the flush at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        if not isinstance(
            error, BrokenPipeError
        ):  # `head`, for example, has what it wants
            return failed(
                f"error: the result cannot be printed: {error}", 2, as_json=False
            )
    return outcome.code


class _Terminated(KeyboardInterrupt):
    """The process was asked to end."""


@contextlib.contextmanager
def _interruptible() -> Iterator[None]:
    """Let SIGTERM interrupt as SIGINT does, unless the caller handles these signals.

    An error after a signal is the interrupt: C code turns it into an ImportError during an import.
    """
    usual = {signal.SIGTERM: signal.SIG_DFL, signal.SIGINT: signal.default_int_handler}
    in_main_thread = threading.current_thread() is threading.main_thread()
    ours = [
        n
        for n, handler in usual.items()
        if in_main_thread and signal.getsignal(n) is handler
    ]
    caught: list[KeyboardInterrupt] = []

    def stop(number: int, _: object) -> None:
        caught.append(
            _Terminated() if number == signal.SIGTERM else KeyboardInterrupt()
        )
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


def _stamps(arguments: argparse.Namespace) -> dict[Path, tuple[int, int]]:
    """Return the files of --out, each with its number and time on the disk."""
    out = vars(arguments).get("out") or Path(os.devnull)
    stamps = {}
    for file in out.glob("[!.]*") if out.is_dir() else [out]:
        if file.is_file():
            stamps[file] = (file.stat().st_ino, file.stat().st_mtime_ns)
    return stamps


def _next(arguments: argparse.Namespace, stages: Stages) -> _Outcome:
    workflow = hybridkin.workflow
    loaded = workflow.open_model(arguments.model, arguments.robot)
    measured = path = None
    if arguments.log is not None:
        robot_format = None if loaded.description is None else loaded.description.log
        log_format = _log_format(arguments, robot_format, arguments.model)
        measured = _read(arguments, log_format, loaded.chain, False, stages)
        measured.check(arguments.force)
    if arguments.path is not None:
        unit = arguments.unit or loaded.log_format().x_unit
        path = workflow.read_path(arguments.path, unit=unit, dt=arguments.dt)
    report, paths = workflow.next_rows(
        loaded,
        arguments.out,
        n=arguments.n,
        limits=_limits(arguments, loaded, within_fit=False),
        measured=measured,
        path=path,
        force=arguments.force,
        progress=stages,
    )
    return _Outcome(report.record, shown(report), paths)


def _fit(arguments: argparse.Namespace, stages: Stages) -> _Outcome:
    robot = hybridkin.robots.read_description(arguments.robot)
    log_format = _log_format(arguments, robot.log, arguments.robot)
    play = arguments.play
    names = ("loss", "coverage", "n_folds", "auto")
    settings = hybridkin.workflow.FitSettings(
        **{name: vars(arguments)[name] for name in names},
        play=abs(log_format.q_factor * play).tolist()
        if isinstance(play, float)
        else play,
        max_rows=arguments.max_rows or None,
    )
    before = _model_before(arguments)
    log = _read(arguments, log_format, robot.chain, robot.base_is_free, stages)
    _note(log.report, stages)
    report, paths = hybridkin.workflow.fit_log(
        log,
        robot,
        arguments.out,
        settings=settings,
        force=arguments.force,
        n_jobs=arguments.jobs,
        progress=stages,
    )
    if before:
        stages.note(f"Replaced {before}.", important=True)
    return _Outcome(report.record, shown(report), paths)


def _model_before(arguments: argparse.Namespace) -> str:
    """Return the model that a fit replaces, in words; raise if the user refuses on a terminal."""
    model = arguments.out / "model.safetensors"
    if not model.is_file():
        return ""
    words = (
        f"the model of {datetime.fromtimestamp(model.stat().st_mtime):%Y-%m-%d %H:%M}"
    )
    if sys.stdin.isatty() and not arguments.force and not arguments.json:
        print(
            f"Replace {words} in {arguments.out}? [y/N]: ",
            end="",
            file=sys.stderr,
            flush=True,
        )
        if input().strip().lower() not in ("y", "yes"):
            raise FileExistsError(
                f"{arguments.out} keeps {words}; name another folder by --out."
            )
    return words


def _evaluate(arguments: argparse.Namespace, stages: Stages) -> _Outcome:
    loaded = hybridkin.workflow.open_model(arguments.model, arguments.robot)
    robot_format = None if loaded.description is None else loaded.description.log
    nominal = loaded.chain if loaded.header is None else None
    log_format = _log_format(arguments, robot_format, arguments.model)
    log = _read(arguments, log_format, nominal, False, stages)
    _note(log.report, stages)
    report, paths = hybridkin.workflow.evaluate_log(
        loaded, log, arguments.out, force=arguments.force
    )
    # Of rows that were fitted the errors on held-out motions count.
    judged = next(filter(None, map(report.record.get, ("new", "held_out", "all"))))
    limit = arguments.fail_above
    code = 1 if limit is not None and 1000 * judged["mean"] > limit else 0
    return _Outcome(report.record, shown(report), paths, code)


def _view(arguments: argparse.Namespace, stages: Stages) -> _Outcome:
    loaded = hybridkin.workflow.open_model(arguments.model, arguments.robot)
    log = None
    if arguments.log is not None:
        robot_format = None if loaded.description is None else loaded.description.log
        log_format = _log_format(arguments, robot_format, arguments.model)
        log = _read(arguments, log_format, None, True, stages)
    path = None
    if arguments.path is not None:
        unit = arguments.unit or loaded.log_format().x_unit
        path = hybridkin.workflow.read_path(arguments.path, unit=unit, dt=arguments.dt)
    limits = _scaled_limits(arguments, loaded)
    place = {"host": arguments.host, "port": arguments.port}
    with hybridkin.view(loaded, log, path=path, **vars(limits), **place) as shown_robot:
        address = shown_robot.address
        stages.note(f"{loaded.name} is at {address}. Ctrl-C ends it.", important=True)
        if not arguments.no_browser and "SSH_CONNECTION" not in os.environ:
            webbrowser.open(address)
        with contextlib.suppress(KeyboardInterrupt):
            shown_robot.wait()
    return _Outcome({"address": address}, "The view is closed.")


def _track(arguments: argparse.Namespace, stages: Stages) -> _Outcome:
    workflow = hybridkin.workflow
    loaded = workflow.open_model(arguments.model, arguments.robot)
    log_format = loaded.log_format()
    if (arguments.path is None) == (arguments.shape is None):
        raise ValueError("give either a file of points or --shape, one of the two.")
    limits = _limits(arguments, loaded)
    unit = arguments.unit or log_format.x_unit
    if arguments.path is not None:
        path = workflow.read_path(arguments.path, unit=unit, dt=arguments.dt)
    else:
        center = arguments.center
        metre = METRES[unit]
        path = workflow.shape_path(
            loaded,
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
    report, paths = workflow.track_path(
        loaded,
        workflow.scaled_path(path, arguments.scale),
        arguments.out,
        limits=limits,
        start=start if isinstance(start, str) else log_format.from_log(start),
        tol=1e-3 * arguments.tol,
        force=arguments.force,
        progress=stages,
    )
    record = report.record
    inside = (
        arguments.force or record["in_domain"] is None or record["in_domain"] > _INSIDE
    )
    code = 0 if inside and record["reached"] == record["n"] else 1
    return _Outcome(record, shown(report), paths, code)


def _verify(arguments: argparse.Namespace, stages: Stages) -> _Outcome:
    loaded = hybridkin.workflow.open_model(arguments.model, arguments.robot)
    log_format = _log_format(arguments, loaded.log_format(), arguments.model)
    log = _read(arguments, replace(log_format, groups=None), None, False, stages)
    report, paths = hybridkin.workflow.verify_track(
        loaded, arguments.track, log, arguments.out, force=arguments.force
    )
    code = 1 if report.record["kept"] is False else 0
    return _Outcome(report.record, shown(report), paths, code)


def _animate(arguments: argparse.Namespace, stages: Stages) -> _Outcome:
    record = hybridkin.workflow.animate_track(
        hybridkin.workflow.open_model(arguments.model, arguments.robot),
        arguments.track,
        arguments.out,
        unit=arguments.unit,
        speed=arguments.speed,
        n_frames=arguments.frames,
        progress=stages,
    )
    speed = f"{record['fps']:.3g} a second"
    size = f"{record['bytes'] / 1e6:.2f} MB"
    return _Outcome(
        record, f"{record['frames']} frames, {speed}, {size}", [arguments.out]
    )


def _export(arguments: argparse.Namespace, stages: Stages) -> _Outcome:
    loaded = hybridkin.workflow.open_model(arguments.model, arguments.robot)
    report, paths = hybridkin.workflow.export_model(
        loaded,
        arguments.out,
        name=arguments.name,
        dtype=arguments.dtype,
        dt=arguments.dt,
        limits=None if arguments.dt is None else _limits(arguments, loaded),
    )
    return _Outcome(report.record, shown(report), paths)


def _describe(arguments: argparse.Namespace, stages: Stages) -> _Outcome:
    if arguments.log.suffix.lower() not in hybridkin.workflow.LOG_SUFFIXES:
        loaded = hybridkin.workflow.open_model(arguments.log, arguments.robot)
        report = hybridkin.workflow.describe(loaded)
        return _Outcome(report.record, shown(report))
    if arguments.robot is None:
        raise ValueError(
            f"{arguments.log} is a log; name its robot: --robot ROBOT.toml."
        )
    robot = hybridkin.robots.read_description(arguments.robot)
    log_format = _log_format(arguments, robot.log, arguments.robot)
    check = _read(arguments, log_format, robot.chain, robot.base_is_free, stages).report
    return _Outcome(check.to_dict(), str(check), code=0 if check.ok else 1)


def _init(arguments: argparse.Namespace, stages: Stages) -> _Outcome:
    out = arguments.out
    given = vars(arguments)
    if out.exists() and not arguments.force:
        raise FileExistsError(
            f"{out} exists; name another file, or replace it with --force."
        )
    answers, missing = answered(given, ask=False)
    if missing and sys.stdin.isatty() and not arguments.json:
        answers, missing = answered(given, ask=True)
    if missing:
        need = f"`init` needs {', '.join(missing)} where it cannot ask on a terminal"
        raise ValueError(f"{need}; see `hybridkin init --help`.")
    text = description(answers, out.stem)
    log = answers["log"]
    code = 0
    with tempfile.TemporaryDirectory() as folder:  # errors leave no file
        draft = Path(folder) / "robot.toml"
        draft.write_text(text, encoding="utf-8")
        try:
            robot = hybridkin.robots.read_description(draft)
        except ValueError as error:
            raise ValueError(str(error).removeprefix(f"{draft}: ")) from error
    log_format: Any = robot.log
    report = hybridkin.workflow.Report(f"{robot.name}: {robot.n_actuators} actuators")
    report.record.update(columns=vars(log_format), log_check=None)
    q = ", ".join(log_format.q)
    x = ", ".join(log_format.x)
    report.text(
        f"Columns: actuators {q}; tip {x}; motion {log_format.groups or '(none)'}."
    )
    if log is not None:
        options = {"base_is_free": robot.base_is_free, "delimiter": arguments.delimiter}
        read = hybridkin.workflow.read_log(
            log, log_format, chain=robot.chain, **options
        )
        _note(read.report, stages)
        report.record["log_check"] = read.report.to_dict()
        code = 0 if read.report.ok else 1
    log_name, robot_name = (shlex.quote(str(path)) for path in (log or "log.csv", out))
    fit = f"hybridkin fit {log_name} --robot {robot_name} --out model"
    look = shlex.join(["hybridkin", "view", str(out), *map(str, filter(None, [log]))])
    report.text(
        f"Read through {out}, and look whether every actuator bends the robot the "
        f"right way:\n$ {look}",
        f"Then fit a model:\n$ {fit}",
    )
    write_file(out, partial(Path.write_text, data=text, encoding="utf-8"))
    return _Outcome(report.record, shown(report), [out], code)


def _demo(arguments: argparse.Namespace, stages: Stages) -> _Outcome:
    out = arguments.out
    done = {}
    if out.exists() and not (out.is_dir() and not [*out.iterdir()]):
        raise FileExistsError(
            f"{out} is not an empty folder; name another one by --out."
        )
    out.mkdir(parents=True, exist_ok=True)
    stages.note("The data of this demo are simulated; no robot was measured.")
    demo.write_log(out / "log.csv")
    for command, what in demo.steps(out).items():
        stages.note(f"\n{what}\n$ hybridkin {command}")
        parsed = parser().parse_args(shlex.split(command))
        done[parsed.command] = _RUN[parsed.command](parsed, stages)
    report = demo.summary(out, {name: outcome.record for name, outcome in done.items()})
    paths = [path for outcome in done.values() for path in outcome.paths]
    code = max(outcome.code for outcome in done.values())
    return _Outcome(report.record, shown(report), [out / "log.csv", *paths], code)


_COMMANDS = (
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


def _limits(
    arguments: argparse.Namespace, loaded: LoadedModel, **options: bool
) -> PathLimits:
    """Return the limits of a track with what the arguments say."""
    scaled = _scaled_limits(arguments, loaded)
    return hybridkin.workflow.path_limits(loaded, **vars(scaled), **options)


def _scaled_limits(arguments: argparse.Namespace, loaded: LoadedModel) -> Limits:
    """Return the limits of the arguments, in the log's unit and sign, which may swap the ends."""
    limits = {
        name: vars(arguments)[name] for name in ("q_min", "q_max", "dq_max", "ddq_max")
    }
    return hybridkin.robots.Limits(**limits).scaled(loaded.log_format().q_factor)


def _note(found: LogReport, stages: Stages) -> None:
    """Print what the check of a log found."""
    stages.note(f"{found}\n", important=bool(found.errors or found.warnings))


def _read(
    arguments: argparse.Namespace,
    log_format: LogFormat,
    chain: Chain | None,
    base_is_free: bool,
    stages: Stages,
) -> MeasuredLog:
    """Return the log of the arguments, read and checked."""
    stages("reading and checking the log", 0, 1)
    names = ("exclude", "drop_invalid", "drop_frozen", "delimiter")
    options = {name: vars(arguments)[name] for name in names}
    return hybridkin.workflow.read_log(
        arguments.log, log_format, chain=chain, base_is_free=base_is_free, **options
    )


def _log_format(
    arguments: argparse.Namespace, known: LogFormat | None, source: Path
) -> LogFormat:
    """Return how the log is written: what is known, with what the options say instead."""
    names = ("q", "x", "q_unit", "x_unit", "q_sign", "groups", "time")
    entries = {name: vars(arguments)[name] for name in names}
    entries = {name: value for name, value in entries.items() if value is not None}
    entries |= {
        name: None for name in ("groups", "time") if entries.get(name) == "none"
    }
    if known is not None:
        return replace(known, **entries)
    if "q" not in entries or "x" not in entries:
        raise ValueError(
            f"{source} does not say how logs are written: it has no [log] table, as in "
            "help(hybridkin.robots.read_description); or name the columns by --q and --x."
        )
    return hybridkin.robots.LogFormat(**entries)
