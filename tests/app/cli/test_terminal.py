"""Progress, notes and warnings on standard error; tables on a terminal and elsewhere."""

import pytest

from hybridkin.app.cli import _terminal
from hybridkin.app.cli._terminal import Stages
from hybridkin.app.workflow import Report


@pytest.fixture
def clock(monkeypatch):
    """A clock that a test sets."""
    now = [100.0]
    monkeypatch.setattr(_terminal.time, "monotonic", lambda: now[0])
    return now


def test_a_pipe_gets_a_line_when_a_stage_begins_and_one_with_its_time(clock, capsys):
    stages = Stages()
    stages("calibration", 0, 1)
    clock[0] += 3.0
    stages("tracking", 0, 4)
    clock[0] += 90.0
    stages("tracking", 4, 4)
    stages.close()
    assert capsys.readouterr().err.splitlines() == [
        "hybridkin: calibration ...",
        "hybridkin: calibration: 3.0 s",
        "hybridkin: tracking ...",
        "hybridkin: tracking: 1.5 min",
    ]


def test_quiet_leaves_warnings_and_what_is_important(clock, capsys):
    stages = Stages(quiet=True)
    stages("tracking", 0, 4)
    clock[0] += 90.0
    stages("tracking", 1, 4)
    stages.note("a note")
    stages.note("errors in the log", important=True)
    stages.warn("bent by 3.1 [mm]")
    stages.warn("bent by 3.2 [mm]")
    stages.close()
    assert capsys.readouterr().err.splitlines() == [
        "errors in the log",
        "hybridkin: warning: bent by 3.1 [mm]",
    ]


def test_a_report_is_markdown_and_its_text_has_the_same_tables():
    report = Report("A table", {})
    report.text("**Bold** words.")
    report.table(["tip error [mm]", "mean"], [["hybrid, auto", "1.50"], ["nominal", "22.75"]])
    table = (
        "| tip error [mm] |  mean |\n"
        "| -------------- | ----- |\n"
        "| hybrid, auto   |  1.50 |\n"
        "| nominal        | 22.75 |"
    )
    assert report.markdown() == f"# A table\n\n**Bold** words.\n\n{table}\n"
    assert report.plain() == f"A table\n\nBold words.\n\n{table}"
