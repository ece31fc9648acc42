"""The error that a track promised against the error of the robot, and the likely cause."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from hybridkin import Commands, HybridForwardModel, robots
from hybridkin.app.checks.causes.alignment import Alignment
from hybridkin.app.checks.causes.comparison import CauseComparison, compare_causes
from hybridkin.app.checks.causes.evidence import Actuators, Evidence
from hybridkin.app.checks.causes.motion import Motion
from hybridkin.app.checks.causes.separation import separating_motion
from hybridkin.app.workflow.delay import Delay, at_times, estimated_delay
from hybridkin.app.workflow.errors import Errors, ExpectedErrors
from hybridkin.app.workflow.model import (
    check_columns,
    domain_distance,
    is_fitted,
    promised_errors,
    tips_at,
)
from hybridkin.app.workflow.report import Report, check_out, millimetres, percent
from hybridkin.app.workflow.track import LEAD_IN, read_track
from hybridkin.arguments import check_tips, number
from hybridkin.datasets import Log, load_log, log_columns
from hybridkin.native import evaluate

_KEPT = 1.5  # largest mean error of a kept promise, relative to the promised one
_OFF = 0.01  # least distance from the plane of the log, as a share of the range of the commands
_SHORT = 0.5  # range of a short path, as a share of that of the log
_DIFFERENT = 0.1  # of the range: commands of a log that differ from those of the track
_SHOWN = 0.05  # least share of the error that is worth a line of the report
_COLUMNS = ("rows", "promised", "promised_p95", "mean", "p95", "max")


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
        Share of the squared error that each cause explains on rows that it was not fitted to.
    cause : str or None
        The simplest cause within the noise of the best, if the promise is not kept and it clearly
        explains more than half.
    also : list of str
        The other causes that explain as much.
    amount : str
        How large the cause is, and which actuator or rows, in words; "" without a cause.
    remedy : str
        What to do; "" without a cause.
    separate : str
        The motion that tells the cause from the first of the others; "" if there are none, or no
        simple motion does.
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
    also: list[str]
    amount: str
    remedy: str
    separate: str
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
        if self.kept:
            report.text(
                f"The promise is kept: the mean error is within {_KEPT:g} times the promised one."
            )
        else:
            self._write_causes(report)
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

    def _write_causes(self, report: Report) -> None:
        """Add what each cause explains, and the likely one."""
        shares = []
        for cause in sorted(self.causes, key=self.causes.__getitem__, reverse=True):
            if self.causes[cause] >= _SHOWN:
                shares.append([cause, f"{100 * self.causes[cause]:.0f}"])
        if shares:
            report.table(["cause", "explains [%]"], shares)
        if self.cause is None:
            report.text("None of the known causes explains the error; check load and friction.")
            return
        report.text(f"Likely cause: {self.cause}. To do: {self.remedy}.")
        if self.amount:
            report.text("Amount: {amount}.", amount=self.amount)
        self._write_others(report)

    def _write_others(self, report: Report) -> None:
        """Add the causes that explain as much, and how to tell them apart."""
        if not self.also:
            return
        report.text(f"On this path these explain as much: {', '.join(self.also)}.")
        if self.separate:
            report.text(
                f"To tell {self.cause} and {self.also[0]} apart: {{motion}}.",
                motion=self.separate,
            )
        else:
            report.text(
                f"No simple motion in the range of the log tells {self.cause} and {self.also[0]} "
                "apart."
            )


def verify_track(
    model: HybridForwardModel,
    track: str | Path,
    log: Log,
    out: str | Path | None = None,
    *,
    delay: float | None = None,
    force: bool = False,
) -> Report[Verification]:
    """Compare the error that a track promised with the error of the robot, and find the cause.

    The error is the distance of the measured tip from the tip of the model. Causes are compared as
    models: each is a small change with few parameters (unit or axes of the tips, a lag, a moved
    base, the zero, gain, sign or place of an actuator, a payload, backlash, ...), fitted to parts
    of the path and judged by the other parts. The simplest within the noise of the best is named,
    and what else explains as much.

    Parameters
    ----------
    model : HybridForwardModel
        The model that computed the track, as from `open_model`.
    track : str or Path
        ``track.csv`` of `track_path`, or its folder.
    log : Log
        Tips measured while these commands ran. Rows belong to those of the track if there are as
        many; else by the time since the first row. The commands are compared with those of the
        track; a log of a camera alone has none, with q of shape (N, 0).
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
    if log.q.shape[1]:
        check_columns(model, log.q)
    sent = read_track(track, model.description_.log)
    motion = model.effective(Commands(sent.q, time=sent.time))
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
        raise ValueError(f"`log` must have at least 3 measured tips of the path, got {len(rows)}.")
    q = motion[rows]
    predicted = tips_at(model, q)
    later = None
    if sent.time is not None and (np.diff(rows) > 0).all() and len(rows) > 3:
        later = estimated_delay(sent.time[rows], predicted, x)
    check_tips(x, predicted, "x")
    errors = np.linalg.norm(x - predicted, axis=1)
    promised = promised_errors(model, q)
    parts = {}
    for name, part in _parts(model, q).items():
        if part.any():
            parts[name] = _errors_of(part, errors, promised)
    kept = None
    if promised.known:
        kept = bool(parts["path"].mean <= _KEPT * parts["path"].promised)
    compared = compare_causes(_evidence(model, sent, motion, rows, x, promised))
    cause = None
    also = []
    amount = ""
    remedy = ""
    separate = ""
    likely = compared.likely
    if not kept and likely is not compared.nothing:
        cause = likely.name
        also = [explanation.name for explanation in compared.also]
        amount = likely.cause.amount(compared.evidence, likely.parameters)
        remedy = likely.cause.remedy
        separate = _separation(compared)
    record = Verification(
        model=str(model.description_.path),
        track=str(track),
        log=log.source,
        parts=parts,
        kept=kept,
        causes=compared.shares,
        cause=cause,
        also=also,
        amount=amount,
        remedy=remedy,
        separate=separate,
        range=_share_of_range(model, q),
        delay=delay,
        later=later,
    )
    title = f"{model.description_.name}: {Path(track).name} against {Path(log.source).name}"
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
    if not log.q.shape[1]:
        return rows
    far = np.abs(log.q - sent.q[rows]).mean() / np.ptp(sent.q, axis=0).max()
    if not far < _DIFFERENT:
        raise ValueError(
            f"`log` must hold the commands of the track, but they differ by {100 * far:.0f} % of "
            "their range on average; check the files, the unit and the sign."
        )
    return rows


def _parts(model: HybridForwardModel, q: NDArray) -> dict[str, NDArray]:
    """Return the rows of the parts of the path: the whole, in and out of the log, quarters."""
    inside = domain_distance(model, q) <= 1.0
    parts = {
        "path": np.ones(len(q), dtype=bool),
        "inside the log": inside,
        "outside the log": ~inside,
    }
    quarter = 4 * np.arange(len(q)) // len(q)
    for k in range(4):
        parts[f"quarter {k + 1}"] = quarter == k
    return parts


def _errors_of(rows: NDArray, errors: NDArray, promised: ExpectedErrors) -> PartErrors:
    return PartErrors.of(
        errors[rows],
        promised=promised.mean[rows].mean(),
        promised_p95=promised.p95[rows].mean(),
    )


def _share_of_range(model: HybridForwardModel, q: NDArray) -> float | None:
    """Return the largest range of an actuator, as a share of its range in the log."""
    if not is_fitted(model):
        return None
    low, high = model.training_range_
    widths = high - low
    moved = widths > 0.0
    return float((np.ptp(q, axis=0)[moved] / widths[moved]).max(initial=0.0))


def _evidence(
    model: HybridForwardModel,
    sent: Log,
    motion: NDArray,
    rows: NDArray,
    x: NDArray,
    promised: ExpectedErrors,
) -> Evidence:
    """Return the evidence of measured tips x (N, 3) at rows (N,) of a motion (T, n)."""
    order = np.argsort(rows, kind="stable")
    rows = rows[order]
    q = motion[rows]
    robot = model.module_.tip_model.robot
    bodies = [body.tip_model for body in (robot, *robot.softer())]
    off_plane = _off_plane(model, q)
    low = motion.min(axis=0)
    high = motion.max(axis=0)
    if is_fitted(model):
        low, high = model.training_range_
    expected = 0.0
    if promised.known:
        expected = float(promised.mean.mean())
    return Evidence(
        motion=Motion.of(motion, sent.time, None),
        rows=rows,
        x=x[order],
        model=model.module_.tip_model,
        path=evaluate(model.module_.tip_model, motion)[0],
        bodies=bodies,
        actuators=_actuators(model.description_.log, robot.actuator_layout),
        inside=domain_distance(model, q - off_plane) <= 1.0,
        off_plane=off_plane,
        promised=expected,
        low=low,
        high=high,
        alignment=Alignment(),
    )


def _actuators(log: robots.LogFormat, layout: robots.ActuatorLayout) -> Actuators:
    """Return the actuators with the words of a log."""
    n = len(layout.rest)
    unit = "" if log.q_unit == "1" else log.q_unit
    per_unit = np.broadcast_to(log.q_factor, (n,)).astype(float)
    return Actuators(log.q, unit, per_unit, layout)


def _separation(compared: CauseComparison) -> str:
    """Return the motion that tells the likely cause from the first of the others, in words."""
    if not compared.also:
        return ""
    separation = separating_motion(compared.evidence, compared.likely, compared.also[0])
    if not separation.words:
        return ""
    far = millimetres(separation.difference, ".2g")
    return f"{separation.words} (the tips then differ by up to {far})"


def _off_plane(model: HybridForwardModel, q: NDArray) -> NDArray:
    """Return the part (N, n) of commands off the plane of the log, 0 if they keep to it."""
    plane = model.module_.tip_model.plane
    off = q - plane.nearest(torch.from_numpy(q)).numpy(force=True)
    return np.where(np.abs(off).max() > _OFF * np.ptp(q, axis=0).max(), off, 0.0)


def read_tips(path: str | Path, log_format: robots.LogFormat, delimiter: str | None = None) -> Log:
    """Return the tips of a file of a camera, which holds none of the commands.

    Parameters
    ----------
    path : str or Path
        CSV, npz or parquet file.
    log_format : LogFormat
        Columns and units of the robot's logs; its time is used where the file has such a column.
    delimiter : str or None, default=None
        As for `datasets.load_log`.

    Returns
    -------
    Log
        With q of shape (N, 0).
    """
    columns = {*log_columns(path, delimiter)}
    time = log_format.time if log_format.time in columns else None
    of_tips = replace(
        log_format,
        q=(),
        q_unit="m",
        q_sign=1,
        groups=None,
        runs=None,
        time=time,
        unwrap=False,
        delimiter=delimiter,
        drop_invalid=True,
    )
    return load_log(path, **of_tips.reading)
