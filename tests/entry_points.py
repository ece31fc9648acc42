"""Robots, logs and files to call functions with, and hostile values in their place."""

import tempfile
from pathlib import Path

import numpy as np
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from saved_models import trunk, trunk_log
from strategies import LAYOUTS, SPECIAL, answer

from hybridkin import (
    ELMRegressor,
    HybridForwardModel,
    InverseKinematics,
    datasets,
    open_model,
    plots,
    robots,
    save_model,
    trajectories,
)
from hybridkin.app import workflow

FOLDER = Path(tempfile.mkdtemp(prefix="hybridkin-"))
Q, X, GROUPS = trunk_log(24)
FITTED = HybridForwardModel(trunk(), ELMRegressor(4, random_state=0)).fit(Q, X)
PATH = trajectories.line([0.1, 0.0, 0.2], [0.0, 0.1, 0.2], duration=0.2, dt=0.1)
DISPLAYED = plots.BackboneDisplay.from_estimator(trunk(), Q[:2])
TRACK = InverseKinematics(trunk(), q_min=0.1, q_max=0.4, dt=0.1).track(
    PATH.x, PATH.t, q0=np.full(3, 0.25)
)
SAVED = FOLDER / "model.safetensors"
save_model(FITTED, SAVED)
LOADED = open_model(SAVED)
LIMITS = workflow.path_limits(LOADED, q_min=0.1, q_max=0.4)
LOG = datasets.Log(Q, X, GROUPS, np.arange(24.0))
CSV, POINTS, ROBOT = FOLDER / "log.csv", FOLDER / "path.csv", FOLDER / "robot.toml"
NAMES = {"q": ["a", "b", "c"], "x": ["x", "y", "z"]}
np.savetxt(CSV, np.column_stack([Q, X, GROUPS]), "%.6f", ",", header="a,b,c,x,y,z,g", comments="")
np.savetxt(POINTS, np.column_stack([PATH.t, PATH.x]), "%.6f", ",")
ROBOT.write_text(
    '[[segment]]\nradius = 0.05\n[log]\nq = ["a", "b", "c"]\nx = ["x", "y", "z"]\ngroups = "g"\n'
)
DESCRIPTION = robots.read_description(ROBOT)
FORMAT = DESCRIPTION.log


def variants(array):
    """Return other shapes and kinds of an array."""
    shapes = [array[..., None], array[None], np.float64(0.5), np.empty(0), array.astype(np.float32)]
    if array.ndim:
        shapes += [array[:0], array[:1], array[:-1], array[..., :-1], array.ravel(), array.T]
        shapes += [array[..., :0], np.repeat(array, 2, 0), 0.0 * array, array.tolist()]
    return [*shapes, 1e30 * array, -array, torch.tensor(array), torch.tensor(array, device="meta")]


WRONG = [None, "a", "", [], {}, (), True, object, 1j, b"a", np.nan, np.float32(0.5), [None], "\0"]
NUMBERS = [np.nan, np.inf, -np.inf, 0, -0.0, 1, -1, 2.5, 5e-324, 1e-300, 1e300, 2**63, True]
# Made by this package: what else stands in their place raises as Python does.
OBJECTS = (torch.nn.Module, HybridForwardModel, datasets.Log, robots.LogFormat)
OBJECTS += (
    robots.RobotDescription,
    workflow.PathLimits,
    trajectories.Trajectory,
    type(TRACK),
)


@st.composite
def hostile(draw, good):
    """Something in the place of an argument that is right."""
    if draw(st.integers(0, 9)) == 9 and not isinstance(good, OBJECTS):
        return draw(st.sampled_from(WRONG))
    if isinstance(good, (np.ndarray, torch.Tensor)):
        array = good.numpy() if isinstance(good, torch.Tensor) else good
        if draw(st.booleans()):
            found = draw(st.sampled_from(variants(array)))
        else:
            found = array.astype(float)
            for value in draw(st.lists(st.sampled_from(SPECIAL), min_size=1, max_size=3)):
                found.flat[draw(st.integers(0, found.size - 1))] = value
            found = LAYOUTS[draw(st.sampled_from([*LAYOUTS]))](found)
        if isinstance(good, torch.Tensor) and isinstance(found, np.ndarray):
            return torch.tensor(found.copy())
        return found
    if isinstance(good, dict):
        key = draw(st.sampled_from([*good]))
        return {**good, key: draw(hostile(good[key]))}
    if isinstance(good, (list, tuple)):
        parts = [*good, *good] if draw(st.booleans()) else [*good]
        if parts:
            k = draw(st.integers(0, len(parts) - 1))
            parts[k] = draw(hostile(parts[k]))
        return parts if draw(st.booleans()) else tuple(parts[:-1])
    if isinstance(good, (bool, int, float)):
        return draw(st.sampled_from(NUMBERS))
    if isinstance(good, OBJECTS):
        return good
    return draw(st.sampled_from([*WRONG, *NUMBERS, Q, X, X[:, 0], torch.tensor(Q), FOLDER, CSV]))


def fuzz(function, right, share=1):
    """Call with one or two hostile arguments; `share`: one in how many examples is tried."""
    _, error = answer(function, **right)
    assert error is None, "where the right arguments are refused, each other one is"
    tried = []

    @settings(max_examples=max(2, settings.default.max_examples // share))
    @given(st.data())
    def check(data):
        given = dict(right)
        names = st.lists(st.sampled_from([*right]), min_size=1, max_size=2, unique=True)
        for name in data.draw(names):
            given[name] = data.draw(hostile(right[name]))
        tried.append(None)
        answer(function, **given)

    check()
    print(f"generate phase: {len(tried)} passing")  # noqa: T201, counted by the examination
