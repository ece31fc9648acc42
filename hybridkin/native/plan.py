"""Plans: a model as one array of numbers and one of integers, for the compiled core."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular

from hybridkin._core.stored import Stored

# Kinds of nodes, numbered as in src/plan.h.
ARCS, ELASTIC, RIGID, AFFINE, ELM, POLYNOMIAL, KERNEL, READOUT = range(1, 9)
LEVERAGE_GUARD, BOX_GUARD, QUADRATIC_LEVERAGE, HYBRID, IK, GROUP_DISTANCE = range(9, 15)
ADAPTED, PROJECTED = range(15, 17)
GROUPED = (AFFINE, ELM, KERNEL, QUADRATIC_LEVERAGE)
GROUP = 8  # hidden units, or columns of a leverage, stored together
ACTIVATIONS = ("logistic", "tanh", "sin", "gaussian")
QUADRATIC, POSE = 1, 3  # features of a readout
MAX_NORMALS = 6  # IK_MOST_ROWS - IK_ROWS in src/ik_box.h
ROUNDING = 1e-7  # of weights that sum to one
# Largest sizes that the kernels support, see src/plan.h.
MOST = {"actuators": 64, "segments": 16, "outputs": 64, "features": 2048, "powers": 1024}


class NoKernel(ValueError):
    """Error: a part of a model has no kernel; the message names the part and the reason."""


class Plan:
    """The nodes of a model, each after its parts, and the numbers they use.

    Attributes
    ----------
    code : ndarray of int32
        The largest sizes, in the order of MOST. Then for each node: kind, lengths of input and
        output, place of its numbers, then its sizes and the places of its parts.
    data : ndarray of float64
        All numbers.
    n_inputs, n_outputs : int
        Lengths of q and of x.
    root : int
        Place in `code` of the node of the whole model.
    places : list of int
        Places of all nodes, in the order of their numbers.
    largest : dict
        Largest sizes, named as in MOST.
    """

    def __init__(self, stored: Stored) -> None:
        self._code = [0] * len(MOST)  # then the largest sizes
        self._data: list[NDArray] = []
        self._length = 0
        self.largest: dict[str, int] = {}
        self._known: dict[tuple, int] = {}
        self.root = self.node_of(stored)
        self.n_inputs, self.n_outputs = self._code[self.root + 1 : self.root + 3]
        self._code[: len(MOST)] = [self.largest.get(what, 0) for what in MOST]
        self.code = np.array(self._code, dtype=np.int32)
        whole = np.zeros(self._length + 2 * GROUP)
        start = -whole.ctypes.data // 8 % GROUP  # at the start of a cache line
        self.data = whole[start : start + self._length + GROUP]
        self.data[:-GROUP] = np.concatenate(self._data)
        self.places = [*self._known.values()]
        self._data, self._known = [], {}  # do not pickle them twice
        for array in (self.code, self.data):
            array.flags.writeable = False

    @property
    def digest(self) -> str:
        """SHA-256 of the plan: equal plans compute the same."""
        return hashlib.sha256(self.code.tobytes() + self.data.tobytes()).hexdigest()

    def node_of(self, stored: Stored) -> int:
        """Write the node of a description after its parts, and return its place."""
        write = WRITERS.get(stored.kind)
        if write is None:
            raise NoKernel(f"a part of the kind {stored.kind!r} has no kernel")
        return write(self, stored)

    def node(self, kind: int, n: int, m: int, numbers: list[NDArray], *more: int) -> int:
        """Write a node with its numbers, and return its place; equal nodes share one place."""
        for what, size in (("actuators", n), ("outputs", m)):
            self.limit(what, size)
        flat = [np.asarray(part, dtype=np.float64).ravel() for part in numbers]
        key = (kind, n, m, *more, *(part.tobytes() for part in flat))
        if key not in self._known:
            self._known[key] = len(self._code)
            if kind in GROUPED:  # aligned after center, scale, intercept and direct link
                self._data.append(np.zeros(-(self._length + 2 * n + m + m * n) % GROUP))
                self._length += len(self._data[-1])
            self._code += [kind, n, m, self._length, *map(int, more)]
            self._data += flat
            self._length += sum(map(len, flat))
        return self._known[key]

    def entry(self, place: int, k: int) -> int:
        """Return entry k of a node: 0 its kind, 1 and 2 its lengths, from 4 on its own entries."""
        return self._code[place + k]

    def limit(self, what: str, size: int) -> None:
        """Record a size, and raise if it is larger than the kernels support."""
        self.largest[what] = max(size, self.largest.get(what, 0))
        if size > MOST[what]:
            raise NoKernel(f"{size} {what}: the kernels support at most {MOST[what]}")


def _frame(plan: Plan, stored: Stored, reach: float) -> tuple[NDArray, NDArray]:
    """Return the frame of a chain of arcs, and the shares (m,) of its m segments up to the tip.

    The frame is the rotation and position of the base, the reach, and the rigid offsets.
    """
    base, at = stored.array("base"), stored.value("tip_at", float)
    (_, x, y, z), *others = stored.settings.get("markers", [[at, 0.0, 0.0, 0.0]])
    if others or x or y:
        raise NoKernel("several markers, or a marker beside the backbone, have no kernel")
    offsets = stored.array("offsets")
    plan.limit("segments", len(offsets))
    m = math.ceil(at)
    share = np.append(np.ones(m - 1), at - m + 1)
    frame = [base[:3, :3].ravel(), base[:3, 3], [reach], offsets[:m] * (share == 1)]
    frame[3][-1] += z
    return np.concatenate(frame), share


def whole_chain(plan: Plan, stored: Stored) -> int:
    """Write the node of a chain of arcs up to the robot's end, wherever its tip is."""
    at = float(len(stored.array("offsets")))
    end = {"tip_at": at, "markers": [[at, 0.0, 0.0, 0.0]]}
    return plan.node_of(replace(stored, settings={**stored.settings, **end}))


def _constant_curvature(plan: Plan, stored: Stored) -> int:
    given, radii = stored.arrays.get("lengths"), stored.array("radii")
    if stored.settings.get("stage") is not None:
        raise NoKernel("a chain on a rotation stage has no kernel")
    frame, share = _frame(plan, stored, 10.0 * radii.mean() if given is None else given.sum())
    m, S = len(share), len(radii)
    # Segment by segment: lengths, x-, y-bendings.
    matrix, zero = (
        stored.derived[name].reshape(3, S, -1).swapaxes(0, 1)[:m] * share[:, None, None]
        for name in ("arc_matrix", "arc_offset")
    )
    n, step, width = matrix.shape[2], 0, matrix.shape[2]
    if n % S == 0:  # check whether each segment depends on its own actuators alone
        own = np.stack([part[:, k * n // S : (k + 1) * n // S] for k, part in enumerate(matrix)])
        if np.count_nonzero(own) == np.count_nonzero(matrix):
            matrix, step, width = own, n // S, n // S
    return plan.node(ARCS, n, 3, [frame, zero, matrix], m, step, width)


def _elastic_tendons(plan: Plan, stored: Stored) -> int:
    lengths, radii, rest = (stored.array(name) for name in ("lengths", "radii", "rest_bends"))
    frame, share = _frame(plan, stored, lengths.sum())
    counts, m, S = stored.list_of(int, "actuators_per_segment"), len(share), len(radii)
    share = np.append(share, np.zeros(S - m))[:, None]
    base = stored.value("routing", str) == "base"
    coupled = base * (np.arange(S) > 0)[:, None]
    bending = stored.array("bending_stiffness")
    stiffness = np.stack([stored.array("axial_stiffness"), bending, bending], 1)
    arcs = share * np.column_stack([lengths, rest])
    segments = np.hstack([stiffness, coupled * stiffness, arcs, share, coupled * share])
    of, angles = np.repeat(np.arange(S), counts), stored.array("angles")
    x, y = -radii[of] * np.cos(angles), -radii[of] * np.sin(angles)
    bent = (np.cumsum(rest, 0) if base else rest)[of]  # zeros for bends measured from rest
    zeros = stored.array("tendon_zeros") + x * bent[:, 0] + y * bent[:, 1]
    tendons = np.stack([zeros, x, y, x * x, x * y, y * y, stored.array("gains")], 1)
    same = counts[0] if len({*counts}) == 1 else 0
    return plan.node(ELASTIC, len(x), 3, [frame, segments, tendons], m, S, same, *counts)


def _rigid(plan: Plan, stored: Stored) -> int:
    slides = [kind == "prismatic" for kind in stored.list_of(str, "kinds")]
    if not slides:
        raise NoKernel("an arm without moving joints is a constant")
    plan.limit("actuators", len(slides))
    before, numbers, motions = stored.array("base"), [], stored.derived["motions"]
    for origin, axis in zip(motions[:, 0] + motions[:, 2], stored.array("axes"), strict=True):
        side = np.cross(axis, np.eye(3)[np.abs(axis).argmin()])
        side = side / np.linalg.norm(side)
        turn = np.eye(4)  # turns the joint's axis to z
        turn[:3, :3] = np.stack([side, np.cross(axis, side), axis], 1)
        frame = before @ origin @ turn
        numbers += [frame[:3, :3], frame[:3, 3]]
        before = turn.T
    before = before @ stored.array("tip")
    tip = before @ np.append(stored.array("tool"), 1.0)
    couplings = stored.arrays.get("couplings", np.zeros((0, len(slides))))
    n, coupled = couplings.shape[1], len(couplings) > 0
    more = len(slides), coupled, *slides
    return plan.node(RIGID, n, 3, [*numbers, tip[:3], before[:3, :3], couplings], *more)


def _units(
    plan: Plan,
    kind: tuple[int, str],
    center: NDArray,
    scale: NDArray,
    readout: tuple[NDArray, NDArray, NDArray],
    hidden: tuple[NDArray, NDArray],
    lever: Sequence[NDArray] = (),
) -> int:
    """Write x = c + D u + V sigma(W u + b) with readout (c, D, V) and hidden layer (W, b)."""
    (intercept, direct, output), (W, b) = readout, hidden
    H, (m, n) = len(b), direct.shape
    units = np.zeros((-(-H // GROUP) * GROUP, n + 1 + m))
    units[:H] = np.column_stack([W, b, output.T])
    groups = units.reshape(-1, GROUP, n + 1 + m).swapaxes(1, 2)
    n_features, full, numbers = 0, 0, []
    if lever:
        n_features = len(lever[1])
        full, numbers = _lever(plan, *lever)
    parts = [center, 1.0 / scale, intercept, direct, groups, *numbers]
    more = (H, ACTIVATIONS.index(kind[1]), n_features, full)
    return plan.node(kind[0], n, m, parts, *more)


def _lever(
    plan: Plan, offset: NDArray, center: NDArray, factor: NDArray
) -> tuple[int, list[NDArray]]:
    """Return whether a factor R (f, f) is full, and the numbers of |R' (phi - center)|^2 + offset.

    R is stored in blocks of columns; the first block starts with zeros as padding. An upper
    triangular R is stored down to its diagonal.
    """
    f = len(center)
    plan.limit("features", f)
    full = bool(np.tril(factor, -1).any())
    padded = np.pad(factor, ((0, 0), (-f % GROUP, 0)))
    ends = range(f, 0, -GROUP)[::-1]
    columns = np.split(padded, len(ends), axis=1)
    blocks = [part[: f if full else end] for part, end in zip(columns, ends, strict=True)]
    return int(full), [offset, center, np.zeros(-(1 + f) % GROUP), *blocks]


def _elm(plan: Plan, stored: Stored, leverage: bool = False) -> int:
    W, b, out = (stored.array(name) for name in ("input_weights", "input_bias", "output_weights"))
    direct = np.zeros((W.shape[1], out.shape[1]))
    if len(out) > len(b):
        direct = out[len(b) :]
    names = ("offset", "center", "factor") if leverage else ()
    lever = [stored.array(f"leverage_{name}") for name in names]
    readout = stored.array("intercept"), direct.T, out[: len(b)].T
    scaling = stored.array("input_center"), stored.array("input_scale")
    return _units(plan, (ELM, stored.value("activation", str)), *scaling, readout, (W, b), lever)


def _affine(plan: Plan, stored: Stored) -> int:
    coef, bias = stored.array("coef"), stored.array("bias")
    m, n = coef.shape
    none = np.zeros((m, 0)), (np.zeros((0, n)), np.zeros(0))
    return _units(plan, (AFFINE, "sin"), np.zeros(n), np.ones(n), (bias, coef, none[0]), none[1])


def _kernel(plan: Plan, stored: Stored) -> int:
    rows, weights, bias = stored.array("rows"), stored.array("weights"), stored.array("bias")
    direct = np.zeros((weights.shape[1], rows.shape[1]))
    hidden = rows, -0.5 * (rows * rows).sum(1)
    scaling = stored.array("center"), stored.array("scale")
    return _units(plan, (KERNEL, "gaussian"), *scaling, (bias, direct, weights.T), hidden)


def _polynomial(plan: Plan, stored: Stored) -> int:
    powers, readout = stored.array("powers").astype(int), stored.array("readout")
    slope, (P, n) = stored.derived["slope"], powers.shape
    degrees = int(powers.max()) + 1
    plan.limit("powers", n * degrees)
    factors = []
    for row in powers:
        places = [j * degrees + power for j, power in enumerate(row) if power]
        factors += [len(places), *places]
    scaling = [stored.array("center"), 1.0 / stored.array("scale")]
    numbers = [*scaling, np.column_stack([readout, slope])]
    return plan.node(POLYNOMIAL, n, readout.shape[1], numbers, P, degrees, *factors)


def _readout(plan: Plan, stored: Stored) -> int:
    features, weights = stored.part("features"), stored.array("weights")
    center, scale = features.array("center"), features.array("scale")
    n, m = len(center), len(weights)
    constant, linear, bent = np.split(weights, [1, 1 + n], axis=1)
    kind = features.kind.removesuffix("_features")
    if kind in ("linear", "hidden"):
        hidden, activation = (np.zeros((0, n)), np.zeros(0)), "sin"
        if kind == "hidden":
            hidden = features.array("input_weights"), features.array("input_bias")
            activation = features.value("activation", str)
        return _units(plan, (ELM, activation), center, scale, (constant, linear, bent), hidden)
    if kind == "quadratic":
        i, j = np.triu_indices(n, 1)
        crossed, squared = np.split(bent, [len(i)], axis=1)
        hessian = np.zeros((m, n, n))
        hessian[:, i, j] = hessian[:, j, i] = crossed
        hessian[:, range(n), range(n)] = 3.0 * squared
        constant = constant - 0.5 * squared.sum(1, keepdims=True)
        rows = np.column_stack([constant, linear, hessian.reshape(m, -1)])
        return plan.node(READOUT, n, m, [center, 1.0 / scale, rows], QUADRATIC)
    if kind == "pose":
        chain = whole_chain(plan, features.part("chain"))
        return plan.node(READOUT, n, m, [center, 1.0 / scale, constant, linear, bent], POSE, chain)
    raise NoKernel(f"a readout of {features.kind!r} has no kernel")


def _quadratic_leverage(plan: Plan, stored: Stored) -> int:
    center, half_width = stored.array("center"), stored.array("half_width")
    # |L^-1 phi|^2 in the form of a network's leverage: R = L^-T is upper triangular.
    factor = solve_triangular(stored.array("factor"), np.eye(2 * len(center) + 1), lower=True).T
    lever = _lever(plan, np.zeros(1), np.zeros(len(factor)), np.triu(factor))[1]
    return plan.node(QUADRATIC_LEVERAGE, len(center), 0, [center, 1.0 / half_width, *lever])


def _leverage_guard(plan: Plan, stored: Stored) -> int:
    model = stored.part("model")
    place = _elm(plan, model, leverage=True) if model.kind == "elm" else plan.node_of(model)
    numbers = [stored.array("largest"), stored.array("limit")]
    return plan.node(LEVERAGE_GUARD, plan.entry(place, 1), 0, numbers, place)


def _box_guard(plan: Plan, stored: Stored) -> int:
    low, high = stored.array("low"), stored.array("high")
    width = np.where(high > low, high - low, 1.0)
    return plan.node(BOX_GUARD, len(low), 0, [stored.array("largest"), low, high, 1.0 / width])


def _group_distance(plan: Plan, stored: Stored) -> int:
    rows, axes = stored.array("rows"), stored.array("axes") / stored.array("farthest")
    center = rows.mean(0)
    placed = np.pad((rows - center) @ axes, ((0, -len(rows) % GROUP), (0, 0)), mode="edge")
    groups = placed.reshape(-1, GROUP, axes.shape[1]).swapaxes(1, 2)
    return plan.node(GROUP_DISTANCE, len(center), 0, [center, axes.T, groups], *groups.shape[:2])


def _content(stored: Stored) -> tuple:
    """Return a tuple that is equal for equal descriptions without parts."""
    return stored.kind, stored.settings, {k: a.tobytes() for k, a in stored.arrays.items()}


def _hybrid(plan: Plan, stored: Stored) -> int:
    base = drift = tested = -1
    if "mechanical" in stored.parts:
        base = plan.node_of(stored.part("mechanical"))
        if plan.entry(base, 0) not in (ARCS, ELASTIC, RIGID):
            raise NoKernel(f"the mechanical part {stored.part('mechanical').kind!r} is not a chain")
    if "drift" in stored.parts:
        drift = plan.node_of(stored.part("drift"))
    if "tested" in stored.parts:
        tested = plan.node_of(stored.part("tested"))
    places, inner = [], []
    for part in stored.part("corrections").parts.values():
        inner.append(part.kind == "inner_correction")
        regressor, guard = part.part("readout" if inner[-1] else "module"), part.parts.get("guard")
        trust = -1 if guard is None else plan.node_of(guard)
        own = [] if guard is None else [*map(_content, guard.parts.values())]
        if own == [_content(regressor)]:
            places += [0, plan.entry(trust, 4), trust]  # value and leverage share the features
        else:
            places += [inner[-1], plan.node_of(regressor), trust]
    weights = stored.array("weights")
    share = 1.0 - weights[inner].sum()
    numbers = [weights, np.array([share * (share > ROUNDING), any(inner)])]
    sized = base if base >= 0 else int(places[1])
    n, m = plan.entry(sized, 1), plan.entry(sized, 2)
    return plan.node(HYBRID, n, m, numbers, base, drift, tested, len(inner), *places)


def _adapted(plan: Plan, stored: Stored) -> int:
    fitted, motion = plan.node_of(stored.part("fitted")), stored.array("motion", (4, 4))
    n, m = plan.entry(fitted, 1), plan.entry(fitted, 2)
    numbers = [stored.array("shift", (n,)), motion[:3, :3], motion[:3, 3]]
    return plan.node(ADAPTED, n, m, numbers, fitted)


def _projected(plan: Plan, stored: Stored) -> int:
    model = plan.node_of(stored.part("model"))
    n, m = plan.entry(model, 1), plan.entry(model, 2)
    return plan.node(PROJECTED, n, m, [stored.array("matrix").T, stored.array("offset")], model)


def _inverse_kinematics(plan: Plan, stored: Stored) -> int:
    model = plan.node_of(stored.part("model"))
    n, m = plan._code[model + 1 : model + 3]
    if m != 3:
        raise NoKernel(f"the kernel of a step needs tips of 3 coordinates, got {m}")
    radian = stored.settings["radian"]
    if radian and plan.entry(model, 0) != RIGID:
        raise NoKernel("the kernels for poses support rigid arms only")
    names = ("q_min", "q_max", "dq_max", "ddq_max", "posture")
    vectors = [stored.array(name, [n], finite=False) for name in names]
    gain, beta, dt, damping = (stored.settings[name] for name in ("gain", "beta", "dt", "damping"))
    beta = 1.0 if beta is None else beta  # steps of more than a second end at the posture
    rates = [-1.0 if gain is None else gain, beta, dt, -1.0 if damping == "adaptive" else damping]
    weights = stored.array("weights", [n])
    flags = (stored.settings["limits"] == "saturate") + 2 * stored.settings["has_posture"]
    flags += 4 * bool((weights != 1.0).any()) + 8 * stored.settings["accelerates"]
    periods, pulls = stored.array("periods", [n], finite=False), stored.array("pulls", [n])
    flags += 16 * bool(pulls.any())
    normals = stored.array("normals").T
    if len(normals) > MAX_NORMALS:
        raise NoKernel(
            f"the log leaves {len(normals)} directions of q out, more than {MAX_NORMALS}"
        )
    rates = np.array([*rates, radian])
    numbers = [*vectors, weights**-0.5, rates, periods, pulls, normals]
    return plan.node(IK, n, 6 if radian else 3, numbers, model, flags, len(normals))


WRITERS: dict[str, Callable[[Plan, Stored], int]] = {
    "constant_curvature": _constant_curvature,
    "elastic_tendons": _elastic_tendons,
    "rigid": _rigid,
    "elm": _elm,
    "affine": _affine,
    "kernel": _kernel,
    "polynomial": _polynomial,
    "readout": _readout,
    "quadratic_leverage": _quadratic_leverage,
    "leverage_guard": _leverage_guard,
    "box_guard": _box_guard,
    "group_distance": _group_distance,
    "hybrid_module": _hybrid,
    "adapted_model": _adapted,
    "projected": _projected,
    "inverse_kinematics": _inverse_kinematics,
}
