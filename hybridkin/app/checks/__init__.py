"""What is wrong with a log or a loop: checks of its columns, and causes as small models."""

from hybridkin.app.checks.check_log import check_log
from hybridkin.app.checks.report import LogFinding, LogReport

__all__ = ["LogFinding", "LogReport", "check_log"]
