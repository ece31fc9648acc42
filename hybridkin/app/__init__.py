"""The application: from a log to a model, a report, a track and a view.

It uses the library by its public names only.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from hybridkin.app import workflow
    from hybridkin.app.checks import LogFinding, LogReport, check_log
    from hybridkin.app.viewer import LiveView, view

__all__ = [
    "LiveView",
    "LogFinding",
    "LogReport",
    "check_log",
    "view",
    "workflow",
]

_MODULE_OF = {
    "LiveView": "viewer",
    "LogFinding": "checks",
    "LogReport": "checks",
    "check_log": "checks",
    "view": "viewer",
}


def __getattr__(name: str) -> Any:
    """Open public names on first use: the command line answers before torch is loaded."""
    if name == "workflow":
        return import_module("hybridkin.app.workflow")
    if name not in _MODULE_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"hybridkin.app.{_MODULE_OF[name]}"), name)


def __dir__() -> list[str]:
    return __all__
