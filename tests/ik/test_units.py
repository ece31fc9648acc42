import warnings

import numpy as np
import pytest
from sklearn.ensemble import RandomForestRegressor
from sklearn.exceptions import NotFittedError
from sklearn.linear_model import LinearRegression
from sklearn.model_selection import GridSearchCV

from hybridkin import (
    ConstantCurvatureChain,
    ElasticTendonChain,
    ELMRegressor,
    HybridForwardModel,
    InverseKinematics,
    RigidChain,
)
from hybridkin.ik.tasks import PoseTask, PositionTask

TRUNK = ConstantCurvatureChain([0.100, 0.093, 0.079])
TENDONS = ConstantCurvatureChain([0.02] * 2, lengths=[0.1] * 2)
ELASTIC = ElasticTendonChain([0.005], [0.2])
ORIGINS = np.tile(np.eye(4), (2, 1, 1))
ORIGINS[1, 2, 3] = 0.3
ARM = RigidChain(ORIGINS, [[0.0, 0.0, 1.0]] * 2, kinds=["revolute", "prismatic"])


def messages_of(model, **settings):
    with warnings.catch_warnings(record=True) as seen:
        warnings.simplefilter("always")
        there = compile("make(model, **settings)", "the caller", "eval")
        eval(there, {"make": InverseKinematics, "model": model, "settings": settings})
    assert all(warning.filename == "the caller" for warning in seen)
    return [str(warning.message) for warning in seen]


@pytest.mark.parametrize(
    ("model", "settings", "named"),
    [
        (TRUNK, {"q_min": 100.0, "q_max": 400.0}, ["q_min", "q_max"]),
        (TRUNK, {"q_min": 0.1, "q_max": [400.0] * 9}, ["q_max"]),
        (TRUNK, {"q_min": 0.1, "q_max": 0.4, "q_pref": 250.0}, ["q_pref"]),
        (TRUNK, {"q_max": 0.4, "dq_max": 100.0}, ["dq_max"]),
        (TENDONS, {"q_min": -20.0, "q_max": 20.0, "dq_max": 30.0}, ["q_min", "q_max", "dq_max"]),
        (ELASTIC, {"q_min": -4.0, "q_max": 4.0}, ["q_min", "q_max"]),
        (PoseTask(TENDONS), {"q_min": -20.0}, ["q_min"]),
        (ARM, {"q_max": [180.0, 0.2]}, ["q_max"]),
        (ARM, {"q_max": [3.0, 200.0]}, ["q_max"]),
    ],
)
def test_limits_in_millimetres_or_degrees_are_noticed(model, settings, named):
    messages = messages_of(model, **settings)
    assert [message.split("`")[1] for message in messages] == named
    for message in messages:
        assert "divide by 1000" in message or "radians" in message


@pytest.mark.parametrize(
    ("model", "settings"),
    [
        (TRUNK, {}),
        (TRUNK, {"q_min": 0.1, "q_max": 0.4, "dq_max": 0.2}),
        (TRUNK, {"q_min": 0.0, "q_max": 9.0, "dq_max": 10.0}),  # hardly a limit
        (TRUNK, {"q_min": 0.1, "q_pref": 0.25}),
        (TRUNK, {"q_max": np.inf, "dq_max": np.inf}),
        (TENDONS, {"q_min": -0.04, "q_max": 0.04, "dq_max": 1.0, "q_pref": 0.0}),
        (ELASTIC, {"q_min": -0.5, "q_max": 0.5}),
        (ARM, {"q_min": [-6.3, 0.0], "q_max": [6.3, 0.2], "dq_max": [30.0, 1.0]}),
        (lambda q: q, {"q_min": -400.0, "q_max": 400.0}),  # whose unit is not known
        (TRUNK, {"q_min": 0.1, "q_max": 0.4, "weights": 1e6, "q_pref": lambda q: q}),
    ],
)
def test_limits_in_metres_give_no_warning(model, settings):
    assert messages_of(model, **settings) == []


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


@pytest.mark.slow
def test_fitted_regressors_work_and_others_say_how():
    rng = np.random.default_rng(0)
    q = rng.uniform(0.2, 0.3, (60, 9))
    x = TRUNK(TRUNK.radii.new_tensor(q)).numpy()
    limits = {"q_min": np.full(9, 0.2), "q_max": 0.3}
    fitted = ELMRegressor(fit_intercept=True, random_state=0).fit(q, x)
    for model in (fitted, HybridForwardModel(TRUNK, random_state=0).fit(q, x)):
        target = model.predict(q[:5])
        solution = InverseKinematics(model, **limits).solve(target)
        assert solution.converged.all()
        np.testing.assert_allclose(model.predict(solution.q), target, rtol=0.0, atol=1e-4)
    for model in (ELMRegressor(), HybridForwardModel(TRUNK), LinearRegression()):
        with pytest.raises(NotFittedError, match=r"not fitted yet.*'fit'"):
            InverseKinematics(model)
    grid = GridSearchCV(ELMRegressor(10, random_state=0), {"alpha": [0.1, 1.0]}, cv=2).fit(q, x)
    for model in (LinearRegression(), RandomForestRegressor(2, random_state=0), grid):
        model.fit(q, x)
        with pytest.raises(TypeError, match=rf"got {type(model).__name__}; .*HybridForwardModel"):
            InverseKinematics(model)
    InverseKinematics(grid.best_estimator_)
    wrapped = HybridForwardModel(None, error_model=LinearRegression()).fit(q, x)
    assert InverseKinematics(wrapped, **limits).solve(wrapped.predict(q[:5])).converged.all()


def test_repr_shows_limits_and_what_differs_from_the_default():
    assert repr(InverseKinematics(TENDONS)) == "InverseKinematics(ConstantCurvatureChain)"
    ik = InverseKinematics(TRUNK, q_min=0.1, q_max=np.linspace(0.3, 0.4, 9), dq_max=0.5, beta=2)
    shown = "q_min=0.1, q_max=0.3 to 0.4, dq_max=0.5, beta=2.0"
    assert repr(ik) == f"InverseKinematics(ConstantCurvatureChain, {shown})"
    ik = InverseKinematics(PositionTask(TENDONS), q_pref=[0.0] * 6, damping=0.0, weights=[1.0] * 6)
    assert repr(ik) == "InverseKinematics(PositionTask, q_pref=0, damping=0.0, weights=1)"
