"""From a log to a model, a report and a track: the functions behind the command line."""

from hybridkin.workflow._describe import describe
from hybridkin.workflow.domain import PathLimits, path_limits
from hybridkin.workflow.evaluate import evaluate_log
from hybridkin.workflow.export import export_model
from hybridkin.workflow.fit import Comparison, FitSettings, compare_by_group, fit_log
from hybridkin.workflow.log import LogError, MeasuredLog, read_log
from hybridkin.workflow.model import LOG_SUFFIXES, LoadedModel, open_model
from hybridkin.workflow.next_rows import next_rows
from hybridkin.workflow.path import read_path, scaled_path, shape_path
from hybridkin.workflow.report import Report, json_text
from hybridkin.workflow.track import animate_track, track_path
from hybridkin.workflow.verify import verify_track

__all__ = [
    "LOG_SUFFIXES",
    "Comparison",
    "FitSettings",
    "LoadedModel",
    "LogError",
    "MeasuredLog",
    "PathLimits",
    "Report",
    "animate_track",
    "compare_by_group",
    "describe",
    "evaluate_log",
    "export_model",
    "fit_log",
    "json_text",
    "next_rows",
    "open_model",
    "path_limits",
    "read_log",
    "read_path",
    "scaled_path",
    "shape_path",
    "track_path",
    "verify_track",
]
