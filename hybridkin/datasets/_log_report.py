"""The report of a check of a log: findings with severity, rows and advice."""

from __future__ import annotations

import textwrap
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

SEVERITIES = ("error", "warning", "note")
MISREAD = ("units", "order", "sign", "numbering", "axes", "size")
_WIDTH = 96
_ARROW = " " * 11 + "-> "


@dataclass(frozen=True, eq=False)
class LogFinding:
    """One finding of a check of a log.

    Attributes
    ----------
    kind : str
        "invalid", "frozen tip", "frozen actuator", "constant", "duplicates", "same command",
        "jumps", "time", "motions", "rows", "same column", "drift", "lag", "offset", "units",
        "order", "sign", "numbering", "axes", "size" or "geometry".
    severity : {"error", "warning", "note"}
        "error": a fit would be worthless; "warning": check it; "note": information.
    message : str
        What was found.
    advice : str
        What to do.
    rows : ndarray of shape (k,)
        The rows of the finding, from 0; empty: all rows.
    """

    kind: str
    severity: str
    message: str
    advice: str
    rows: NDArray = field(default_factory=lambda: np.empty(0, dtype=int))


@dataclass(frozen=True, eq=False)
class LogReport:
    """The findings of `check_log`, and the size and ranges of the log.

    Attributes
    ----------
    findings : tuple of LogFinding
        Errors first.
    n_rows, n_actuators : int
        Size of the log.
    n_motions : int or None
        Number of motions in its groups; None without groups.
    q_range : ndarray of shape (n_actuators, 2)
        Least and largest value of every actuator [m].
    x_range : ndarray of shape (3, 2)
        Least and largest coordinates of the tip [m].
    duration : float or None
        Time from the first to the last time stamp [s].
    source : str
        Source of the log, for example its path.
    q_unit : str
        Unit of q, "m", "rad" or "1".
    """

    findings: tuple[LogFinding, ...]
    n_rows: int
    n_actuators: int
    n_motions: int | None
    q_range: NDArray
    x_range: NDArray
    duration: float | None
    source: str
    q_unit: str = "m"

    @property
    def errors(self) -> tuple[LogFinding, ...]:
        """The findings that make a fit worthless."""
        return tuple(f for f in self.findings if f.severity == "error")

    @property
    def warnings(self) -> tuple[LogFinding, ...]:
        """The findings to check."""
        return tuple(f for f in self.findings if f.severity == "warning")

    @property
    def misread(self) -> tuple[LogFinding, ...]:
        """The findings about reading the columns: units, order, signs, axes, radii."""
        return tuple(f for f in self.findings if f.kind in MISREAD)

    @property
    def ok(self) -> bool:
        """Whether there are no errors."""
        return not self.errors

    def accepting(self, kind: str) -> LogReport:
        """Return the report with findings of a kind as notes, because their rows are left out."""
        findings = [f for f in self.findings if f.kind != kind]
        for f in self.findings:
            if f.kind == kind:
                message = f"{f.message} They were left out."
                findings.append(
                    LogFinding(kind, "note", message, "find out why.", f.rows)
                )
        return replace(self, findings=tuple(findings))

    def to_dict(self) -> dict[str, Any]:
        """Return the report as numbers, text and lists, for JSON."""
        record = {**vars(self), "ok": self.ok, "duration_s": self.duration}
        del record["duration"]
        for name in ("q_range", "x_range"):
            record[name] = record[name].tolist()
        record["findings"] = [
            {**vars(f), "rows": f.rows.tolist(), "n_rows": len(f.rows)}
            for f in self.findings
        ]
        return record

    def summary(self) -> str:
        """Return the numbers of errors and warnings as text."""
        counts = {"error": len(self.errors), "warning": len(self.warnings)}
        counted = [
            f"{n} {name}{'s' if n > 1 else ''}" for name, n in counts.items() if n
        ]
        return " and ".join(counted) or "no errors and no warnings"

    def __str__(self) -> str:
        """Return the report as text, one paragraph for each finding."""
        if self.n_motions is None:
            motions = "motions not named"
        else:
            motions = f"{self.n_motions} motions"
        spans = 1e3 * np.ptp(self.x_range, axis=1)
        scale, unit = {"m": (1e3, " mm"), "rad": (180.0 / np.pi, " deg")}.get(
            self.q_unit, (1, "")
        )
        lines = [
            f"Log {self.source}: {self.n_rows} rows, {motions}, {self.n_actuators} actuators"
            + ("" if self.duration is None else f", {self.duration:.4g} s"),
            f"  q from {scale * self.q_range[:, 0].min():.4g} to "
            f"{scale * self.q_range[:, 1].max():.4g}{unit}, "
            f"tip within {spans[0]:.4g} x {spans[1]:.4g} x {spans[2]:.4g} mm",
        ]
        for finding in self.findings:
            head = f"  {finding.severity.upper():8s} {finding.kind}: "
            lines += [_filled(head, finding.message), _filled(_ARROW, finding.advice)]
        lines.append(f"  {self.summary()}")
        return "\n".join(lines)


def _filled(head: str, text: str) -> str:
    lines = textwrap.TextWrapper(_WIDTH, head, " " * 14, break_on_hyphens=False)
    lines.break_long_words = False
    return lines.fill(text)


def named_rows(places: NDArray, kind: str) -> str:
    """Return places as text, neighbours as ranges: "lines 3, 8-12 and 40 more"."""
    ordered = np.sort(places)
    runs = np.split(ordered, np.flatnonzero(np.diff(ordered) > 1) + 1)
    words = [
        f"{run[0]}" if len(run) == 1 else f"{run[0]}-{run[-1]}" for run in runs[:4]
    ]
    left = sum(map(len, runs[4:]))
    rest = f" and {left} more" if left else ""
    return f"{kind}{'s' if len(ordered) > 1 else ''} {', '.join(words)}{rest}"
