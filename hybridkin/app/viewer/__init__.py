"""A live 3D view of a robot in the browser: drag its target, move its actuators."""

from hybridkin.app.viewer.live import LiveView, view

__all__ = ["LiveView", "view"]
