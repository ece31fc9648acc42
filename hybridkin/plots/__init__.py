"""Figures: Display classes that hold plain arrays and draw them (the only user of matplotlib).

A display is made from arrays, or by ``from_estimator``, ``from_predictions`` and ``from_tracks``;
``plot`` draws it and returns it, with the axes as ``ax_`` and the figure as ``figure_``. Arrays
are in metres; ``unit`` is the unit of the axes. Colours are those of Okabe & Ito and cividis, which
colour-blind readers can distinguish, and lines differ in style too. A model has the same colour in
every figure: that of `model_color` for its name.
"""

from hybridkin.plots._canvas import model_color, new_figure
from hybridkin.plots._obstacles import obstacle_surface
from hybridkin.plots.animation import TrackAnimation
from hybridkin.plots.clearance import ClearanceDisplay
from hybridkin.plots.errors import ErrorBoxDisplay, ErrorHistogramDisplay
from hybridkin.plots.space import BackboneDisplay, WorkspaceDisplay
from hybridkin.plots.tracking import ActuatorDisplay, TrackingDisplay

__all__ = [
    "ActuatorDisplay",
    "BackboneDisplay",
    "ClearanceDisplay",
    "ErrorBoxDisplay",
    "ErrorHistogramDisplay",
    "TrackAnimation",
    "TrackingDisplay",
    "WorkspaceDisplay",
    "model_color",
    "new_figure",
    "obstacle_surface",
]
