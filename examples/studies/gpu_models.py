"""A small model of every kind, for `gpu.py`, without packages that read robot files or plot."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from sklearn.kernel_ridge import KernelRidge
from sklearn.linear_model import LinearRegression
from sklearn.tree import DecisionTreeRegressor
from torch import Tensor

from hybridkin import (
    Commands,
    ConstantCurvatureChain,
    ElasticTendonChain,
    ELMRegressor,
    ELMRegressorCV,
    ForceTendonChain,
    ForwardModel,
    HybridForwardModel,
    Hysteresis,
    RigidChain,
    as_forward_model,
    tasks,
)
from hybridkin.hybrid._module import HybridModule

N_ROWS = 40  # of the logs that learned models are fitted to
RADII = [0.100, 0.093, 0.079]
LOW, HIGH = 0.15, 0.35  # chambers of the trunk [m]
AXES = [[0, 0, 1], [0, 1, 0]] * 3 + [[0, 0, 1]]  # of an arm with seven joints
LINKS = [0.0, 0.2, 0.15, 0.2, 0.15, 0.2, 0.05]  # along z [m]


class Kind(NamedTuple):
    """A model, and what it is compared at."""

    model: Any  # a module, or a fitted estimator
    low: NDArray  # (n,) limits of q
    high: NDArray
    task: Callable[[ForwardModel], Any] = as_forward_model
    is_saved: bool = True  # a model that only pickle could store is refused

    @property
    def module(self) -> ForwardModel:
        """The torch module of the model."""
        return as_forward_model(self.model)

    def rows(self, n: int, seed: int = 0, part: float = 1.0) -> Tensor:
        """Return random q (n, n_actuators) inside `part` of the limits, float64."""
        middle, half = 0.5 * (self.low + self.high), 0.5 * (self.high - self.low)
        ways = np.random.default_rng(seed).uniform(-part, part, (n, len(half)))
        return torch.from_numpy(middle + half * ways)


def limits(n: int, low: float, high: float) -> tuple[NDArray, NDArray]:
    """Return equal limits of n actuators."""
    return np.full(n, low), np.full(n, high)


# Mechanical models.


def trunk() -> ConstantCurvatureChain:
    """Return three extensible segments of three chambers."""
    return ConstantCurvatureChain(RADII)


def tendons(**options: Any) -> ConstantCurvatureChain:
    """Return two segments of fixed lengths with seven tendons from the base."""
    return ConstantCurvatureChain(
        [0.005, 0.004],
        n_actuators=[3, 4],
        lengths=[0.06, 0.05],
        routing="base",
        offsets=[0.0, 0.01],
        base=np.diag([1.0, -1.0, -1.0, 1.0]),
        **options,
    )


def staged(stage: str | None) -> ConstantCurvatureChain:
    """Return a feed, or a rotation, of a segment with three tendons."""
    options: dict[str, Any] = {} if stage is None else {"stage": stage}
    return ConstantCurvatureChain(
        [0.05] * 2, n_actuators=[1, 3], lengths=[None, 0.1], routing="base", **options
    )


def elastic(**options: Any) -> ElasticTendonChain:
    """Return two elastic segments whose tendons can only pull."""
    return ElasticTendonChain(
        [0.005, 0.004],
        [0.06, 0.05],
        n_actuators=[3, 4],
        routing="segment",
        bending_stiffness=[2e-7, 3e-7],
        axial_stiffness=[3.0, 4.0],
        tendon_zeros=1e-4 * np.arange(7),
        rest_bends=[[0.1, 0.2], [0.0, -0.3]],
        offsets=[0.0, 0.01],
        **options,
    )


def forced() -> ForceTendonChain:
    """Return a tapered body with weight, whose tendons are commanded by force."""
    return ForceTendonChain([0.01], [0.3], 0.02, 50.0, weight=0.1, taper=0.3)


def arm() -> RigidChain:
    """Return an arm with seven joints."""
    origins = np.stack([np.eye(4)] * 7)
    origins[:, 2, 3] = LINKS
    return RigidChain(origins, AXES, tool=[0.0, 0.0, 0.1])


def arm_urdf() -> str:
    """Return the arm as URDF, from the link "base" to the link "tip"."""
    names = ["base", *(f"link_{k}" for k in range(1, 8)), "tip"]
    lines = [f'<link name="{name}"/>' for name in names]
    for k, (axis, z) in enumerate(zip([*AXES, None], [*LINKS, 0.1], strict=True)):
        kind, moves = "fixed", ""
        if axis is not None:
            kind = "revolute"
            numbers = " ".join(map(str, axis))
            limit = '<limit lower="-3" upper="3" effort="1" velocity="1"/>'
            moves = f'<axis xyz="{numbers}"/>{limit}'
        ends = f'<parent link="{names[k]}"/><child link="{names[k + 1]}"/>'
        place = f'<origin xyz="0 0 {z}" rpy="0 0 0"/>'
        lines.append(f'<joint name="joint_{k}" type="{kind}">{ends}{place}{moves}</joint>')
    return f'<robot name="arm">{"".join(lines)}</robot>'


# Learned models, of a segment with three chambers that is not quite circular.


def segment() -> ConstantCurvatureChain:
    """Return one segment of three chambers."""
    return ConstantCurvatureChain([0.05], offsets=[0.03])


def log(n: int = N_ROWS) -> tuple[NDArray, NDArray, NDArray]:
    """Return rows of q [m], tips x [m] and motions."""
    q = 0.25 + 0.05 * np.random.default_rng(0).uniform(-1, 1, (n, 3))
    bent = ConstantCurvatureChain([0.06], offsets=[0.03])(torch.from_numpy(q)).numpy()
    return q, bent + 0.01 * np.sin(20 * q), np.arange(n) // 4


def network(**options: Any) -> ELMRegressor:
    """Return a small network."""
    return ELMRegressor(12, random_state=0, **options)


def hybrid(error_model: Any, chain: Any = None, **settings: Any) -> Any:
    """Return a hybrid of the segment, fitted to the log."""
    q, x, groups = log()
    if settings.get("output") == "pose":
        x = np.hstack([x, 5 * (q - 0.25)])
    model = HybridForwardModel(chain or segment(), error_model, random_state=0, **settings)
    commands = Commands(q, groups, np.arange(len(q)) * 0.1)
    return model.fit(commands, x, groups=groups)


def on_chain(chain: Any, low: NDArray, high: NDArray, error_model: Any) -> Any:
    """Return a hybrid of another chain, fitted to simulated rows."""
    q = np.random.default_rng(0).uniform(low, high, (60, len(low)))
    x = chain(torch.from_numpy(q)).numpy()
    turns = np.sin(3.0 * (q - low) / (high - low))[:, :3]
    x = x + 0.02 * np.tile(turns, x.shape[1] // 3) * np.ptp(x, axis=0)
    return HybridForwardModel(chain, error_model, random_state=0).fit(q, x)


def blend() -> ForwardModel:
    """Return the module of a blend of two corrections and the mechanical model."""
    corrections = []
    for error_model in ("linear", "quadratic"):
        corrections += hybrid(error_model).module_.corrections
    weights = torch.tensor([0.5, 0.3], dtype=torch.float64)
    return HybridModule(segment(), corrections, weights)


def drifting() -> Any:
    """Return a hybrid with a radius and a correction of its drift."""
    q, x, _ = log()
    return hybrid(network(), coverage=0.8).partial_fit(q[:5], x[:5] + 0.01)


def adapted(**settings: Any) -> Any:
    """Return a hybrid whose base has moved and whose zeros have shifted."""
    q = log()[0]
    model = hybrid(network(), **settings)
    base = np.array([[0.8, -0.6, 0.0], [0.6, 0.8, 0.0], [0.0, 0.0, 1.0]])
    x = model.predict(q)
    turned = np.hstack([x[:, :3] @ base.T + [0.02, 0.0, 0.05], x[:, 3:]])
    return model.adapt(q - [0.01, -0.02, 0.005], turned)


def pose_of_rows(module: ForwardModel) -> Any:
    """Return the task of a pose."""
    return tasks.PoseTask(module)


_PULLED = -0.002 * np.ones(7), 0.002 * np.ones(7)
_FORCES = limits(3, 0.0, 1.5)
_TURNS = limits(7, -1.5, 1.5)
_STAGE = np.array([0.08, -0.01, -0.01, -0.01]), np.array([0.12, 0.01, 0.01, 0.01])
_CHAMBERS = limits(3, 0.2, 0.3)
_BACKLASH = Hysteresis.backlash(0.02)
_SMOOTH = Hysteresis.friction([0.0, 0.01, 0.02], [[0.2, 0.3, 0.4], [0.7, 0.8, 1.1]])
_CREEP = Hysteresis.creep([[0.1, 0.2, 0.3], [0.2, 0.1, 0.0]], [2.0, 30.0])

CHAINS: dict[str, Callable[[], Kind]] = {
    "extensible segments": lambda: Kind(trunk(), *limits(9, LOW, HIGH)),
    "extensible, towards poses": lambda: Kind(trunk(), *limits(9, LOW, HIGH), pose_of_rows),
    "tendons of fixed length, all parts": lambda: Kind(
        tendons(rest_bends=[[0.1, 0.2], [0.0, -0.3]], actuator_zeros=1e-4 * np.arange(7)),
        *_PULLED,
    ),
    "tendons with gains": lambda: Kind(tendons(gains=[1.0, -2.0]), *(0.4 * end for end in _PULLED)),
    "two opposite chambers": lambda: Kind(
        ConstantCurvatureChain([0.05], n_actuators=2, angles=[0.0, np.pi]),
        *limits(2, 0.2, 0.3),
    ),
    "feed stage": lambda: Kind(staged(None), *_STAGE),
    "rotating stage": lambda: Kind(
        staged("rotation"),
        np.array([-1.0, *_STAGE[0][1:]]),
        np.array([1.0, *_STAGE[1][1:]]),
    ),
    "point on the backbone": lambda: Kind(tendons().with_tip(1.5), *_PULLED),
    "markers": lambda: Kind(
        tendons().with_markers([(0, 0.5, (0.01, 0.0, 0.0)), (1, 1.0)]), *_PULLED
    ),
    "elastic tendons": lambda: Kind(elastic(), *_PULLED),
    "elastic, 15 tendons": lambda: Kind(
        ElasticTendonChain([0.005] * 5, [0.05] * 5), *limits(15, -0.002, 0.002)
    ),
    "tendons by force": lambda: Kind(forced(), *_FORCES),
    "rigid arm": lambda: Kind(arm(), *_TURNS),
    "rigid arm, towards poses": lambda: Kind(arm(), *_TURNS, pose_of_rows),
}
"""Mechanical models by kind."""

LEARNED: dict[str, Callable[[], Kind]] = {
    "network": lambda: Kind(network(alpha=1e-3).fit(*log()[:2]), *_CHAMBERS),
    "network, direct link, a penalty per output": lambda: Kind(
        network(direct_link=True, activation="tanh", fit_intercept=True)
        .set_params(alpha=[0.1, 1.0, 10.0])
        .fit(*log()[:2]),
        *_CHAMBERS,
    ),
    "network, sine": lambda: Kind(network(activation="sin").fit(*log()[:2]), *_CHAMBERS),
    "network by cross-validation": lambda: Kind(
        ELMRegressorCV(8, cv=3, max_hidden=8, random_state=0).fit(*log()[:2]),
        *_CHAMBERS,
    ),
    "calibrated": lambda: Kind(hybrid("drop", calibrate=("radii",)), *_CHAMBERS),
    "hybrid, network": lambda: Kind(hybrid(network()), *_CHAMBERS),
    "hybrid, radius and drift": lambda: Kind(drifting(), *_CHAMBERS),
    "hybrid, linear": lambda: Kind(hybrid("linear"), *_CHAMBERS),
    "hybrid, quadratic": lambda: Kind(hybrid("quadratic"), *_CHAMBERS),
    "hybrid, kernel ridge": lambda: Kind(
        hybrid(KernelRidge(kernel="rbf", gamma=100.0).set_params(alpha=0.01)),
        *_CHAMBERS,
    ),
    "hybrid, regression": lambda: Kind(hybrid(LinearRegression()), *_CHAMBERS),
    "hybrid, no guard": lambda: Kind(hybrid(network(), guard=None), *_CHAMBERS),
    "hybrid, tree by differences": lambda: Kind(
        hybrid(DecisionTreeRegressor(max_depth=3, random_state=0)),
        *_CHAMBERS,
        is_saved=False,
    ),
    "serial, linear": lambda: Kind(hybrid("linear", coupling="serial"), *_CHAMBERS),
    "serial, quadratic": lambda: Kind(hybrid("quadratic", coupling="serial"), *_CHAMBERS),
    "serial, pose": lambda: Kind(hybrid("pose", coupling="serial"), *_CHAMBERS),
    "serial, network": lambda: Kind(hybrid(network(), coupling="serial"), *_CHAMBERS),
    "poses as outputs": lambda: Kind(hybrid(network(), output="pose"), *_CHAMBERS, pose_of_rows),
    "data alone": lambda: Kind(HybridForwardModel(None, network()).fit(*log()[:2]), *_CHAMBERS),
    "blend": lambda: Kind(blend(), *_CHAMBERS, is_saved=False),
    "backlash": lambda: Kind(hybrid("linear", hysteresis=_BACKLASH), *_CHAMBERS),
    "smooth hysteresis": lambda: Kind(hybrid("linear", hysteresis=_SMOOTH), *_CHAMBERS),
    "backlash and creep": lambda: Kind(hybrid("linear", hysteresis=_BACKLASH | _CREEP), *_CHAMBERS),
    "adapted": lambda: Kind(adapted(), *_CHAMBERS),
    "adapted poses": lambda: Kind(adapted(output="pose"), *_CHAMBERS, pose_of_rows),
    "hybrid of markers": lambda: Kind(
        on_chain(tendons().with_markers([(0, 1.0), (1, 1.0)]), *_PULLED, LinearRegression()),
        *_PULLED,
    ),
    "hybrid of elastic tendons": lambda: Kind(
        on_chain(elastic(), *_PULLED, LinearRegression()), *_PULLED
    ),
    "hybrid of tendons by force": lambda: Kind(on_chain(forced(), *_FORCES, network()), *_FORCES),
    "hybrid of a rigid arm": lambda: Kind(on_chain(arm(), *_TURNS, network()), *_TURNS),
}
"""Learned and hybrid models by kind."""

KINDS = CHAINS | LEARNED
