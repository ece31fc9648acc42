"""Where a model may be steered: limits, commands it knows, a posture that keeps it there."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from hybridkin.chains.constant_curvature import ConstantCurvatureChain
from hybridkin.workflow.model import OpenedModel

_WALKERS, _PACES, _PACE = 256, 60, 0.12  # steps of a pace, as a share of the range
_EASE = 0.5  # domain distance from which the posture turns back; 1 is the edge of the domain


def path_limits(
    opened: OpenedModel,
    q_min: ArrayLike | None = None,
    q_max: ArrayLike | None = None,
    dq_max: ArrayLike | None = None,
) -> dict[str, Any]:
    """Return the limits of the actuators: those given, else the description's within the fit's.

    What the robot can do but the model has never seen is left out, unless it is asked for.

    Parameters
    ----------
    opened : OpenedModel
        The model, as from `open_model`.
    q_min, q_max, dq_max : float or array-like of shape (n,), optional
        Limits of the commands [m], and of their speed [m/s].

    Returns
    -------
    dict
        "q_min", "q_max" and "dq_max", ndarray of shape (n,) [m] and [m/s], the last None where
        there is none; with play they hold for what the actuators do. "source": where the first two
        come from.

    Raises
    ------
    ValueError
        If nobody knows the range of the actuators.
    """
    given = {"q_min": q_min, "q_max": q_max, "dq_max": dq_max}
    own = None if opened.description is None else opened.description.limits
    trained = opened.trained_range or (None, None)
    room = 0.0 if opened.play is None else 0.5 * opened.play.width  # commands go so much further
    found: dict[str, Any] = {}
    sources = []
    for name, learned, inwards, tighter in (
        ("q_min", trained[0], room, np.maximum),
        ("q_max", trained[1], -room, np.minimum),
    ):
        told = getattr(own, name, None)
        if given[name] is not None:
            found[name] = np.asarray(given[name], dtype=float) + inwards
            sources.append("given")
        elif told is not None and learned is not None:
            found[name] = tighter(told + inwards, learned)
            sources.append("robot description, within the range of the fit")
        elif told is not None:
            found[name] = told + inwards
            sources.append("robot description")
        elif learned is not None:
            found[name] = learned
            sources.append("range of the fit")
        else:
            raise ValueError(
                "`q_min` and `q_max` must be given (--q-min, --q-max), or stand as [limits] in the "
                "robot description: this model does not know the range of its actuators."
            )
    speed = getattr(own, "dq_max", None) if dq_max is None else dq_max
    found["dq_max"] = np.inf if speed is None else speed
    low, high, fast = (np.broadcast_to(v, opened.n_actuators).astype(float) for v in found.values())
    if (low > high).any():
        raise ValueError(
            "`q_min` must not exceed `q_max`, with half the play and the range of the fit counted "
            f"in, got {low.tolist()} and {high.tolist()} m."
        )
    source = " and ".join(dict.fromkeys(sources))
    return {
        "q_min": low,
        "q_max": high,
        "dq_max": None if speed is None else fast,
        "source": source,
    }


def preferred(opened: OpenedModel, limits: dict[str, Any]) -> NDArray:
    """Return a configuration (n,) that the model knows, within the limits.

    It is the middle of the fit's range or, where the model is not at home there, no tendon pulled;
    without a fit the second, else the middle of the limits.
    """
    low, high = opened.trained_range or (limits["q_min"], limits["q_max"])
    places = [0.5 * (low + high) @ _seen(opened.chain, opened.n_actuators)]
    if getattr(opened.chain, "lengths", None) is not None:
        places.insert(0 if opened.trained_range is None else 1, np.zeros(opened.n_actuators))
    places = [np.clip(place, limits["q_min"], limits["q_max"]) for place in places]
    if not opened.is_hybrid:
        return places[0]
    with torch.no_grad():
        weights = opened.module.error_weight(torch.from_numpy(np.stack(places)))
    return places[int(weights.argmax())]


def known_commands(opened: OpenedModel, limits: dict[str, Any]) -> tuple[NDArray, NDArray]:
    """Return commands (K, n) from all over the domain, within the limits, and their tips (K, 3).

    The first is near the preferred one.

    Random walks from the preferred configuration that do not leave the domain: with many actuators
    most of the box around the training rows lies outside it. On a plain tendon chain no tendon
    pulls against the others. Without a learned part they are drawn from the limits.
    """
    low, high, rng = limits["q_min"], limits["q_max"], np.random.default_rng(0)
    q = rng.uniform(low, high, (_WALKERS, opened.n_actuators))
    module, rest = opened.module, preferred(opened, limits)
    with torch.no_grad(), warnings.catch_warnings():
        warnings.filterwarnings("ignore", r"\d+ of \d+ rows of `\w+` pull the tendons")
        if opened.is_hybrid:
            q = np.tile(rest, (_WALKERS, 1))
            seen = _seen(opened.chain, opened.n_actuators)
            for _ in range(_PACES):
                pace = _PACE * (high - low) * rng.standard_normal(q.shape)
                ahead = q + pace @ seen
                inside = module.in_domain(torch.from_numpy(ahead)).numpy()
                inside &= ((ahead >= low) & (ahead <= high)).all(axis=1)
                q[inside] = ahead[inside]
            q[0] = (
                rest + 0.01 * (high - low) * rng.standard_normal(len(rest)) @ seen
            )  # not straight
        tips = module(torch.from_numpy(q)).numpy()
    known = np.isfinite(tips).all(axis=1)
    return q[known], tips[known]


def middle_tip(opened: OpenedModel, limits: dict[str, Any]) -> NDArray:
    """Return a place in the midst of the workspace that the model knows.

    It is the tip of a command within its domain that is nearest to the mean of all such tips: some
    robots reach only a surface.

    Parameters
    ----------
    opened : OpenedModel
        The model, as from `open_model`.
    limits : dict
        As from `path_limits`.

    Returns
    -------
    ndarray of shape (3,)
        The tip [m].
    """
    _, tips = known_commands(opened, limits)
    return tips[np.linalg.norm(tips - tips.mean(axis=0), axis=1).argmin()]


def _seen(chain: Any, n: int) -> NDArray:
    """Return the projector (n, n) on what bends a plain tendon chain; of others all is seen.

    Its bendings are linear in q, and blind to what its tendons pull against each other.
    """
    if not isinstance(chain, ConstantCurvatureChain) or chain.lengths is None:
        return np.eye(n)
    zero = torch.zeros(chain.n_actuators, dtype=torch.float64)
    slopes: Any = torch.autograd.functional.jacobian(lambda row: chain.arcs(row)[1].ravel(), zero)
    return (torch.linalg.pinv(slopes) @ slopes).numpy()


def homeward(
    opened: OpenedModel, limits: dict[str, Any], pull: float
) -> Callable[[Tensor], Tensor] | NDArray:
    """Return the posture for ``InverseKinematics(q_pref=...)``: towards what the model knows.

    Half way to the edge of the domain it begins to turn back, down the domain distance of q, and it is
    drawn to the `preferred` configuration, a share `pull` of the way; it is that configuration
    where nothing guards the domain.
    """
    rest = preferred(opened, limits)
    if not opened.is_hybrid or opened.model.guard is None:
        return rest
    home, squares = (
        torch.from_numpy(rest),
        torch.from_numpy((limits["q_max"] - limits["q_min"]) ** 2),
    )
    seen = torch.from_numpy(_seen(opened.chain, opened.n_actuators))

    def posture(q: Tensor) -> Tensor:
        rows = q.detach().reshape(-1, q.shape[-1])
        with torch.enable_grad():
            leaf = rows.clone().requires_grad_()
            value: Any = opened.module.domain_distance(leaf)
            (slope,) = torch.autograd.grad(value.sum(), leaf)
        downhill = squares.to(slope) * slope
        steepness = (slope * downhill).sum(-1, keepdim=True)
        over = (value.detach() - _EASE).clamp(min=0.0)[:, None]
        step = over * downhill / steepness.clamp(min=torch.finfo(q.dtype).tiny)
        step = step @ seen.to(step)
        return (rows - step + pull * (home.to(rows) - rows)).reshape(q.shape)

    return posture
