"""From a log to a model, a report and a track: the functions behind the command line."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from hybridkin.app.workflow.description import describe
from hybridkin.app.workflow.log import LogError, read_log
from hybridkin.app.workflow.report import Report

if TYPE_CHECKING:
    from hybridkin.app.workflow.compare import FitSettings
    from hybridkin.app.workflow.counts import Counts
    from hybridkin.app.workflow.delay import estimated_delay
    from hybridkin.app.workflow.domain import PathLimits, path_limits
    from hybridkin.app.workflow.evaluate import evaluate_log
    from hybridkin.app.workflow.export import export_model
    from hybridkin.app.workflow.film import animate_track
    from hybridkin.app.workflow.fit import fit_log
    from hybridkin.app.workflow.merge import merge_files
    from hybridkin.app.workflow.path import scaled_path, shape_path
    from hybridkin.app.workflow.planning import next_rows
    from hybridkin.app.workflow.track import track_path
    from hybridkin.app.workflow.verify import read_tips, verify_track

__all__ = [
    "Counts",
    "FitSettings",
    "LogError",
    "PathLimits",
    "Report",
    "animate_track",
    "describe",
    "estimated_delay",
    "evaluate_log",
    "export_model",
    "fit_log",
    "merge_files",
    "next_rows",
    "path_limits",
    "read_log",
    "read_tips",
    "scaled_path",
    "shape_path",
    "track_path",
    "verify_track",
]

# A description of a robot needs no fit and no inverse kinematics.
_MODULE_OF = {
    "Counts": "counts",
    "FitSettings": "compare",
    "PathLimits": "domain",
    "animate_track": "film",
    "estimated_delay": "delay",
    "evaluate_log": "evaluate",
    "export_model": "export",
    "fit_log": "fit",
    "merge_files": "merge",
    "next_rows": "planning",
    "path_limits": "domain",
    "read_tips": "verify",
    "scaled_path": "path",
    "shape_path": "path",
    "track_path": "track",
    "verify_track": "verify",
}


def __getattr__(name: str) -> Any:
    """Open names on first use."""
    if name not in _MODULE_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_MODULE_OF[name]}"), name)
