"""The command line: `hybridkin COMMAND`, or `python -m hybridkin COMMAND`."""

from __future__ import annotations

import argparse
import contextlib
import os
import re
import signal
import sys
import threading
import time
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from tqdm import tqdm

import hybridkin  # its folders are opened when used: help comes at once
from hybridkin._core.units import METRES
from hybridkin.cli._parser import failed, parser

if TYPE_CHECKING:
    from hybridkin.chains.chain import Chain
    from hybridkin.chains.robots import LogFormat
    from hybridkin.workflow import LoadedModel, MeasuredLog, PathLimits

_DT = 0.02
# What the user can correct is printed without a traceback.
_OF_INPUT = (ValueError, TypeError, OSError, ImportError, MemoryError)
_PATIENCE = 15.0  # seconds between two lines of progress in files and pipes


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
        with contextlib.closing(_Bars()) as bars, warnings.catch_warnings(), _terminable():
            warnings.filterwarnings("default", category=UserWarning)
            warnings.showwarning = bars.warn
            outcome = _RUN[arguments.command](arguments, bars)
    except KeyboardInterrupt as stop:
        fate = "nothing was written" if _stamps(arguments) == before else "all was written"
        code = 143 if isinstance(stop, _Terminated) else 130
        return failed(f"interrupted; {fate}", code, arguments.json)
    except (*_OF_INPUT, hybridkin.simulation.NotSettledError) as error:
        return failed(f"error: {error}", 2, arguments.json)
    written = "\n  ".join(["\n\nWrote", *map(str, outcome.paths)]) if outcome.paths else ""
    text = outcome.text + written
    if arguments.json:
        more = {"written": [*map(str, outcome.paths)]} if outcome.paths else {}
        text = hybridkin.workflow.json_text({**outcome.record, **more})
    try:
        print(text, flush=True)
    except BrokenPipeError:  # the reader, `head` for example, has what it wants
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # for the flush at exit
    return outcome.code


class _Terminated(KeyboardInterrupt):
    """The process was asked to end."""


@contextlib.contextmanager
def _terminable() -> Iterator[None]:
    """Let SIGTERM interrupt as SIGINT does, unless the caller handles it."""
    ours = threading.current_thread() is threading.main_thread()
    if not ours or signal.getsignal(signal.SIGTERM) is not signal.SIG_DFL:
        yield
        return

    def stop(*_: Any) -> None:
        raise _Terminated

    signal.signal(signal.SIGTERM, stop)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, signal.SIG_DFL)


def _stamps(arguments: argparse.Namespace) -> dict[Path, tuple[int, int]]:
    """Return the files of --out, each with its number and time on the disk."""
    out = vars(arguments).get("out") or Path(os.devnull)
    files = [file for file in (out.glob("[!.]*") if out.is_dir() else [out]) if file.is_file()]
    return {file: (file.stat().st_ino, file.stat().st_mtime_ns) for file in files}


class _Bars:
    """Progress bars on standard error, one for each kind of work, and warnings between them."""

    def __init__(self) -> None:
        self._bar: Any = None
        self._what: str | None = None
        self._seen: set[str] = set()
        self._said = time.monotonic()

    def __call__(self, what: str, done: int, total: int) -> None:
        if self._what != what:
            self.close()
            self._what = what
            # None: no bars in files and pipes
            self._bar = tqdm(total=total, desc=what, file=sys.stderr, disable=None)
        self._bar.update(done - self._bar.n)
        if self._bar.disable and time.monotonic() > self._said + _PATIENCE:
            self._said = time.monotonic()
            print(f"hybridkin: {what}: {done} of {total}", file=sys.stderr)

    def warn(self, message: Any, *_: Any) -> None:
        """Print a warning, of those that differ in numbers only the first."""
        text = str(message)
        kind = re.sub(r"[\d.]+", "", text)
        if kind not in self._seen:
            self._seen.add(kind)
            tqdm.write(f"hybridkin: warning: {text}", file=sys.stderr)

    def close(self) -> None:
        if self._bar is not None:
            self._bar.close()
        self._bar = self._what = None


def _paper(arguments: argparse.Namespace, bars: _Bars) -> _Outcome:
    report, paths = hybridkin.paper.run_paper(
        arguments.out,
        n_splits=arguments.splits,
        n_seeds=arguments.n_seeds,
        n_points=arguments.points,
        n_jobs=arguments.jobs,
        progress=bars,
    )
    return _Outcome(report.record, report.plain(), paths)


def _next(arguments: argparse.Namespace, bars: _Bars) -> _Outcome:
    workflow = hybridkin.workflow
    loaded = workflow.open_model(arguments.model, arguments.robot)
    measured = path = None
    if arguments.log is not None:
        known = None if loaded.description is None else loaded.description.log
        log_format = _log_format(arguments, known, arguments.model)
        measured = _read(arguments, log_format, loaded.chain, False)
        measured.check(arguments.force)
    if arguments.path is not None:
        unit = arguments.unit or loaded.log_format().x_unit
        path = workflow.read_path(arguments.path, unit=unit, dt=arguments.dt)
    options = {"n": arguments.n, "measured": measured, "path": path, "progress": bars}
    limits = _limits(arguments, loaded, within_fit=False)
    report, paths = workflow.next_rows(loaded, arguments.out, limits=limits, **options)
    return _Outcome(report.record, report.plain(), paths)


def _fit(arguments: argparse.Namespace, bars: _Bars) -> _Outcome:
    robot = hybridkin.robots.read_description(arguments.robot)
    log_format = _log_format(arguments, robot.log, arguments.robot)
    play = arguments.play
    names = ("loss", "coverage", "n_folds", "n_seeds", "auto")
    settings = hybridkin.workflow.FitSettings(
        **{name: vars(arguments)[name] for name in names},
        play=abs(log_format.q_factor * play).tolist() if isinstance(play, float) else play,
        max_rows=arguments.max_rows or None,
    )
    log = _read(arguments, log_format, robot.chain, robot.base_is_free)
    print(f"{log.report}\n", file=sys.stderr)
    report, paths = hybridkin.workflow.fit_log(
        log,
        robot,
        arguments.out,
        settings=settings,
        force=arguments.force,
        n_jobs=arguments.jobs,
        progress=bars,
    )
    return _Outcome(report.record, report.plain(), paths)


def _evaluate(arguments: argparse.Namespace, bars: _Bars) -> _Outcome:
    loaded = hybridkin.workflow.open_model(arguments.model, arguments.robot)
    known = None if loaded.description is None else loaded.description.log
    nominal = loaded.chain if loaded.header is None else None
    log_format = _log_format(arguments, known, arguments.model)
    log = _read(arguments, log_format, nominal, False)
    print(f"{log.report}\n", file=sys.stderr)
    report, paths = hybridkin.workflow.evaluate_log(
        loaded, log, arguments.out, force=arguments.force
    )
    # Of rows that were fitted the errors on held-out motions count.
    judged = next(filter(None, map(report.record.get, ("new", "held_out", "all"))))
    limit = arguments.fail_above
    code = 1 if limit is not None and 1000 * judged["mean"] > limit else 0
    return _Outcome(report.record, report.plain(), paths, code)


def _track(arguments: argparse.Namespace, bars: _Bars) -> _Outcome:
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
        center, metre = arguments.center, METRES[unit]
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
        start=start if isinstance(start, str) else np.multiply(start, log_format.q_factor),
        tol=1e-3 * arguments.tol,
        force=arguments.force,
        progress=bars,
    )
    code = 0 if report.record["reached"] == report.record["n"] else 1
    return _Outcome(report.record, report.plain(), paths, code)


def _animate(arguments: argparse.Namespace, bars: _Bars) -> _Outcome:
    record = hybridkin.workflow.animate_track(
        hybridkin.workflow.open_model(arguments.model, arguments.robot),
        arguments.track,
        arguments.out,
        unit=arguments.unit,
        speed=arguments.speed,
        n_frames=arguments.frames,
        progress=bars,
    )
    speed, size = f"{record['fps']:.3g} a second", f"{record['bytes'] / 1e6:.2f} MB"
    return _Outcome(record, f"{record['frames']} frames, {speed}, {size}", [arguments.out])


def _export(arguments: argparse.Namespace, bars: _Bars) -> _Outcome:
    loaded = hybridkin.workflow.open_model(arguments.model, arguments.robot)
    report, paths = hybridkin.workflow.export_model(
        loaded,
        arguments.out,
        name=arguments.name,
        dtype=arguments.dtype,
        dt=arguments.dt,
        limits=None if arguments.dt is None else _limits(arguments, loaded),
    )
    return _Outcome(report.record, report.plain(), paths)


def _describe(arguments: argparse.Namespace, bars: _Bars) -> _Outcome:
    if arguments.log.suffix.lower() not in hybridkin.workflow.LOG_SUFFIXES:
        loaded = hybridkin.workflow.open_model(arguments.log, arguments.robot)
        report = hybridkin.workflow.describe(loaded)
        return _Outcome(report.record, report.plain())
    if arguments.robot is None:
        raise ValueError(f"{arguments.log} is a log; name its robot: --robot ROBOT.toml.")
    robot = hybridkin.robots.read_description(arguments.robot)
    log_format = _log_format(arguments, robot.log, arguments.robot)
    found = _read(arguments, log_format, robot.chain, robot.base_is_free).report
    return _Outcome(found.to_dict(), str(found), code=0 if found.ok else 1)


_COMMANDS = (_paper, _next, _fit, _evaluate, _track, _animate, _export, _describe)
_RUN = {command.__name__[1:]: command for command in _COMMANDS}


def _limits(arguments: argparse.Namespace, loaded: LoadedModel, **options: bool) -> PathLimits:
    """Return the limits of the arguments, in the log's unit and sign, which may swap the ends."""
    asked = {name: vars(arguments)[name] for name in ("q_min", "q_max", "dq_max", "ddq_max")}
    scaled = hybridkin.robots.Limits(**asked).scaled(loaded.log_format().q_factor)
    return hybridkin.workflow.path_limits(loaded, **vars(scaled), **options)


def _read(
    arguments: argparse.Namespace, log_format: LogFormat, chain: Chain | None, base_is_free: bool
) -> MeasuredLog:
    """Return the log of the arguments, read and checked."""
    names = ("exclude", "drop_invalid", "drop_frozen", "delimiter")
    options = {name: vars(arguments)[name] for name in names}
    return hybridkin.workflow.read_log(
        arguments.log, log_format, chain=chain, base_is_free=base_is_free, **options
    )


def _log_format(arguments: argparse.Namespace, known: LogFormat | None, source: Path) -> LogFormat:
    """Return how the log is written: what is known, with what the options say instead."""
    names = ("q", "x", "q_unit", "x_unit", "q_sign", "groups", "time")
    given = {name: vars(arguments)[name] for name in names}
    given = {name: value for name, value in given.items() if value is not None}
    given |= {name: None for name in ("groups", "time") if given.get(name) == "none"}
    if known is not None:
        return replace(known, **given)
    if "q" not in given or "x" not in given:
        raise ValueError(
            f"{source} does not say how logs are written: it has no [log] table, as in "
            "help(hybridkin.robots.read_description); or name the columns by --q and --x."
        )
    return hybridkin.robots.LogFormat(**given)
