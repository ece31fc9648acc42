"""Measured and simulated data: pairs of actuator vectors and tip positions, in SI units."""

from hybridkin.datasets._log_checks import LogFinding, LogReport, check_log
from hybridkin.datasets._logs import Log, load_log, log_columns
from hybridkin.datasets._recordings import (
    load_armlab,
    load_asl_trunk,
    load_asu_bellows,
    load_ftdcr,
    load_soromox_tentacle,
)
from hybridkin.datasets._shipped import load_trunk, paper_split

__all__ = [
    "Log",
    "LogFinding",
    "LogReport",
    "check_log",
    "load_armlab",
    "load_asl_trunk",
    "load_asu_bellows",
    "load_ftdcr",
    "load_log",
    "load_soromox_tentacle",
    "load_trunk",
    "log_columns",
    "paper_split",
]
