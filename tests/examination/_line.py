"""One claim of the examination, with the figure found."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Line:
    """What was examined, the figure found, and whether the claim holds: None if it was not run."""

    what: str
    figure: str
    holds: bool | None
