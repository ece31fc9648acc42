"""What all pictures share: figures, units, colours, and arrays checked as they come in."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import torch
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

LENGTHS = {"m": 1.0, "cm": 100.0, "mm": 1000.0}
# Okabe & Ito: told apart by colour-blind readers too.
COLORS = ("#D55E00", "#0072B2", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000", "#F0E442")
STYLES = ("--", "-", "-.", ":")
MARKERS = ("o", "s", "^", "D", "v", "P", "X", "*")


def new_figure(
    width: float, height: float, rows: int = 1, columns: int = 1, **options: Any
) -> tuple[Figure, Any]:
    """Return a figure outside pyplot's list, for files rather than windows, and its axes.

    Parameters
    ----------
    width, height : float
        Size [inch].
    rows, columns : int, default=1
        Grid of axes.
    **options
        Handed to ``Figure.subplots``.

    Returns
    -------
    figure : matplotlib Figure
        To be saved with ``figure.savefig``.
    axes : Axes or ndarray of Axes
        One, or the grid.

    Examples
    --------
    >>> from hybridkin import plots
    >>> figure, axes = plots.new_figure(6.0, 3.0, 1, 2, sharey=True)
    >>> axes.shape
    (2,)
    """
    figure = Figure(figsize=(width, height), layout="constrained", dpi=200)
    return figure, figure.subplots(rows, columns, **options)


def axes_or_new(ax: Any, projection: str | None = None) -> Any:
    """Return the axes given, or those of a new figure of pyplot, so that ``plt.show()`` shows it.

    Axes of a plane where space is to be drawn raise.
    """
    if ax is None:
        return plt.figure(layout="constrained").add_subplot(projection=projection)
    if projection == "3d" and not hasattr(ax, "get_zlim"):
        raise TypeError(
            '`ax` must be a 3-D axes, got a plane one; make it with projection="3d", as in '
            'plots.new_figure(5, 4, subplot_kw={"projection": "3d"}).'
        )
    return ax


def several_axes(axes: Any, need: int, width: float, height: float, rows: bool = False) -> NDArray:
    """Return `need` axes as a flat array: those given, or new ones side by side or in rows."""
    if axes is None:
        grid = (need, 1) if rows else (1, need)
        options: dict[str, Any] = {"sharex": rows, "squeeze": False, "layout": "constrained"}
        return plt.subplots(*grid, figsize=(width, height), **options)[1].ravel()
    flat = np.ravel(np.asarray(axes, dtype=object))
    if len(flat) != need:
        raise ValueError(f"`axes` must hold {need} axes, got {len(flat)}.")
    return flat


def scale_of(unit: str, known: Mapping[str, float] = LENGTHS) -> float:
    """Return how many of a unit one metre has, or one radian."""
    if unit not in known:
        raise ValueError(f"`unit` must be one of {[*known]}, got {unit!r}.")
    return known[unit]


def decimals(values: Any) -> int:
    """Return how many decimals show the largest of the values with two digits, 2 to 6."""
    values = np.asarray(values, dtype=float)
    largest = float(np.abs(values[np.isfinite(values)]).max(initial=0.0))
    return 2 if largest == 0.0 else int(np.clip(1 - np.floor(np.log10(largest)), 2, 6))


def label_space(ax: Any, unit: str) -> None:
    """Name the axes of space, with equal scales, none too short, and panes that do not shout."""
    ax.set(xlabel=f"x [{unit}]", ylabel=f"y [{unit}]", zlabel=f"z [{unit}]")
    low, high = np.array([ax.get_xlim(), ax.get_ylim(), ax.get_zlim()]).T
    middle, half = 0.5 * (low + high), 0.5 * (high - low)
    half = half.clip(min=0.25 * half.max())
    ax.set(**{f"{k}lim": (m - h, m + h) for k, m, h in zip("xyz", middle, half, strict=True)})
    for axis, share in zip((ax.xaxis, ax.yaxis, ax.zaxis), half / half.max(), strict=True):
        axis.set_pane_color((1.0, 1.0, 1.0, 0.0))
        axis.set_major_locator(MaxNLocator(max(2, round(5 * share))))
    ax.patch.set_visible(False)  # or it hides the labels of the axes beside it
    ax.set_aspect("equal")
    ax.set_box_aspect(half, zoom=0.92)  # room for the z-axis' name, which layouts do not see


def plain(value: Any, name: str = "array") -> NDArray:
    """Return numbers of any kind, torch tensors too, as a float array of their own."""
    value = value.detach().cpu().numpy() if isinstance(value, torch.Tensor) else value
    try:
        return np.array(value, dtype=float)
    except (TypeError, ValueError) as error:
        raise ValueError(f"`{name}` must be numeric, got {value!r}.") from error


def tips(value: Any, name: str, n_rows: int | None = None) -> NDArray:
    """Return positions (N, 3) [m], checked; NaN rows are let pass."""
    array = plain(value, name)
    rows = "N" if n_rows is None else str(n_rows)
    if array.ndim != 2 or array.shape[1] != 3 or (n_rows is not None and len(array) != n_rows):
        raise ValueError(f"`{name}` must have shape ({rows}, 3), got {array.shape}.")
    return array


def times(value: Any, n_rows: int) -> NDArray | None:
    """Return times (T,) [s] that increase, or None."""
    if value is None:
        return None
    t = plain(value, "t")
    if t.shape != (n_rows,):
        raise ValueError(f"`t` must have shape ({n_rows},), one time per row, got {t.shape}.")
    if not (np.diff(t) > 0.0).all():
        raise ValueError("`t` must increase [s]; sort the rows and drop repeated or unknown times.")
    return t


def named(value: Any, name: str) -> dict[str, Any]:
    """Return several things by name; a single one is not named."""
    if not isinstance(value, Mapping) or not value:
        raise ValueError(
            f"`{name}` must be a mapping from names to arrays, at least one, got {value!r:.80}; "
            f"write {{'model': ...}} for a single one."
        )
    return {str(key): item for key, item in value.items()}


def distance(a: NDArray, b: NDArray) -> NDArray:
    """Return the distances of rows, NaN where either is not known."""
    return np.linalg.norm(a - b, axis=-1)


def predictions_of(models: Any, q: Any) -> dict[str, NDArray]:
    """Return by name what models predict for the rows of q; a hybrid model shows both its parts."""
    if isinstance(models, Mapping):
        return {name: predicted(model, q) for name, model in named(models, "models").items()}
    if getattr(models, "mechanical_model_", None) is not None:
        mechanical = _positions(models, models.predict_mechanical(q))
        return {"mechanical": mechanical, "hybrid": predicted(models, q)}
    return {type(models).__name__: predicted(models, q)}


def predicted(model: Any, q: Any) -> NDArray:
    """Return the tips that a fitted estimator or a torch module gives for rows of q [m]."""
    if hasattr(model, "predict"):
        return _positions(model, model.predict(q))
    if not isinstance(model, torch.nn.Module):
        raise TypeError(
            f"`model` must be a fitted estimator or a chain, got {type(model).__name__}."
        )
    with torch.no_grad():
        return plain(model(torch.from_numpy(plain(q, "q"))))


def measured(models: Any, x: Any) -> NDArray:
    """Return measured positions; of poses given to models of poses the position alone."""
    each = models.values() if isinstance(models, Mapping) else [models]
    poses = any(getattr(model, "output", None) == "pose" for model in each)
    return plain(x, "x")[:, :3] if poses else plain(x, "x")


def _positions(model: Any, x: Any) -> NDArray:
    x = plain(x)
    return x[:, :3] if getattr(model, "output", None) == "pose" else x
