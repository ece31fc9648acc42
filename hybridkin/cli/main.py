"""The command line: `hybridkin COMMAND`, or `python -m hybridkin COMMAND`."""

from __future__ import annotations

import argparse
import json
import math
import re
import sys
import warnings
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

from tqdm import tqdm

import hybridkin  # its rooms are opened when used: help comes at once
from hybridkin.cli import _parser, _text

_LOGS = (".csv", ".tsv", ".txt", ".npz", ".parquet", ".pq")
_METRES = {"m": 1.0, "cm": 1e-2, "mm": 1e-3}
_DT = 0.02


class _Outcome(NamedTuple):
    record: Any
    lines: Callable[[Any], Any]
    paths: Sequence[Path] = ()
    code: int = 0


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit code, see `hybridkin --help`."""
    arguments = _parser.parser().parse_args(argv)
    bars = _Bars()
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("default", category=UserWarning)
            warnings.showwarning = bars.warn
            outcome = _RUN[arguments.command](arguments, bars)
    except KeyboardInterrupt:
        bars.close()
        print("hybridkin: interrupted; nothing was written", file=sys.stderr)
        return 130
    except Exception as error:
        bars.close()
        if not _is_of_input(error):
            raise
        if hasattr(error, "report"):
            print(error.report, file=sys.stderr)  # pyright: ignore[reportAttributeAccessIssue]
        print(f"hybridkin: error: {error}", file=sys.stderr)
        return 2
    bars.close()
    if arguments.json:
        record = outcome.record
        if isinstance(record, dict) and outcome.paths:
            record = {**record, "written": [str(path) for path in outcome.paths]}
        print(json.dumps(_plain(record), indent=2, allow_nan=False))
        return outcome.code
    for line in outcome.lines(outcome.record):
        print(line)
    if outcome.paths:
        print("\nWrote")
        for path in outcome.paths:
            print(f"  {path}")
    return outcome.code


class _Bars:
    """Progress bars on standard error, one for each kind of work."""

    def __init__(self) -> None:
        self._bar: Any = None
        self._what: str | None = None
        self._seen: set[str] = set()

    def __call__(self, what: str, done: int, total: int) -> None:
        if self._what != what:
            self.close()
            self._what = what
            # None: no bars in files and pipes
            self._bar = tqdm(total=total, desc=what, file=sys.stderr, disable=None)
        self._bar.update(done - self._bar.n)

    def warn(self, message: Any, *_: Any) -> None:
        text = str(message)
        kind = re.sub(r"[\d.]+", "", text)
        if kind not in self._seen:
            self._seen.add(kind)
            tqdm.write(f"hybridkin: warning: {text}", file=sys.stderr)

    def check(self, report: Any) -> None:
        tqdm.write(f"{report}\n", file=sys.stderr)

    def close(self) -> None:
        if self._bar is not None:
            self._bar.close()
        self._bar = self._what = None


def _is_of_input(error: Exception) -> bool:
    """Return whether the user can mend it: such errors are told without a traceback."""
    if isinstance(error, (ValueError, TypeError, OSError, ImportError)):
        return True
    return isinstance(error, hybridkin.simulation.NotSettledError)


def _run_paper(arguments: argparse.Namespace, bars: _Bars) -> _Outcome:
    report, paths = hybridkin.paper.run_paper(
        arguments.out,
        n_splits=arguments.splits,
        n_seeds=arguments.seeds,
        n_points=arguments.points,
        n_jobs=arguments.jobs,
        progress=bars,
    )
    return _Outcome(report.record, _text.paper, paths)


def _run_fit(arguments: argparse.Namespace, bars: _Bars) -> _Outcome:
    description = hybridkin.robots.read_description(arguments.robot)
    log_format = _log_format(arguments, description.log, arguments.robot)
    play = arguments.play
    report, paths = hybridkin.workflow.fit_log(
        arguments.log,
        arguments.robot,
        arguments.out,
        log_format=log_format,
        loss=arguments.loss,
        coverage=arguments.coverage,
        n_folds=arguments.folds,
        n_seeds=arguments.seeds,
        auto=not arguments.no_auto,
        play=_METRES[log_format.q_unit] * play if isinstance(play, float) else play,
        max_rows=arguments.max_rows or None,
        n_jobs=arguments.jobs,
        progress=bars,
        **_reading(arguments, bars),
    )
    return _Outcome(report.record, _text.fit, paths)


def _run_evaluate(arguments: argparse.Namespace, bars: _Bars) -> _Outcome:
    opened = hybridkin.workflow.open_model(arguments.model, arguments.robot)
    report, paths = hybridkin.workflow.evaluate_log(
        opened,
        arguments.log,
        arguments.out,
        log_format=_log_format(arguments, _known_format(opened), arguments.model),
        **_reading(arguments, bars),
    )
    limit = arguments.fail_above
    code = 1 if limit is not None and 1000 * report.record["all"]["mean"] > limit else 0
    return _Outcome(report.record, _text.evaluate, paths, code)


def _run_track(arguments: argparse.Namespace, bars: _Bars) -> _Outcome:
    opened = hybridkin.workflow.open_model(arguments.model, arguments.robot)
    log_format = opened.log_format()
    if (arguments.path is None) == (arguments.shape is None):
        raise ValueError("give either a file of points or --shape, one of the two.")
    limits = _limits(arguments, log_format)
    unit = arguments.unit or log_format.x_unit
    if arguments.path is not None:
        path = hybridkin.workflow.read_path(arguments.path, unit=unit, dt=arguments.dt)
    else:
        path = _shape(arguments, opened, limits, _METRES[unit])
    report, paths = hybridkin.workflow.track_path(
        opened, path, arguments.out, tol=1e-3 * arguments.tol, progress=bars, **limits
    )
    code = 0 if report.record["reached"] == report.record["n"] else 1
    return _Outcome(report.record, _text.track, paths, code)


def _run_animate(arguments: argparse.Namespace, bars: _Bars) -> _Outcome:
    opened = hybridkin.workflow.open_model(arguments.model, arguments.robot)
    record = hybridkin.workflow.animate_track(
        opened,
        arguments.track,
        arguments.out,
        unit=arguments.unit,
        speed=arguments.speed,
        n_frames=arguments.frames,
        progress=bars,
    )
    return _Outcome(record, _text.animate, [arguments.out])


def _run_benchmark(arguments: argparse.Namespace, bars: _Bars) -> _Outcome:
    workflow = hybridkin.workflow
    if arguments.model is None:
        opened = workflow.trunk_model()
    else:
        opened = workflow.open_model(arguments.model, arguments.robot)
    record = workflow.measure_speed(
        opened, batches=arguments.batches, seconds=arguments.seconds, progress=bars
    )
    return _Outcome(record, _text.benchmark)


def _run_describe(arguments: argparse.Namespace, bars: _Bars) -> _Outcome:
    workflow = hybridkin.workflow
    if arguments.what.suffix.lower() not in _LOGS:
        opened = workflow.open_model(arguments.what, arguments.robot)
        return _Outcome(workflow.describe_model(opened), _text.describe)
    if arguments.robot is None:
        raise ValueError(f"{arguments.what} is a log; name its robot: --robot ROBOT.toml.")
    description = hybridkin.robots.read_description(arguments.robot)
    given = _reading(arguments, bars)
    log = workflow.read_log(
        arguments.what,
        _log_format(arguments, description.log, arguments.robot),
        chain=description.chain,
        base_is_free="base" in description.calibrate,
        **{name: given[name] for name in given if name not in ("force", "on_check")},
    )
    code = 0 if log.report.ok else 1
    return _Outcome(log.report.to_dict(), lambda _: [str(log.report)], code=code)


def _reading(arguments: argparse.Namespace, bars: _Bars) -> dict[str, Any]:
    names = ("exclude", "drop_invalid", "drop_frozen", "delimiter", "force")
    return {name: getattr(arguments, name) for name in names} | {"on_check": bars.check}


def _log_format(arguments: argparse.Namespace, known: Any, source: Path) -> Any:
    """Return how the log is written: what is known, with what the options say instead."""
    names = ("q", "x", "q_unit", "x_unit", "q_sign", "groups", "time")
    given = {name: getattr(arguments, name) for name in names}
    given = {name: value for name, value in given.items() if value is not None}
    if known is not None:
        return replace(known, **given)
    if "q" not in given or "x" not in given:
        raise ValueError(
            f"{source} does not say how logs are written: it has no [log] table, as in "
            "help(hybridkin.robots.read_description); or name the columns by --q and --x."
        )
    return hybridkin.robots.LogFormat(**given)


def _known_format(opened: Any) -> Any:
    return None if opened.description is None else opened.description.log


def _limits(arguments: argparse.Namespace, log_format: Any) -> dict[str, Any]:
    """Return the limits [m] as the model counts them, from options in the log's unit and sign."""
    scale = _METRES[log_format.q_unit]
    found: dict[str, Any] = {}
    for name in ("q_min", "q_max", "dq_max"):
        value = getattr(arguments, name)
        if value is not None:
            found[name] = [scale * v for v in value]
            if len(value) == 1:
                found[name] = found[name][0]
    if log_format.q_sign < 0:
        flipped = {"q_min": found.pop("q_max", None), "q_max": found.pop("q_min", None)}
        for name, value in flipped.items():
            if value is not None:
                found[name] = [-v for v in value] if isinstance(value, list) else -value
    return found


def _shape(arguments: argparse.Namespace, opened: Any, limits: dict[str, Any], metre: float) -> Any:
    """Return the path of a named shape, about the middle of the workspace by default."""
    shapes, workflow = hybridkin.trajectories, hybridkin.workflow
    center = arguments.center
    if center is None:
        found = workflow.path_limits(opened, **limits)
        center = workflow.middle_tip(opened, found)
    else:
        center = [metre * v for v in center]
    normal = arguments.normal
    if normal is None:
        base = getattr(opened.chain, "base", None)
        normal = (0.0, 0.0, 1.0) if base is None else base[:3, 2].tolist()
    n_sizes = 3 if arguments.shape == "line" else 2
    if arguments.size is None or len(arguments.size) != n_sizes:
        raise ValueError(f"--size must be {n_sizes} numbers for a {arguments.shape}, as in --help.")
    size = [metre * v for v in arguments.size]
    timing = {"duration": arguments.duration, "dt": arguments.dt or _DT}
    if arguments.shape == "figure-eight":
        return shapes.figure_eight(center, size, normal=normal, **timing)
    if arguments.shape == "spiral":
        rise = metre * arguments.rise
        return shapes.spiral(
            center, size, normal=normal, turns=arguments.turns, rise=rise, **timing
        )
    start, end = (
        [c + sign * 0.5 * s for c, s in zip(center, size, strict=True)] for sign in (-1, 1)
    )
    return shapes.line(start, end, **timing)


def _plain(value: Any) -> Any:
    """Return a value as JSON can say it; what is not finite becomes null."""
    if isinstance(value, dict):
        return {str(key): _plain(part) for key, part in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(part) for part in value]
    if hasattr(value, "tolist"):
        return _plain(value.tolist())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return str(value) if isinstance(value, Path) else value


_RUN = {
    "paper": _run_paper,
    "fit": _run_fit,
    "evaluate": _run_evaluate,
    "track": _run_track,
    "animate": _run_animate,
    "benchmark": _run_benchmark,
    "describe": _run_describe,
}
