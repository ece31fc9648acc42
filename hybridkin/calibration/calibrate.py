"""Calibrated geometry of a chain from measured tips, with standard errors, identifiability."""

from __future__ import annotations

import difflib
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from hybridkin._core.arrays import (
    LARGEST,
    Numbers,
    as_tensor,
    check_shape,
    number,
    one_of,
)
from hybridkin._core.distinct import distinct_rows, targets_that_count
from hybridkin._core.groups import Groups
from hybridkin._core.portable import Portable
from hybridkin.calibration._least_squares import HELD_OUT, LOSSES, REFITTED, Fit, TipRows, solve
from hybridkin.calibration._search import NO_START, Start, search
from hybridkin.calibration._touches import DISTANCE_STD, Touches
from hybridkin.calibration._unidentified import sentences
from hybridkin.calibration.measured import evenly_spaced, with_missing_markers
from hybridkin.calibration.natural_scales import GEOMETRY
from hybridkin.chains.chain import Chain

__all__ = ["CalibrationResult", "calibrate"]

# Identified if the standard error is below this fraction of the prior. (The prior alone narrows k
# parameters that share one unidentified direction to 1 / sqrt(k).)
_IDENTIFIED = 0.1
_REDUNDANT = 1e-9  # of the largest motion of the tips: smaller ones are rounding
# fewest rows; ratio of residual to spread, a quarter of the variance
_FEW = 10
_ENOUGH = 500  # rows to calibrate on when rows are held out
_LEFT = 0.5
_MEASURED = ("radii", "lengths")  # sizes that can be measured with a ruler:
_UNPHYSICAL = 1.75  # a change by this factor gives a warning


@dataclass(frozen=True, repr=False)
class CalibrationResult(Portable):
    """Calibrated chain, and how well the data identify its geometry.

    Attributes
    ----------
    chain : Chain
        Copy of the given chain with the calibrated geometry.
    values : dict of str to array
        The calibrated geometry by parameter name, in the shapes and units of ``chain.geometry()``;
        "tool" () [m] is the last offset, "turns" (S,) [rad] the angle of the first actuator of
        each segment, "gain" () the first gain. Of rigid arms "gains" (n,) [-] holds the motion of
        the first joint of each actuator per motion of it.
    std_errors : dict of str to array
        One standard error for each entry of `values`; for "base" shape (6,), three of rotation
        [rad] and three of translation [m], in the measuring frame; for "axes" shape (n_joints, 2)
        [rad], towards the two coordinate axes of the joint's frame that `names` tell.
    correlations : ndarray of shape (P, P)
        Correlation of the P free parameters, in the order of `names`.
    names : tuple of P str
        Free parameters, e.g. "radii[0]" or "base[rot x]".
    narrowing : ndarray of shape (P,)
        Prior standard deviation over standard error, for each of `names`.
    identifiable : dict of str to bool array
        False if the data narrow the prior less than tenfold: that value is an assumption.
    singular_values : ndarray of shape (P,)
        Factors by which the data narrow the prior, along P independent directions, largest first.
        Directions below 10 are not identified by the data.
    unidentified : tuple of str
        One sentence with advice for each direction that is not identified by the data.
    unphysical : tuple of str
        Parameters, e.g. "lengths", with a value at a bound or outside the physical range. They
        compensate for effects that the model does not describe, even if they are identified.
    rmse : float
        Root mean square tip distance on the given data, over all markers [m]: from the measured
        tip, and from the calibrated position of a touched point.
    cv_rmse : float or None
        The same on held-out groups (at most 5 folds), if `groups` was given [m].
    converged : bool
        Whether the solver met its tolerance.
    messages : tuple of str
        The warnings that `calibrate` issued.
    points : dict of label to array of shape (3,)
        Calibrated positions of the points of `touched`, in the measuring frame [m]; empty without.
    point_errors : dict of label to array of shape (3,)
        Their standard errors [m].
    """

    chain: Chain
    values: dict[str, Any]
    std_errors: dict[str, Any]
    correlations: NDArray
    names: tuple[str, ...]
    narrowing: NDArray
    identifiable: dict[str, NDArray]
    singular_values: NDArray
    unidentified: tuple[str, ...]
    unphysical: tuple[str, ...]
    rmse: float
    cv_rmse: float | None
    converged: bool
    messages: tuple[str, ...] = ()
    points: dict[Any, Any] = field(default_factory=dict)
    point_errors: dict[Any, Any] = field(default_factory=dict)

    def __repr__(self) -> str:
        lines = [f"CalibrationResult(rmse={self.rmse:.3e} m, converged={self.converged})"]
        for name, value in self.values.items():
            lines.append(f"  {name}: {_shown(value)}")
            lines.append(f"    std. error {_shown(self.std_errors[name])}")
        if self.points:
            lines.append(f"  {len(self.points)} touched points")
        if self.unidentified:
            lines.append("  Not identified by the data, the values are from the prior:")
        for sentence in self.unidentified:
            lines.append(f"    {sentence}")
        return "\n".join(lines)


def _shown(value: Numbers) -> str:
    array = np.asarray(value)
    if array.shape == (4, 4):
        array = array[:3]
    rows = []
    for row in np.atleast_2d(array):
        rows.append(" ".join(f"{entry:.4g}" for entry in row))
    return "; ".join(rows)


def calibrate(
    chain: Chain,
    q: Numbers,
    x: Numbers | None,
    parameters: Sequence[str] = ("radii", "base"),
    *,
    loss: str = "linear",
    prior: float = GEOMETRY,
    groups: ArrayLike | None = None,
    sample_weight: Numbers | None = None,
    touched: ArrayLike | None = None,
    distances: Mapping[tuple[Any, Any], float] | None = None,
    distance_std: float = DISTANCE_STD,
) -> CalibrationResult:
    """Return the chain with the geometry that fits measured tips best, with standard errors.

    Nonlinear least squares on the tip distance with exact derivatives. Radii, lengths and gains
    are fitted by their logarithm and keep their sign. A weak prior keeps parameters that are not
    identified by the data near their start. Its weight follows the noise level, which is estimated
    from the residuals, so exact data override it. With a free base or free angles several initial
    guesses are tried, including other turns and mirror images of the actuator rings: a robot with
    actuators in the opposite order is recognised. So are motors of a rigid arm that count in the
    opposite direction, if its base or its gains are free. Tendons on a backbone of given length
    identify only the ratio of gains and radii, which `unidentified` then contains.

    No camera is needed where the tip touches the same points again and again, e.g. sockets, in
    different postures. The points are unknowns of the fit, each with its rows of `touched`. Touches
    do not show where the base is, whether the robot is its mirror image, nor how large it is if all
    of its lengths are free; `distances` between points fix its size.

    Parameters
    ----------
    chain : ConstantCurvatureChain, ElasticTendonChain, RigidChain or another Chain
        Start of the search; it is not changed.
    q : array or Tensor of shape (N, n_actuators)
        Actuator vectors [m, or unit of q of a chain with gains]; [rad] for revolute joints.
    x : array or Tensor of shape (N, 3) or (N, 3 K)
        Measured tip positions [m]; for a chain with K markers all of these, NaN if one was not
        measured. All have the same weight. Rows of NaN were not measured, which is allowed for rows
        of `touched`; None: no row was.
    parameters : sequence of str, default=("radii", "base")
        Entries of ``chain.geometry()``: "radii", "angles" (of every actuator), "lengths" (tendon
        chains), "offsets", "rest_bends", "actuator_zeros", "gains", "base" (pose); for elastic
        tendon chains also "bending_stiffness", "axial_stiffness" and "tendon_zeros"; for rigid
        arms "base", "tool", "joint_zeros", "links", "axes" (two angles for each joint) and "gains",
        a factor on the motion of the joints for each actuator (gear ratio). Smaller sets: "turns",
        one common turn of each segment's actuators, instead of "angles"; "tool", the last offset,
        instead of "offsets"; "gain", a common factor, instead of "gains".
    loss : {"linear", "soft_l1", "cauchy"}, default="linear"
        All but "linear" bound the influence of outliers: ``rho(|e|^2 / 3)`` of SciPy's
        ``least_squares``, with the distance ``|e|`` of a row over the noise, times its weight.
    prior : float, default=0.5
        Standard deviation of the weak prior in natural units: a fraction of the start for radii,
        lengths, gains and stiffnesses; of the mean radius (over the mean gain if q is not a length)
        for actuator and tendon zeros; of the robot's length for "offsets", "links", "tool", zeros
        of sliding joints and the base position; radians for angles, rest bends, zeros of turning
        joints, "axes" and the base orientation. ``inf`` turns it off. Values also stay within a
        factor of 5 of the start for radii, lengths and gains and of 10 000 for stiffnesses, half a
        turn for rest bends, and above minus a tenth of the robot's length for offsets.
    groups : array-like of shape (N,), optional
        Motion of every row; required for `cv_rmse` on held-out motions.
    sample_weight : array-like of shape (N,), optional
        How often each row counts: 2 is the same as the row twice, 0 drops it, whatever x holds
        there. Equal rows are held out together.
    touched : array-like of shape (N,), optional
        Label of the point that the tip touched in each row, a str or an int; "", None or NaN: none.
        Rows with the same label touched the same point, whose position is not known. Its
        position errors have the same noise as measured tips.
    distances : dict of (label, label) to float, optional
        Known distances between touched points [m].
    distance_std : float, default=1e-4
        Standard error of each of `distances` [m].

    Returns
    -------
    CalibrationResult
        ``.chain`` is the calibrated chain.

    Raises
    ------
    ValueError
        For unknown parameters, wrong shapes, or data that are not finite. For points touched in one
        row, distances between others, and "base" among `parameters` if no tip was measured.

    Warns
    -----
    UserWarning
        If q or x look like millimetres. If there are fewer different rows than free parameters. If
        a quarter of the variance of the tips remains, e.g. with columns of q in a wrong order. If
        a value is at a bound or not physical. If the mirror image of the given robot, or a rigid
        arm with some actuators reversed, fits the data far better; it is then returned. If tendons
        of a ConstantCurvatureChain contradict each other, e.g. slack tendons. If the robot shrinks
        to touch all points at once.

    References
    ----------
    Reinhart & Steil (2016), section 2.1 (radii fitted to recorded movements).

    Examples
    --------
    >>> import torch
    >>> from hybridkin import ConstantCurvatureChain, calibrate
    >>> q = 0.25 + 0.05 * torch.rand(50, 6, generator=torch.manual_seed(0), dtype=torch.float64)
    >>> truth = ConstantCurvatureChain([0.05, 0.04])
    >>> result = calibrate(ConstantCurvatureChain([0.06, 0.06]), q, truth(q), ("radii",))
    >>> result.values["radii"]
    tensor([0.0500, 0.0400], dtype=torch.float64)

    Without a camera: the tip of the same robot touches each of two sockets in eight postures.

    >>> from hybridkin import InverseKinematics
    >>> sockets = truth(q[:2]).repeat_interleave(8, dim=0)
    >>> ik = InverseKinematics(truth, q_min=0.2, q_max=0.3, beta=0.0)
    >>> touching = ik.solve(sockets, q[2:18], tol=1e-9, max_iter=1000).q
    >>> start = ConstantCurvatureChain([0.06, 0.06])
    >>> labels = ["left"] * 8 + ["right"] * 8
    >>> result = calibrate(start, touching, None, ["radii"], touched=labels)
    >>> result.values["radii"]
    tensor([0.0500, 0.0400], dtype=torch.float64)
    >>> [*result.points]
    ['left', 'right']
    """
    result = fit_geometry(
        chain,
        q,
        x,
        parameters,
        loss,
        prior,
        groups,
        sample_weight,
        touched=touched,
        distances=distances,
        distance_std=distance_std,
    )
    for message in result.messages:
        warnings.warn(message, stacklevel=2)
    return result


def fit_geometry(
    chain: Chain,
    q: Numbers,
    x: Numbers | None,
    parameters: Sequence[str],
    loss: str = "linear",
    prior: float = GEOMETRY,
    groups: ArrayLike | Groups | None = None,
    sample_weight: Numbers | None = None,
    start: Start = NO_START,
    touched: ArrayLike | None = None,
    distances: Mapping[tuple[Any, Any], float] | None = None,
    distance_std: float = DISTANCE_STD,
) -> CalibrationResult:
    """Return the result of `calibrate`; no warning is issued.

    A `start` from `search` for the same chain and parameters replaces the search.
    """
    # The public entry: a function or an estimator has no geometry.
    if not isinstance(chain, Chain):
        raise TypeError(
            "`chain` must be a ConstantCurvatureChain, an ElasticTendonChain, a RigidChain or "
            f"another Chain, got {type(chain).__name__}."
        )
    names = check_parameters(chain, parameters)
    prior = number(prior, "prior")
    if not prior > 1.0 / LARGEST:
        need = f"must be a positive standard deviation, over {1.0 / LARGEST:g}"
        raise ValueError(f"`prior` {need}, got {prior}.")
    one_of(loss, "loss", LOSSES)
    returns_tensors = isinstance(q, Tensor)
    device = chain.geometry()["base"].device
    chain = chain.frozen().cpu()  # the solver runs on the CPU, without a graph
    q = as_tensor(q, "q").to("cpu", chain.geometry()["base"].dtype)
    check_shape(q, "q", ("N", "n_actuators"))
    weights = _check_weights(sample_weight, q)
    touches = Touches.of(touched, distances, distance_std, weights.numpy())
    x = targets_that_count(touches.tips(x, chain.n_outputs, weights.numpy()), sample_weight, "x")
    may_lack_tip = touches.touching | (weights.numpy() == 0.0)
    q, x, unit_messages = check_data(chain, q, x, may_lack_tip)
    motions = Groups.of(groups, len(q))
    apart = np.column_stack([motions.apart, touches.point])
    first, counts, _ = distinct_rows(q, x, weights, apart)
    rows = TipRows(q[first], x[first], torch.from_numpy(counts).to(q))
    rows = touches.rows(chain, names, rows, first)
    if not start.n_free:
        start = search(chain, rows, names, loss, prior)
    best = solve(start.problem, rows, start.theta, loss)
    unphysical, doubts = _unphysical(best)
    messages = [
        *unit_messages,
        *start.messages,
        *rows.few_messages(_n_independent(best)),
        *doubts,
        *best.chain().contradictions(q),
    ]
    if not unit_messages:
        messages += _unexplained(best)
    messages += touches.messages(chain, best)
    cv_rmse = None
    if motions.whole:
        cv_rmse = _cross_validate(best, rows, motions.take(first), loss)
    result = _result(best, touches, cv_rmse, unphysical, returns_tensors)
    result.chain.to(device)
    return replace(result, messages=tuple(messages))


def refitted(start: Start, q: Tensor, x: Tensor, weights: Tensor, loss: str = "linear") -> Chain:
    """Return only the chain of a calibration to different rows from a start.

    It is for errors of held-out rows: of many rows, which follow one another in a log, evenly
    spaced ones determine the few parameters.
    """
    like = start.problem.chain.geometry()["base"]
    rows = TipRows(q.to(like), x.to(like), weights.to(like))
    rows = rows.take(evenly_spaced(len(q), _ENOUGH))
    return start.fitted(rows, loss, REFITTED)


def _n_independent(fit: Fit) -> int:
    """Return the number of free parameters; those that compensate each other count once.

    They all count where the rows suffice for them, or are too few to see it.
    """
    n_free = fit.theta.size
    if not len(fit.rows.q) < n_free < len(fit.jacobian):
        return n_free
    columns = fit.jacobian * fit.problem.prior_std
    return int(np.linalg.matrix_rank(columns, _REDUNDANT * np.linalg.norm(columns, 2)))


def _unexplained(fit: Fit) -> list[str]:
    """Return a warning if the median residual is large, which a few outliers cannot cause."""
    rows = fit.rows
    residual = np.median(np.linalg.norm(fit.residual, axis=1))
    spread = np.median(np.linalg.norm(rows.centred(fit.unknowns), axis=1))
    if len(rows.x) < _FEW or not 0 < _LEFT * spread < residual:
        return []
    may_be_wrong = rows.may_be_wrong(fit.problem.chain)
    return [
        f"the calibrated model has a median residual of {1e3 * residual:.3g} mm, but the tip moves "
        f"by only {1e3 * spread:.3g} mm. Order or sign of the columns of `q`, {may_be_wrong}"
    ]


def _unphysical(fit: Fit) -> tuple[tuple[str, ...], list[str]]:
    """Return the parameters at a bound or outside the physical range, and a warning."""
    problem = fit.problem
    problems = []
    for part, place in problem.places():
        theta = fit.theta[place]
        below = theta - problem.low[place]
        above = problem.high[place] - theta
        for k, label in enumerate(part.labels):
            if min(below[k], above[k]) < 1e-6:
                side = "lower" if below[k] < above[k] else "upper"
                problems.append((part.name, f"{label} is at its {side} bound"))
            if part.name in _MEASURED and abs(theta[k]) > np.log(_UNPHYSICAL):
                times = f"{np.exp(theta[k]):.2g} times its start"
                problems.append((part.name, f"{label} is {times}"))
        if part.entry == "offsets":
            before = part.value(part.start).reshape(-1)
            after = part.value(fit.chain().geometry()["offsets"]).reshape(-1)
            for k, label in enumerate(part.labels):
                shorter = float(before[k] - after[k]) > 1e-3 * part.units[k]
                if shorter and float(after[k]) < -0.02 * part.units[k]:
                    length = f"{1e3 * float(after[k]):.3g} mm"
                    problems.append((part.name, f"{label} is {length}"))
    if not problems:
        return (), []
    names = dict.fromkeys(name for name, _ in problems)
    words = "; ".join(problem for _, problem in problems)
    return tuple(names), [
        f"calibration gave unphysical values: {words}. Check the units and the start, "
        "narrow the `prior`, or fit fewer `parameters`; the robot may have effects that this model "
        "does not describe (slack tendons, gravity, twist)."
    ]


def _result(
    fit: Fit,
    touches: Touches,
    cv_rmse: float | None,
    unphysical: tuple[str, ...],
    returns_tensors: bool,
) -> CalibrationResult:
    problem = fit.problem
    chain = fit.chain()
    prior_std = problem.prior_std
    # Singular values of J in units of the prior; those of J'J would lose small ones to rounding.
    J = fit.jacobian * prior_std / fit.noise
    _, narrowed, directions = np.linalg.svd(J, full_matrices=len(J) < J.shape[1])
    narrowed = np.pad(narrowed, (0, len(prior_std) - narrowed.size))
    factor = prior_std[:, None] * directions.T / np.sqrt(narrowed**2 + 1.0)
    covariance = factor @ factor.T
    std = np.sqrt(np.diag(covariance))
    identified = std < _IDENTIFIED * prior_std
    values = {}
    std_errors = {}
    identifiable = {}
    for part, place in problem.places():
        value = part.value(chain.geometry()[part.entry].detach())
        errors = np.asarray(part.std_errors(std[place], value.numpy()))
        identifiable[part.name] = identified[place].reshape(part.shape)
        values[part.name] = value if returns_tensors else value.numpy()
        std_errors[part.name] = torch.from_numpy(errors) if returns_tensors else errors
    unidentified = directions[narrowed * _IDENTIFIED < 1.0]
    n_rows = float(fit.rows.weights.sum())
    size_error = float(np.linalg.norm(fit.slopes.growth @ factor))
    point_errors = fit.slopes.std_of_unknowns(factor)
    safe = np.where(std > 0, std, 1.0)
    return CalibrationResult(
        chain=chain,
        values=values,
        std_errors=std_errors,
        correlations=covariance / np.outer(safe, safe),
        names=problem.labels,
        narrowing=prior_std / safe,
        identifiable=identifiable,
        singular_values=narrowed,
        unidentified=(
            *touches.size_sentences(size_error),
            *sentences(fit, unidentified, covariance, n_rows),
        ),
        unphysical=unphysical,
        rmse=fit.rmse,
        cv_rmse=cv_rmse,
        converged=fit.converged,
        points=touches.by_name(fit.unknowns, returns_tensors),
        point_errors=touches.by_name(point_errors, returns_tensors),
    )


def _cross_validate(best: Fit, rows: TipRows, motions: Groups, loss: str) -> float:
    squares = 0.0
    for train, test in motions.folds():
        fit = solve(best.problem, rows.take(train), best.theta, loss, HELD_OUT)
        held_out = rows.take(test)
        tips = held_out.tips(fit.chain())
        unknowns = held_out.known_after(fit.rows, fit.unknowns, tips)
        errors = held_out.at_scale_of(tips).errors(tips, unknowns)
        squares += held_out.rms(errors) ** 2 * float(held_out.weights.sum())
    return float(np.sqrt(squares / float(rows.weights.sum())))


def check_parameters(chain: Chain, parameters: Sequence[str]) -> tuple[str, ...]:
    """Return the names of parameters that a chain has, checked."""
    names = (parameters,) if isinstance(parameters, str) else tuple(parameters)
    available = chain.parameter_names
    unknown = [str(name) for name in names if name not in available]
    if unknown or not names or len(set(names)) < len(names):
        raise ValueError(
            f"`parameters` must name different entries of {available} for this chain, got "
            f"{names}{_hint(unknown, available)}"
        )
    for alias, entry in chain.aliases.items():
        if alias in names and entry in names:
            raise ValueError(
                f"`parameters` must not hold both {entry!r} and {alias!r}, which is a part of it; "
                f"leave {alias!r} out."
            )
    return names


def _hint(unknown: Sequence[str], available: Sequence[str]) -> str:
    """Return the end of a message: what may have been meant by the first unknown name."""
    if not unknown:
        return "."
    name = unknown[0]
    if name in ("auto", "default"):
        return (
            "; 'auto' and 'default' are for `HybridForwardModel(calibrate=...)`: here leave "
            "`parameters` out, or let `choose_geometry` choose."
        )
    near = difflib.get_close_matches(name, available, 1)
    near += [entry for entry in available if name in entry]
    return f"; did you mean {near[0]!r}?" if near else "."


def check_data(
    chain: Chain, q: Numbers, x: Any, may_lack_tip: ArrayLike = False
) -> tuple[Tensor, Tensor, list[str]]:
    """Return the data as tensors in the dtype of the chain, and warnings about their units.

    Rows (N,) that may lack their tip may have NaN in all columns of x.
    """
    dtype = chain.geometry()["base"].dtype
    q = as_tensor(q, "q").to("cpu", dtype)
    x = as_tensor(x, "x").to("cpu", dtype)
    check_shape(q, "q", ("N", "n_actuators"))
    check_shape(x, "x", (len(q), chain.n_outputs), "one tip position per row of `q`")
    if len(q) == 0:
        raise ValueError("`q` must hold at least one row, got none.")
    messages = chain.check_actuators(q)
    tips = x.numpy(force=True)
    lacking = np.logical_and(may_lack_tip, np.isnan(tips).all(axis=1))
    present = np.where(lacking[:, None], 0.0, tips)
    checked = with_missing_markers(present.astype(tips.dtype), "x")
    x = torch.from_numpy(np.where(lacking[:, None], np.nan, checked).astype(tips.dtype))
    return q, x, [*messages, *chain.tip_messages(q, x, "x")]


def _check_weights(sample_weight: Numbers | None, q: Tensor) -> Tensor:
    if sample_weight is None:
        return q.new_ones(len(q))
    weights = as_tensor(sample_weight, "sample_weight").to(q)
    valid = torch.isfinite(weights) & (weights >= 0)
    if weights.shape != (len(q),) or not valid.all() or not weights.any():
        raise ValueError(
            f"`sample_weight` must hold {len(q)} non-negative numbers, not all zero, got shape "
            f"{tuple(weights.shape)}."
        )
    return weights
