"""What a user sees while a command runs: stages, notes and warnings."""

from __future__ import annotations

import re
import sys
import time
from collections.abc import Callable
from typing import TextIO

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
from rich.text import Text

from hybridkin.formats import visible, visible_lines

_PATIENCE = 15.0  # seconds between two lines of progress in files and pipes
_LONG = 30.0  # seconds of a stage from which on the remaining time is of interest


class _Stage:
    """A stage of a command, of which nothing is shown: none has begun."""

    what = ""

    def show(self, done: int, total: int, state: str) -> None:
        """Show how much is done, in words."""

    def end(self) -> None:
        """Show that the stage is completed."""

    def close(self) -> None:
        """Leave a stage that was not completed."""


_NO_STAGE = _Stage()


class _Bar(_Stage):
    """A stage with a bar on a terminal."""

    def __init__(self, what: str, console: Console) -> None:
        self.what = what
        text = TextColumn("{task.description}", markup=False)
        columns = text, BarColumn(), TimeElapsedColumn()
        self._bar = Progress(*columns, console=console)
        self._task = self._bar.add_task(what, total=None)
        self._bar.start()

    def show(self, done: int, total: int, state: str) -> None:
        """Show how much is done, in words."""
        whole = total if total > 1 else None
        self._bar.update(self._task, total=whole, completed=done, description=state)

    def end(self) -> None:
        """Show that the stage is completed."""
        self._bar.update(self._task, total=1, completed=1, description=self.what)

    def close(self) -> None:
        """Leave a stage that was not completed."""
        self._bar.stop()


class _Lines(_Stage):
    """A stage with lines in a file or a pipe."""

    def __init__(self, what: str, line: Callable[[str], None]) -> None:
        self.what = what
        self._line = line
        self._began = self._last_line = time.monotonic()
        line(f"{what} ...")

    def show(self, done: int, total: int, state: str) -> None:
        """Show how much is done, in words."""
        now = time.monotonic()
        if 0 < done < total and now > self._last_line + _PATIENCE:
            self._last_line = now
            self._line(state)

    def end(self) -> None:
        """Show that the stage is completed."""
        self._line(f"{self.what}: {_in_words(time.monotonic() - self._began)}")


class Stages:
    """Progress on standard error, stage by stage, with notes and warnings between the stages.

    A terminal shows a bar for each stage. Files and pipes get a line when a stage begins, one
    with its time when it ends, and of a long stage lines with what is done and the time left.

    Parameters
    ----------
    quiet : bool, default=False
        Print warnings only.
    """

    def __init__(self, quiet: bool = False) -> None:
        self.quiet = quiet
        self._console = Console(stderr=True)
        self._stage = _NO_STAGE
        self._began = 0.0
        self._seen: set[str] = set()

    def __call__(self, what: str, done: int, total: int) -> None:
        """Report a stage, and how much of it is done."""
        if self.quiet:
            return
        what = visible(what)
        now = time.monotonic()
        if self._stage.what != what:
            self._end()
            self._began = now
            if self._console.is_terminal:
                self._stage = _Bar(what, self._console)
            else:
                self._stage = _Lines(what, self._line)
        spent = now - self._began
        left = spent * (total - done) / done if done else 0.0
        state = f"{what}: {done} of {total}" if total > 1 else what
        state += f", about {_in_words(left)} left" if spent + left > _LONG else ""
        self._stage.show(done, total, state)
        if done >= total:
            self._end()

    def note(self, text: str, *, important: bool = False) -> None:
        """Print text, unless only what is important is asked for."""
        self._end()
        if important or not self.quiet:
            write(text, sys.stderr)

    def warn(self, message: object, *_: object) -> None:
        """Print a warning, of those that differ in numbers only the first."""
        text = str(message)
        kind = re.sub(r"[\d.]+", "", text)
        if kind not in self._seen:
            self._seen.add(kind)
            self._line(f"warning: {text}")

    def close(self) -> None:
        """End the bar of a stage that was not completed."""
        self._stage.close()
        self._stage = _NO_STAGE

    def _end(self) -> None:
        self._stage.end()
        self.close()

    def _line(self, text: str) -> None:
        shown = visible_lines(f"hybridkin: {text}").replace("\n", "\n  ")
        self._console.print(Text(shown), soft_wrap=True)


def write(text: str, to: TextIO, *, end: str = "\n", indent: str = "") -> None:
    """Write text, in which a user's text cannot steer the terminal; all writing goes here.

    Further lines are indented, so that none looks like one of its own.
    """
    print(visible_lines(text).replace("\n", f"\n{indent}"), end=end, file=to, flush=True)


def _in_words(seconds: float) -> str:
    return f"{seconds:.1f} s" if seconds < 60.0 else f"{seconds / 60.0:.1f} min"
