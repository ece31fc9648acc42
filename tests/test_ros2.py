"""The logic of the ROS 2 node, without ROS."""

import ast
import math
import sys
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
import torch

from hybridkin import HybridForwardModel, datasets, robots, save_model

PACKAGE = Path(__file__).parent.parent / "examples" / "ros2" / "hybridkin_tracker"


@pytest.fixture(scope="module")
def follower_class():
    sys.path.insert(0, str(PACKAGE))
    try:
        from hybridkin_tracker.follower import Follower
    finally:
        sys.path.remove(str(PACKAGE))
    return Follower


@pytest.fixture(scope="module")
def model_file(tmp_path_factory):
    data = datasets.load_trunk()
    rows = datasets.paper_split(data, random_state=0)[0][:300]
    chain = robots.bionic_handling_assistant()
    model = HybridForwardModel(
        chain, "quadratic", calibrate="default", hysteresis=0.002, random_state=0
    )
    model.fit(data.q[rows], data.x[rows], groups=np.repeat(range(30), 10))
    file = tmp_path_factory.mktemp("model") / "model.safetensors"
    save_model(model, file)
    return file, model


def test_it_waits_for_joint_states_then_follows_the_target(follower_class, model_file):
    file, model = model_file
    follower = follower_class(file, period=0.02, dq_max=0.2)
    start = model.training_range_.low + 0.4 * (
        model.training_range_.high - model.training_range_.low
    )
    target = model.module_(torch.from_numpy(start + 0.01)).detach()
    follower.target_at(target)
    assert follower.step() is None
    assert follower.status[0] == "WAITING_FOR_JOINT_STATES"
    with pytest.raises(ValueError, match="q9"):
        follower.actuators_at(follower.names[:8], start[:8])
    follower.actuators_at(follower.names[::-1], start[::-1])
    commands = np.array([follower.step() for _ in range(400)])
    assert follower.status[0] == "CONVERGED"
    assert follower.status[1] < 1e-3
    reached = model.predict(commands, groups=np.zeros(len(commands)))[-1]
    assert np.linalg.norm(reached - target.numpy()) < 2e-3


def test_a_target_that_is_not_known_stops_the_robot(follower_class, model_file):
    follower = follower_class(model_file[0], period=0.02)
    follower.actuators_at(follower.names, [0.25] * 9)
    follower.target_at([math.nan] * 3)
    commands = np.array([follower.step() for _ in range(5)])
    assert (commands[1:] == commands[0]).all()
    assert follower.status[0] == "INVALID_INPUT"


def test_the_package_names_what_it_imports():
    declared = {tag.text for tag in ElementTree.parse(PACKAGE / "package.xml").iter("exec_depend")}
    tree = ast.parse((PACKAGE / "hybridkin_tracker" / "node.py").read_text())
    imported = {
        node.module.split(".")[0] for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)
    }
    assert imported - {"hybridkin_tracker", "rclpy"} <= declared
    parameters = (PACKAGE / "config" / "tracker.yaml").read_text()
    for name in ("model", "period", "dq_max", "tolerance", "frame"):
        assert f"    {name}:" in parameters
