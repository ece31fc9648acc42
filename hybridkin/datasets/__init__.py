"""Measured and simulated data: pairs of actuator vectors and tip positions, in SI units."""

from typing import TYPE_CHECKING

from hybridkin._core.first_use import on_first_use
from hybridkin.datasets.encoders import EncoderFault
from hybridkin.datasets.logs import Log, load_log, log_columns

if TYPE_CHECKING:
    from hybridkin.datasets._recordings import (
        load_armlab,
        load_asl_trunk,
        load_asu_bellows,
        load_ftdcr,
        load_soromox_tentacle,
    )
    from hybridkin.datasets._repeatability import repeatability
    from hybridkin.datasets._shipped import load_trunk, paper_split
    from hybridkin.datasets.merged import Merged, merge_logs
    from hybridkin.datasets.table_files import LOG_SUFFIXES
    from hybridkin.datasets.timed_columns import TimedColumns, read_columns

__all__ = [
    "LOG_SUFFIXES",
    "EncoderFault",
    "Log",
    "Merged",
    "TimedColumns",
    "load_armlab",
    "load_asl_trunk",
    "load_asu_bellows",
    "load_ftdcr",
    "load_log",
    "load_soromox_tentacle",
    "load_trunk",
    "log_columns",
    "merge_logs",
    "paper_split",
    "read_columns",
    "repeatability",
]

# Some results are Bunches of scikit-learn; a merge needs scipy.
_NAMES_OF = {
    "table_files": ("LOG_SUFFIXES",),
    "merged": ("Merged", "merge_logs"),
    "timed_columns": ("TimedColumns", "read_columns"),
    "_recordings": (
        "load_armlab",
        "load_asl_trunk",
        "load_asu_bellows",
        "load_ftdcr",
        "load_soromox_tentacle",
    ),
    "_repeatability": ("repeatability",),
    "_shipped": ("load_trunk", "paper_split"),
}
__getattr__ = on_first_use(__name__, _NAMES_OF)
