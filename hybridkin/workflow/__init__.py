"""From a log to a model, a report and a track: the functions behind the command line."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from hybridkin.workflow.compare import Comparison, FitSettings, compare_by_group
    from hybridkin.workflow.description import Description, describe
    from hybridkin.workflow.domain import PathLimits, path_limits
    from hybridkin.workflow.evaluate import Evaluation, evaluate_log
    from hybridkin.workflow.export import Export, export_model
    from hybridkin.workflow.film import Film, animate_track
    from hybridkin.workflow.fit import fit_log
    from hybridkin.workflow.fit_record import FitRecord
    from hybridkin.workflow.log import LogError, MeasuredLog, read_log
    from hybridkin.workflow.model import LOG_SUFFIXES, LoadedModel, open_model
    from hybridkin.workflow.path import read_path, scaled_path, shape_path
    from hybridkin.workflow.planning import NextRows, next_rows
    from hybridkin.workflow.report import Report, json_text
    from hybridkin.workflow.track import TrackRecord, track_path
    from hybridkin.workflow.verify import Verification, verify_track

__all__ = [
    "LOG_SUFFIXES",
    "Comparison",
    "Description",
    "Evaluation",
    "Export",
    "Film",
    "FitRecord",
    "FitSettings",
    "LoadedModel",
    "LogError",
    "MeasuredLog",
    "NextRows",
    "PathLimits",
    "Report",
    "TrackRecord",
    "Verification",
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

_NAMES_OF = {
    "compare": ("Comparison", "FitSettings", "compare_by_group"),
    "description": ("Description", "describe"),
    "domain": ("PathLimits", "path_limits"),
    "evaluate": ("Evaluation", "evaluate_log"),
    "export": ("Export", "export_model"),
    "film": ("Film", "animate_track"),
    "fit": ("fit_log",),
    "fit_record": ("FitRecord",),
    "log": ("LogError", "MeasuredLog", "read_log"),
    "model": ("LOG_SUFFIXES", "LoadedModel", "open_model"),
    "planning": ("NextRows", "next_rows"),
    "path": ("read_path", "scaled_path", "shape_path"),
    "report": ("Report", "json_text"),
    "track": ("TrackRecord", "track_path"),
    "verify": ("Verification", "verify_track"),
}
_MODULE_OF = {name: module for module, names in _NAMES_OF.items() for name in names}


def __getattr__(name: str) -> Any:
    """Open public names on first use: what all of them need takes seconds to import."""
    if name in _MODULE_OF:
        return getattr(import_module(f"hybridkin.workflow.{_MODULE_OF[name]}"), name)
    raise AttributeError(f"module 'hybridkin.workflow' has no attribute {name!r}")


def __dir__() -> list[str]:
    return __all__
