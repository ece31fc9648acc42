"""The report of a check of a log: findings with severity, rows and advice."""

from __future__ import annotations

import textwrap
from dataclasses import asdict, dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from hybridkin.formats import duration_in_words, plain, visible

SEVERITIES = ("error", "warning", "note")
MISREAD = ("units", "order", "sign", "numbering", "axes", "size")
_WIDTH = 96
_ARROW = " " * 11 + "-> "
_SHOWN_IN = {"m": (1e3, " mm"), "rad": (180.0 / np.pi, " deg")}


@dataclass(frozen=True, eq=False)
class LogFinding:
    """One finding of a check of a log.

    Attributes
    ----------
    kind : str
        "invalid", "missing", "encoder", "frozen tip", "frozen actuator", "constant", "duplicates",
        "same command", "jumps", "time", "reversals", "motions", "rows", "same column", "drift",
        "lag", "offset", "zeros", "exchanged", "units", "order", "sign", "numbering", "axes", "size"
        or "geometry".
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

    @property
    def of_evaluation(self) -> LogReport:
        """The report without what the log cannot teach: an evaluation learns nothing."""
        findings = [finding for finding in self.findings if finding.kind != "no motion"]
        return replace(self, findings=tuple(findings))

    def accepting(self, kind: str) -> LogReport:
        """Return the report with findings of a kind as notes, because their rows are left out."""
        findings = []
        accepted = []
        for finding in self.findings:
            if finding.kind == kind:
                message = f"{finding.message} They were left out."
                note = LogFinding(kind, "note", message, "find out why.", finding.rows)
                accepted.append(note)
            else:
                findings.append(finding)
        return replace(self, findings=(*findings, *accepted))

    def to_dict(self) -> dict[str, object]:
        """Return the report as numbers, text and lists, for JSON."""
        record = plain(asdict(self))
        for finding in record["findings"]:
            finding["n_rows"] = len(finding["rows"])
        record["duration_s"] = record.pop("duration")
        record["ok"] = self.ok
        return record

    def summary(self) -> str:
        """Return the numbers of errors and warnings as text."""
        counts = []
        for n, word in ((len(self.errors), "error"), (len(self.warnings), "warning")):
            if n:
                counts.append(f"{n} {word}{'s' if n > 1 else ''}")
        return " and ".join(counts) or "no errors and no warnings"

    def __str__(self) -> str:
        """Return the report as text, one paragraph for each finding."""
        motions = "motions not named"
        if self.n_motions is not None:
            motions = f"{self.n_motions} motions"
        head = (
            f"Log {visible(self.source)}: {self.n_rows} rows, {motions}, "
            f"{self.n_actuators} actuators"
        )
        if self.duration is not None:
            head += f", {duration_in_words(self.duration)}"
        scale, unit = _SHOWN_IN.get(self.q_unit, (1.0, ""))
        low = scale * self.q_range.min()
        high = scale * self.q_range.max()
        x, y, z = 1e3 * np.ptp(self.x_range, axis=1)
        tips = f"tip within {x:.4g} x {y:.4g} x {z:.4g} mm"
        lines = [head, f"  q from {low:.4g} to {high:.4g}{unit}, {tips}"]
        for finding in self.findings:
            title = f"  {finding.severity.upper():8s} {finding.kind}: "
            lines.append(_filled(title, visible(finding.message)))
            lines.append(_filled(_ARROW, visible(finding.advice)))
        lines.append(f"  {self.summary()}")
        return "\n".join(lines)


def _filled(head: str, text: str) -> str:
    return textwrap.fill(
        text,
        _WIDTH,
        initial_indent=head,
        subsequent_indent=" " * 14,
        break_on_hyphens=False,
        break_long_words=False,
    )
