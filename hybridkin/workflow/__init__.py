"""From a log to a model, a report and a track: what the command line does."""

from hybridkin.workflow._domain import middle_tip, path_limits
from hybridkin.workflow.describe import describe_model
from hybridkin.workflow.evaluate import evaluate_log
from hybridkin.workflow.fit import compare_by_group, fit_log
from hybridkin.workflow.log import LogError, MeasuredLog, read_log
from hybridkin.workflow.model import OpenedModel, open_model, trunk_model
from hybridkin.workflow.speed import measure_speed
from hybridkin.workflow.track import (
    animate_track,
    read_path,
    track_path,
)

__all__ = [
    "LogError",
    "MeasuredLog",
    "OpenedModel",
    "animate_track",
    "compare_by_group",
    "describe_model",
    "evaluate_log",
    "fit_log",
    "measure_speed",
    "middle_tip",
    "open_model",
    "path_limits",
    "read_log",
    "read_path",
    "track_path",
    "trunk_model",
]
