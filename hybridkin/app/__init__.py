"""The application: from a log to a model, a report, a track and a view.

It uses the library by its public names only.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from hybridkin._core.first_use import on_first_use

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

_NAMES_OF = {
    "checks": ("LogFinding", "LogReport", "check_log"),
    "viewer": ("LiveView", "view"),
}
_open_name = on_first_use(__name__, _NAMES_OF)


def __getattr__(name: str) -> Any:
    """Open public names on first use: the command line answers before torch is loaded."""
    if name == "workflow":
        return import_module("hybridkin.app.workflow")
    return _open_name(name)


def __dir__() -> list[str]:
    return __all__
