"""The error that a track promised against the error of the robot, and the likely cause."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import nnls

from hybridkin._core.arrays import as_array, number
from hybridkin._core.commands import Commands
from hybridkin._core.rotations import rigid_motion
from hybridkin.chains.play import PlayOperator
from hybridkin.datasets import Log
from hybridkin.hybrid.other_units import check_tips
from hybridkin.native.library import evaluate
from hybridkin.workflow.delay import Delay, at_times, estimated_delay
from hybridkin.workflow.errors import Errors, ExpectedErrors
from hybridkin.workflow.model import LoadedModel
from hybridkin.workflow.report import Report, check_out, millimetres, percent
from hybridkin.workflow.track import LEAD_IN, read_track

_KEPT = 1.5  # largest mean error of a kept promise, relative to the promised one
_LIKELY = 0.5  # least share of the mean squared error that a likely cause explains
_OFF = 0.01  # least distance from the plane of the log, as a share of the range of the commands
_ROUNDS = 3  # of the fit of backlash
_NARROW = 1e-3  # least width of backlash, as a share of the range
_SHORT = 0.5  # range of a short path, as a share of that of the log
_DIFFERENT = 0.1  # of the range: commands of a log that differ from those of the track
_COLUMNS = ("rows", "promised", "promised_p95", "mean", "p95", "max")

_REMEDIES = {
    "backlash": "fit named motions in order of time that reverse the actuators",
    "moved base": "measure where the base is, or call `model.adapt(q, x)` with this log",
    "outside the log": "add motions there to the log (`hybridkin next`), or move the path inside",
    "off the plane of the log": "add motions off the plane to the log, or send commands in it",
}


@dataclass(frozen=True, kw_only=True)
class PartErrors(Errors):
    """Errors of a part of a path, and the mean of those that the model promised [m]."""

    promised: float = np.nan
    promised_p95: float = np.nan


@dataclass(frozen=True, kw_only=True)
class Verification:
    """What `verify_track` found.

    Attributes
    ----------
    command, model, track, log : str
        "verify", and the sources.
    parts : dict of str to PartErrors
        Parts of the path; the first is the whole.
    kept : bool or None
        Whether the mean error is at most 1.5 times the promised one; None without a promise.
    causes : dict of str to float
        Share of the mean squared error that each cause explains.
    cause : str or None
        The cause with the largest share above 0.5, if the promise is not kept.
    range : float or None
        Largest range of an actuator relative to the log; None without a log.
    delay : float
        How much later than its command each tip was read [s].
    later : Delay or None
        The further delay with which tips and model agree best; None without times.
    """

    command: str = "verify"
    model: str
    track: str
    log: str
    parts: Mapping[str, PartErrors]
    kept: bool | None
    causes: Mapping[str, float]
    cause: str | None
    range: float | None
    delay: float
    later: Delay | None

    def _write(self, report: Report) -> None:
        """Add the record to a report, in words."""
        path = self.parts["path"]
        promise = "The model promised no error"
        if self.kept is not None:
            promise = (
                f"Promised: mean {millimetres(path.promised)}, 95 % below "
                f"{millimetres(path.promised_p95)}"
            )
        report.text(
            f"{promise}. Robot: mean {millimetres(path.mean)}, 95 % below "
            f"{millimetres(path.p95)}, max {millimetres(path.max)}."
        )
        report.errors(self.parts, _COLUMNS)
        shares = [[cause, f"{100 * v:.0f}"] for cause, v in self.causes.items()]
        report.table(["cause", "explains [%]"], shares)
        if self.kept:
            report.text("The promise is kept.")
        elif self.cause is None:
            report.text(
                "None of these explains the error; check load, friction and delay."
            )
        else:
            report.text(f"Likely cause: {self.cause}. To do: {_REMEDIES[self.cause]}.")
        later = self.later
        if later is not None and later.is_clear:
            report.text(
                f"The tips agree best with the commands {later.seconds:.3g} s before those that "
                f"they were compared with: without a constant offset the error is then "
                f"{millimetres(later.error)} in place of {millimetres(later.without)} (root mean "
                f"square). If the camera is late, use --delay {self.delay + later.seconds:.3g}; "
                "backlash looks alike."
            )
        if self.cause == "moved base" and self.range and self.range < _SHORT:
            report.text(
                f"The path covers {percent(self.range)} of the range of the log; on so short a "
                "path an error of the model looks the same. Repeat a motion of the log to tell "
                "them apart."
            )


def verify_track(
    loaded: LoadedModel,
    track: str | Path,
    log: Log,
    out: str | Path | None = None,
    *,
    delay: float | None = None,
    force: bool = False,
) -> Report[Verification]:
    """Compare the error that a track promised with the error of the robot, and find the cause.

    The error is the distance of the measured tip from the tip of the model. Four causes are tried,
    each alone: backlash (every actuator lags behind its command, by the direction of its motion), a
    rigid motion of the base, larger errors outside the log than inside, and an error that is linear
    in the distance of the commands from the plane of the log.

    Parameters
    ----------
    loaded : LoadedModel
        The model that computed the track, as from `open_model`.
    track : str or Path
        ``track.csv`` of `track_path`, or its folder.
    log : Log
        Tips measured while these commands ran, with the commands. Rows belong to those of the track
        if there are as many; else by the time since the first row.
    out : str or Path, optional
        Folder to write into. Default: nothing is written.
    delay : float, optional
        How much later than its command each tip was read [s]. Default: that of the track.
    force : bool, default=False
        Replace files of `out` that `verify` did not write.

    Returns
    -------
    Report of Verification
        The errors by part of the path, and what explains them.

    Raises
    ------
    ValueError
        If rows or commands of the log are not those of the track, or if its tips are in another
        unit than the model.
    """
    if out is not None:
        check_out(out, "verify", force=force)
    loaded.check_columns(log.q)
    sent = read_track(track, loaded.log_format())
    motion = loaded.effective(Commands(sent.q, time=sent.time))
    rows = _rows_of(log, sent)
    if delay is None:
        delay = _delay_of(track)
    if number(delay, "delay") != 0.0:
        motion = _late(motion, sent, delay)
    x = log.x[:, -3:]
    used = np.isfinite(x).all(axis=1)
    if sent.groups is not None:
        used &= sent.groups[rows] != LEAD_IN
    rows = rows[used]
    x = x[used]
    if len(rows) < 3:
        raise ValueError(
            f"`log` must have at least 3 measured tips of the path, got {len(rows)}."
        )
    q = motion[rows]
    predicted = loaded.tips(q)
    later = None
    if sent.time is not None and (np.diff(rows) > 0).all() and len(rows) > 3:
        later = estimated_delay(sent.time[rows], predicted, x)
    check_tips(x, predicted, "x")
    errors = np.linalg.norm(x - predicted, axis=1)
    promised = loaded.promised_errors(q)
    parts = {}
    for name, part in _parts(loaded, q).items():
        if part.any():
            parts[name] = _errors_of(part, errors, promised)
    kept = None
    if promised is not None:
        kept = bool(parts["path"].mean <= _KEPT * parts["path"].promised)
    causes = _explained(loaded, motion, rows, x)
    likely = max(causes, key=causes.__getitem__)
    cause = None
    if not kept and causes[likely] > _LIKELY:
        cause = likely
    record = Verification(
        model=str(loaded.path),
        track=str(track),
        log=log.source,
        parts=parts,
        kept=kept,
        causes=causes,
        cause=cause,
        range=_share_of_range(loaded, q),
        delay=delay,
        later=later,
    )
    title = f"{loaded.name}: {Path(track).name} against {Path(log.source).name}"
    report = Report(title, record)
    record._write(report)
    if out is not None:
        report.write(out)
    return report


def _delay_of(track: str | Path) -> float:
    """Return the delay that the report beside a track names, else 0."""
    path = Path(track)
    report = (path if path.is_dir() else path.parent) / "report.json"
    if not report.is_file():
        return 0.0
    content = json.loads(report.read_text(encoding="utf-8"))
    if content.get("command") != "track":
        return 0.0
    return float(content.get("delay", 0.0))


def _late(motion: NDArray, sent: Log, delay: float) -> NDArray:
    """Return what the actuators did `delay` seconds before each row of a track (N, n)."""
    good = sent.time is not None and 0.0 <= delay <= sent.time[-1] - sent.time[0]
    if sent.time is None or not good:
        raise ValueError(
            f"`delay` must be a time [s] from 0 to the duration of the track, which needs a column "
            f"of times, got {delay!r}."
        )
    return at_times(sent.time - delay, sent.time, motion)


def _rows_of(log: Log, sent: Log) -> NDArray:
    """Return the row of the track (N,) that each row of the log belongs to."""
    lines = np.arange(len(log.q)) if log.line is None else log.line
    every = np.sort(np.append(lines, log.invalid_lines))
    rows = np.searchsorted(every, lines)
    if len(every) != len(sent.q):
        if log.time is None or sent.time is None:
            raise ValueError(
                f"`log` must have as many rows as the track or a column of times, got {len(every)} "
                f"and {len(sent.q)} rows; name the column by `--time`."
            )
        passed = log.time - log.time[0] + sent.time[0]
        rows = np.rint(np.interp(passed, sent.time, np.arange(len(sent.q)))).astype(int)
    far = np.abs(log.q - sent.q[rows]).mean() / np.ptp(sent.q, axis=0).max()
    if not far < _DIFFERENT:
        raise ValueError(
            f"`log` must hold the commands of the track, but they differ by {100 * far:.0f} % of "
            "their range on average; check the files, the unit and the sign."
        )
    return rows


def _parts(loaded: LoadedModel, q: NDArray) -> dict[str, NDArray]:
    """Return the rows of the parts of the path: the whole, in and out of the log, quarters."""
    inside = loaded.domain_distance(q) <= 1.0
    parts = {
        "path": np.ones(len(q), dtype=bool),
        "inside the log": inside,
        "outside the log": ~inside,
    }
    quarter = 4 * np.arange(len(q)) // len(q)
    for k in range(4):
        parts[f"quarter {k + 1}"] = quarter == k
    return parts


def _errors_of(
    rows: NDArray, errors: NDArray, promised: ExpectedErrors | None
) -> PartErrors:
    if promised is None:
        return PartErrors.of(errors[rows])
    return PartErrors.of(
        errors[rows],
        promised=promised.mean[rows].mean(),
        promised_p95=promised.p95[rows].mean(),
    )


def _share_of_range(loaded: LoadedModel, q: NDArray) -> float | None:
    """Return the largest range of an actuator, as a share of its range in the log."""
    if loaded.hybrid is None:
        return None
    low, high = loaded.hybrid.training_range_
    widths = high - low
    moved = widths > 0.0
    return float((np.ptp(q, axis=0)[moved] / widths[moved]).max(initial=0.0))


def _explained(
    loaded: LoadedModel, motion: NDArray, rows: NDArray, x: NDArray
) -> dict[str, float]:
    """Return the share of the mean squared error that each cause explains."""
    q = motion[rows]
    tips, J = evaluate(loaded.module, q, jacobian=True)
    residual = x - tips
    off = _off_plane(loaded, q)
    linear = off @ np.linalg.lstsq(off, residual)[0]
    remaining = {
        "backlash": _without_backlash(motion, rows, J, residual),
        "moved base": np.square(x - _moved(tips, x)).sum(),
        "outside the log": _as_inside(loaded, q - off, residual),
        "off the plane of the log": np.square(residual - linear).sum(),
    }
    whole = max(np.square(residual).sum(), np.finfo(float).tiny)
    return {
        cause: max(0.0, 1.0 - float(squares / whole))
        for cause, squares in remaining.items()
    }


def _off_plane(loaded: LoadedModel, q: NDArray) -> NDArray:
    """Return the part (N, n) of commands off the plane of the log, 0 if they keep to it."""
    if loaded.module.plane is None:
        return np.zeros_like(q)
    point, normals = map(as_array, loaded.module.plane)
    off = (q - point) @ normals @ normals.T
    return np.where(np.abs(off).max() > _OFF * np.ptp(q, axis=0).max(), off, 0.0)


def _without_backlash(
    motion: NDArray, rows: NDArray, J: NDArray, residual: NDArray
) -> float:
    """Return the sum of squares that the most likely backlash of every actuator leaves.

    The tip errors are linear in the widths if the shape of the lag, from -1/2 to 1/2, is known. It
    is that of the widths of the round before.
    """
    least = _NARROW * np.ptp(motion, axis=0).max()
    left = 0.0
    widths = np.zeros(motion.shape[1])
    for _ in range(_ROUNDS):
        widths = np.maximum(widths, least)
        lag = (PlayOperator(widths).apply(motion)[0] - motion) / widths
        per_width = (J * lag[rows, None]).reshape(-1, len(widths))
        widths, left = nnls(per_width, residual.ravel())
    return left**2


def _moved(tips: NDArray, x: NDArray) -> NDArray:
    """Return tips (N, 3) after the rigid motion that brings them nearest to x."""
    motion = rigid_motion(torch.from_numpy(tips), torch.from_numpy(x)).numpy()
    return tips @ motion[:3, :3].T + motion[:3, 3]


def _as_inside(loaded: LoadedModel, q: NDArray, residual: NDArray) -> float:
    """Return the sum of squares if the errors were everywhere as inside the log."""
    squares = np.square(residual).sum(axis=1)
    inside = loaded.domain_distance(q) <= 1.0
    if inside.any():
        return len(q) * squares[inside].mean()
    if loaded.held_out is None:
        return squares.sum()
    return len(q) * loaded.held_out.mean**2
