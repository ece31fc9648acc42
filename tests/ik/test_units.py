import warnings

import numpy as np
import pytest

from hybridkin import (
    ConstantCurvatureChain,
    ElasticTendonChain,
    HybridForwardModel,
    InverseKinematics,
    RigidChain,
)
from hybridkin.ik.tasks import PoseTask

TRUNK = ConstantCurvatureChain([0.100, 0.093, 0.079])
TENDONS = ConstantCurvatureChain([0.02] * 2, lengths=[0.1] * 2)
ELASTIC = ElasticTendonChain([0.005], [0.2])
ORIGINS = np.tile(np.eye(4), (2, 1, 1))
ORIGINS[1, 2, 3] = 0.3
ARM = RigidChain(ORIGINS, [[0.0, 0.0, 1.0]] * 2, kinds=["revolute", "prismatic"])
# Motors [rad] of a joint with a gear of 50 turns to one, and of a thread of 2 mm per radian.
GEARED = RigidChain(
    ORIGINS,
    [[0.0, 0.0, 1.0]] * 2,
    kinds=["revolute", "prismatic"],
    couplings=[[-0.02, 0.0], [0.0, 0.002]],
)


def messages_of(model, **settings):
    with warnings.catch_warnings(record=True) as seen:
        warnings.simplefilter("always")
        there = compile("make(model, **settings)", "the caller", "eval")
        eval(there, {"make": InverseKinematics, "model": model, "settings": settings})
    assert all(warning.filename == "the caller" for warning in seen)
    return [str(warning.message) for warning in seen]


IN_OTHER_UNITS = [
    (TRUNK, {"q_min": 100.0, "q_max": 400.0}, ["q_min", "q_max"]),
    (TRUNK, {"q_min": 0.1, "q_max": 0.4, "q_pref": 250.0}, ["q_pref"]),
    (TENDONS, {"q_min": -20.0, "q_max": 20.0, "dq_max": 30.0}, ["q_min", "q_max", "dq_max"]),
    (PoseTask(TENDONS), {"q_min": -20.0}, ["q_min"]),
    (ARM, {"q_max": [180.0, 0.2]}, ["q_max"]),
    (GEARED, {"q_max": [180.0 * 50.0, 0.2 * 500.0]}, ["q_max"]),
    (GEARED, {"q_max": [1.0 * 50.0, 200.0 * 500.0], "dq_max": 1e9}, ["q_max", "dq_max", "dq_max"]),
]
IN_METRES = [
    (TRUNK, {"q_min": 0.1, "q_max": np.inf, "dq_max": np.inf}),
    (TRUNK, {"q_min": 0.0, "q_max": 9.0, "dq_max": 10.0}),  # hardly a limit
    (ELASTIC, {"q_min": -0.5, "q_max": 0.5}),
    (ARM, {"q_min": [-6.3, 0.0], "q_max": [6.3, 0.2], "dq_max": [30.0, 1.0]}),
    (GEARED, {"q_min": [-300.0, 0.0], "q_max": [300.0, 100.0], "dq_max": [1500.0, 500.0]}),
    (lambda q: q, {"q_min": -400.0, "q_max": 400.0}),  # whose unit is not known
    (TRUNK, {"q_min": 0.1, "q_max": 0.4, "weights": 1e6, "q_pref": lambda q: q}),
]


@pytest.mark.parametrize(
    ("model", "settings", "named"), [*IN_OTHER_UNITS, *((*case, []) for case in IN_METRES)]
)
def test_limits_in_millimetres_or_degrees_are_noticed(model, settings, named):
    messages = messages_of(model, **settings)
    assert [message.split("`")[1] for message in messages] == named


@pytest.mark.slow
def test_targets_in_millimetres_are_noticed():
    ik = InverseKinematics(TENDONS, q_min=-0.02, q_max=0.02)
    with pytest.warns(UserWarning, match=r"`x_target` spans 180 m, but the robot is only 0\.2 m"):
        solution = ik.solve([[20.0, 10.0, 180.0], [np.nan, 0.0, 0.0]], max_iter=5, restarts=0)
    assert not solution.converged.any()
    with pytest.warns(UserWarning, match="`path` spans"):
        ik.track(np.full((2, 3), 100.0), q0=np.zeros(6))
    pose = np.eye(4)
    pose[2, 3] = 190.0
    hybrid = HybridForwardModel(TENDONS, error_model="drop").fit(np.zeros((9, 6)), np.zeros((9, 3)))
    for model, target in ((PoseTask(TENDONS), pose), (hybrid, pose[:3, 3])):
        with pytest.warns(UserWarning, match=r"`x_target` spans.*metres"):
            InverseKinematics(model, q_pref=0.0).solve(target, max_iter=5, restarts=0)
    # Neither 2 m off, nor a base far from the origin.
    ik.solve([0.0, 1.0, 2.0], restarts=0)
    base = np.eye(4)
    base[:3, 3] = [30.0, -20.0, 5.0]
    far = ConstantCurvatureChain([0.02] * 2, lengths=[0.1] * 2, base=base)
    assert InverseKinematics(far, q_pref=0.0).solve([30.0, -20.0, 5.19]).converged
