"""One small model of every kind that can be saved, and the files stored of them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
from sklearn.kernel_ridge import KernelRidge
from sklearn.linear_model import LinearRegression

from hybridkin import (
    Commands,
    ConstantCurvatureChain,
    ElasticTendonChain,
    ELMRegressor,
    ELMRegressorCV,
    HybridForwardModel,
    Hysteresis,
    RigidChain,
    save_model,
)
from hybridkin.chains.structural import StructuralChain

FOLDER = Path(__file__).parent / "models"
FRICTION = Hysteresis.friction([0.0, 0.01, 0.02], [[0.2, 0.3, 0.4], [0.7, 0.8, 1.1]])
CREEP = Hysteresis.backlash(0.02) | Hysteresis.creep(
    [[0.1, 0.2, 0.3], [0.2, 0.1, 0.0]], [2.0, 30.0]
)


def tendon_chain(**options):
    return ConstantCurvatureChain(
        [0.005, 0.004],
        n_actuators=[3, 4],
        lengths=[0.06, 0.05],
        routing="base",
        offsets=[0.0, 0.01],
        base=np.diag([1.0, -1.0, -1.0, 1.0]),
        **options,
    )


def bent_chain(**options):
    """A chain that uses all that a chain can hold."""
    zeros = 1e-4 * np.arange(7)
    return tendon_chain(rest_bends=[[0.1, 0.2], [0.0, -0.3]], actuator_zeros=zeros, **options)


def elastic_chain(**options):
    """An elastic chain that uses all that it can hold."""
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
        base=np.diag([1.0, -1.0, -1.0, 1.0]),
        **options,
    )


def structural_chain(chain, size=0.03):
    """A chain of arcs with errors of its structure, all of them, and a motion of its base."""
    rng = np.random.default_rng(0)
    lengths = np.linspace(0.06, 0.05, chain.n_segments)
    shapes = (3,), (3, 3), (3,), (3,)
    errors = [size * rng.normal(size=(chain.n_segments, *shape)) for shape in shapes]
    motion = np.eye(4)
    motion[:2] = [[0.8, -0.6, 0.0, 0.01], [0.6, 0.8, 0.0, -0.02]]
    return StructuralChain(chain, *map(torch.from_numpy, [lengths, *errors, motion]))


def arm(**options):
    origins = np.stack([np.eye(4)] * 3)
    origins[1:, 0, 3] = 0.3, 0.2
    options = {
        "kinds": ["revolute", "prismatic", "revolute"],
        "names": ["turn", "slide", "wrist"],
        "q_min": [-2.0, 0.0, -np.inf],
        "q_max": [2.5, 0.4, np.inf],
        "tip": np.diag([-1.0, -1.0, 1.0, 1.0]),
        "tool": [0.1, 0.0, 0.02],
        "base": np.diag([1.0, -1.0, -1.0, 1.0]),
        **options,
    }
    return RigidChain(origins, [[0, 0, 1], [1, 0, 2], [0, 1, 0]], **options)


def trunk(**options):
    """One segment of three chambers, so that files stay small."""
    return ConstantCurvatureChain([0.05], offsets=[0.03], **options)


def trunk_log(n_rows=24):
    """Rows of q [m], tips x [m] of a simulated trunk that is not quite circular, and motions."""
    rng = np.random.default_rng(0)
    q = 0.25 + 0.05 * rng.uniform(-1, 1, (n_rows, 3))
    bent = ConstantCurvatureChain([0.06], offsets=[0.03])(torch.from_numpy(q)).numpy()
    return q, bent + 0.01 * np.sin(20 * q), np.arange(n_rows) // 4


def _hybrid(error_model: Any = None, chain: Any = None, **settings: Any) -> Any:
    q, x, groups = trunk_log()
    if settings.get("output") == "pose":
        x = np.hstack([x, 5 * (q - 0.25)])
    chain = trunk() if chain is None else chain
    model = HybridForwardModel(chain, error_model, random_state=0, **settings)
    return model.fit(Commands(q, time=np.arange(len(q))), x, groups=groups), q


def _blend():
    """A blend of small models, without a network."""
    q, x, groups = trunk_log(20)
    model = HybridForwardModel(trunk(), "auto", calibrate=("radii",), random_state=0)
    return model.fit(q, x, groups=groups), q


def _rigid_hybrid():
    rng = np.random.default_rng(0)
    q = rng.uniform(-1, 1, (24, 3))
    x = arm()(torch.from_numpy(q)).numpy() + 0.01 * np.cos(q)
    return HybridForwardModel(arm(), ELMRegressor(4, random_state=0)).fit(q, x), q


def _elastic_hybrid():
    rng = np.random.default_rng(0)
    q = 0.003 * rng.uniform(-1, 1, (24, 7))
    x = elastic_chain()(torch.from_numpy(q)).numpy() + 0.001 * np.sin(300 * q[:, :3])
    return HybridForwardModel(elastic_chain(), LinearRegression()).fit(q, x), q


def _drifting():
    model, q = _hybrid(ELMRegressor(4, random_state=0), coverage=0.8)
    return model.partial_fit(q[:5], trunk_log()[1][:5] + 0.01), q


def _adapted(model, q):
    """A robot on another day: the base has moved, the zeros are others; and a payload."""
    base = np.array([[0.8, -0.6, 0.0], [0.6, 0.8, 0.0], [0.0, 0.0, 1.0]])
    x = model.predict(q)
    turned = np.hstack([x[:, :3] @ base.T + [0.02, 0.0, 0.05], x[:, 3:]])
    model.adapt(q - [0.01, -0.02, 0.005], turned)
    return model.partial_fit(q[:5], model.predict(q[:5]) + 0.01), q


def _network(network):
    q, x, groups = trunk_log(16)
    given = {"groups": groups} if isinstance(network, ELMRegressorCV) else {}
    return network.fit(q, x, **given), q


def models() -> dict[str, tuple[Any, Any]]:
    """Return by name a model of every kind, and inputs that it was made for (N, n)."""
    tendons = 0.003 * np.random.default_rng(1).uniform(-1, 1, (3, 7))
    small = ELMRegressor(4, random_state=0)
    apart = ELMRegressor(4, direct_link=True, random_state=0).set_params(alpha=[0.1, 1.0, 10.0])
    chosen = ELMRegressorCV(4, cv=3, relevance_rounds=1, max_hidden=4, random_state=0)
    kernel = KernelRidge(kernel="rbf", gamma=100.0).set_params(alpha=0.01)
    return {
        "chain": (tendon_chain(), tendons),
        "chain_of_all_parts": (bent_chain(dtype=torch.float32).with_tip(1.5), tendons),
        "elastic_chain": (elastic_chain(), tendons),
        "structural_chain": (structural_chain(bent_chain().with_tip(1.5)), tendons),
        "rigid": (arm(), np.linspace(-1.0, 1.0, 9).reshape(3, 3)),
        "elm": _network(apart),
        "elm_cv": _network(chosen),
        "mechanical": _hybrid("drop", calibrate=("radii",)),
        "parallel_elm": _hybrid(small, calibrate="default"),
        "parallel_kernel": _hybrid(kernel),
        "parallel_regression": _hybrid(LinearRegression()),
        "parallel_linear": _hybrid("linear"),
        "parallel_quadratic": _hybrid("quadratic"),
        "serial_quadratic": _hybrid("quadratic", coupling="serial"),
        "serial_pose": _hybrid("pose", coupling="serial"),
        "serial_elm": _hybrid(small, coupling="serial"),
        "pose_output": _hybrid(small, output="pose"),
        "data_only": (
            HybridForwardModel(None, small).fit(*trunk_log()[:2]),
            trunk_log()[0],
        ),
        "blend": _blend(),
        "play": _hybrid("linear", hysteresis=[0.01, 0.02, 0.0]),
        "smooth_hysteresis": _hybrid("linear", hysteresis=FRICTION),
        "creep": _hybrid("linear", hysteresis=CREEP),
        "tested_by_groups": _hybrid("linear", coupling="serial"),
        "drift_and_radius": _drifting(),
        "adapted": _adapted(*_hybrid("quadratic", coupling="serial")),
        "adapted_pose": _adapted(*_hybrid(small, output="pose")),
        "rigid_hybrid": _rigid_hybrid(),
        "elastic_hybrid": _elastic_hybrid(),
    }


def predictions(model: Any, q: Any) -> dict[str, Any]:
    """Return what a model predicts for rows q (N, n), by name."""
    if isinstance(model, torch.nn.Module):
        chain: Any = model
        x, J = (part.numpy() for part in chain.forward_and_jacobian(torch.from_numpy(q)))
        return {"x": x, "J": J}
    if isinstance(model, HybridForwardModel) and model.hysteresis_:
        q = Commands(q, time=np.arange(float(len(q))))
    x, J = model.predict_and_jacobian(q)
    said = {"x": x, "J": J}
    if isinstance(model, HybridForwardModel):
        said["in_domain"] = model.in_domain(q)
        if model.radius_ is not None:
            said["radius"] = model.predict(q, return_radius=True)[1]
    return said


def write_models(folder: Path, models: dict[str, tuple[Any, Any]]) -> None:
    """Write a file for every model that has none in a folder, and what it predicts.

    Call it once for a new kind of model. Files that exist stay as they are: they stand for the
    files that users have.
    """
    folder.mkdir(parents=True, exist_ok=True)
    said = dict(np.load(folder / "predictions.npz")) if any(folder.iterdir()) else {}
    for name, (model, q) in models.items():
        path = folder / f"{name}.safetensors"
        if not path.exists():
            save_model(model, path)
            rows = np.concatenate([q[:1], q[:1] + 4.0 * (q[:1] - q.mean(0))])
            said |= {f"{name}.q": rows}
            said |= {f"{name}.{key}": value for key, value in predictions(model, rows).items()}
    np.savez_compressed(folder / "predictions.npz", **said)
