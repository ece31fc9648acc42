"""One control step for one configuration, model included."""

from itertools import cycle

import numpy as np
import pytest
import torch

from hybridkin import InverseKinematics, RigidChain, obstacles
from hybridkin.ik.trajectories import figure_eight

DT, N_JOINTS = 0.01, 7
START = np.array([0.3, 0.5, -0.4, 0.8, 0.3, -0.6, 0.2])  # [rad]
SPEEDS = {"free": None, "speed limits met": 0.05}  # largest speed of the chambers [m/s]


def ticking(tracker, path):
    """Return a function that follows a path, a point a call, for ever."""
    points = cycle(path)
    return lambda: tracker.step(next(points))


@pytest.fixture(scope="module")
def lap(trunk):
    """A figure eight in the middle of the working space, 200 points."""
    return figure_eight(trunk.x.mean(0), (0.12, 0.06), duration=2.0).x


@pytest.mark.slow
@pytest.mark.parametrize("limits", SPEEDS)
@pytest.mark.parametrize("guard", [None, "leverage"], ids=["no guard", "guard"])
def test_hybrid_trunk(race, hybrids, lap, arm, draw, guard, limits):
    """Nine chambers, H = 100, posture and limits."""
    ik = InverseKinematics(
        hybrids[guard], q_min=0.17, q_max=0.32, dq_max=SPEEDS[limits], dt=DT, beta=1.0
    )
    tracker = ik.tracker(ik.solve(lap[0]).q)
    q, held = tracker.q, 0
    for point in lap:
        expected = q + ik.step(q, point).dq
        q = tracker.step(point)
        np.testing.assert_allclose(q, expected, rtol=0, atol=1e-9)
        held += int(tracker.saturated.any())
    assert (held > 0) == (SPEEDS[limits] is not None)
    joints = draw(1)[0]
    race(
        f"tracker, hybrid trunk, {'' if guard else 'no '}guard, {limits}",
        "pytorch_kinematics (9 joints): J alone",
        ticking(tracker, lap),
        lambda: arm.jacobian(joints),
    )


@pytest.fixture(scope="module")
def seven_joints():
    """An arm of the usual seven revolute joints, z and y in turn, 1 m long; tip `link7`."""
    mass = '<inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/>'
    links = "".join(f'<link name="link{i}">{mass}</inertial></link>' for i in range(N_JOINTS + 1))
    joints = "".join(
        f'<joint name="joint{i}" type="revolute">'
        f'<parent link="link{i - 1}"/><child link="link{i}"/><origin xyz="0.02 0 0.15"/>'
        f'<axis xyz="{("0 1 0", "0 0 1")[i % 2]}"/>'
        '<limit lower="-2.5" upper="2.5" effort="1" velocity="2"/></joint>'
        for i in range(1, N_JOINTS + 1)
    )
    return f'<robot name="arm">{links}{joints}</robot>'


class Mink:
    """Position task, posture, joint and speed limits: the same problem as a QP."""

    def __init__(self, urdf):
        mink, mujoco = pytest.importorskip("mink"), pytest.importorskip("mujoco")
        pytest.importorskip("daqp")
        model = mujoco.MjModel.from_xml_string(urdf)
        self.solve_ik = mink.solve_ik
        self.configuration = mink.Configuration(model, START.copy())
        posture = mink.PostureTask(model, cost=1e-3)
        posture.set_target(np.zeros(N_JOINTS))
        self.task = mink.FrameTask("link7", "body", position_cost=1.0, orientation_cost=0.0)
        self.tasks, self.SE3 = [self.task, posture], mink.SE3
        speeds = {f"joint{i}": 2.0 for i in range(1, N_JOINTS + 1)}
        self.limits = [mink.ConfigurationLimit(model), mink.VelocityLimit(model, speeds)]

    def step(self, x_target):
        self.task.set_target(self.SE3.from_translation(x_target))
        velocity = self.solve_ik(
            self.configuration, self.tasks, DT, solver="daqp", limits=self.limits
        )
        self.configuration.integrate_inplace(velocity, DT)
        return self.configuration.q


class Pink:
    """The same in Pinocchio; limits are the model's own."""

    def __init__(self, urdf):
        pink, pinocchio = pytest.importorskip("pink"), pytest.importorskip("pinocchio")
        pytest.importorskip("daqp")
        model = pinocchio.buildModelFromXML(urdf)
        self.solve_ik = pink.solve_ik
        self.configuration = pink.Configuration(model, model.createData(), START.copy())
        posture = pink.tasks.PostureTask(cost=1e-3)
        posture.set_target(np.zeros(N_JOINTS))
        self.task = pink.tasks.FrameTask("link7", position_cost=1.0, orientation_cost=0.0)
        self.tasks, self.target = [self.task, posture], pinocchio.SE3.Identity()

    def step(self, x_target):
        self.target.translation = x_target
        self.task.set_target(self.target)
        velocity = self.solve_ik(self.configuration, self.tasks, DT, solver="daqp")
        self.configuration.integrate_inplace(velocity, DT)
        return self.configuration.q


@pytest.mark.parametrize("limits", ["free", "speed limits met"])
@pytest.mark.parametrize("peer", [Mink, Pink])
def test_against_quadratic_programs(race, seven_joints, peer, limits):
    """A whole tick of each: kinematics, step with posture and limits, integration."""
    chain = RigidChain.from_urdf(seven_joints, "link7")
    ik = InverseKinematics(
        chain, q_min=chain.q_min, q_max=chain.q_max, dq_max=2.0, q_pref=0.0, dt=DT
    )
    ours, theirs = ik.tracker(START), peer(seven_joints)

    def tip(q):
        return chain(torch.tensor(q)).numpy()

    center = tip(START)
    goal = center + np.array([0.02, 0.05, -0.03])
    for solver, near in ((ours, 1e-4), (theirs, 1e-3)):
        for _ in range(100):
            q = solver.step(goal)
        assert np.linalg.norm(tip(q) - goal) < near
    seconds = 4.0 if limits == "free" else 0.5
    lap, held = figure_eight(center, (0.1, 0.05), duration=seconds, dt=DT).x, 0
    for _ in range(20):
        ours.step(lap[0])
    for point in lap:
        ours.step(point)
        held += int(ours.saturated.any())
    assert (held > 0.3 * len(lap)) == (limits != "free"), held
    race(
        f"tracker, 7 joints, {limits}",
        f"{peer.__name__.lower()} (daqp), the same arm",
        ticking(ours, lap),
        ticking(theirs, lap),
    )


# Balls about the seven links and their end, and four obstacles about the path.
BALLS = [(0.5, 0.05), (1.5, 0.05), (2.5, 0.05), (3.5, 0.05), (4.5, 0.04), (5.5, 0.04), (6.5, 0.04)]
BALLS.append((7.0, 0.03))
CLEARANCE = 0.01  # [m]


class MinkAmongObstacles(Mink):
    """The same with mink's collision avoidance between eight balls of the arm and four others."""

    def __init__(self, urdf, scene, places):
        super().__init__(urdf)
        mink, mujoco = pytest.importorskip("mink"), pytest.importorskip("mujoco")
        spec = mujoco.MjSpec.from_string(urdf)
        ball = mujoco.mjtGeom.mjGEOM_SPHERE
        for k, (link, place, radius) in enumerate(places):
            spec.body(link).add_geom(name=f"ball{k}", type=ball, size=[radius] * 3, pos=place)
        for k, (center, radius) in enumerate(scene):
            spec.worldbody.add_geom(name=f"obstacle{k}", type=ball, size=[radius] * 3, pos=center)
        model = spec.compile()
        self.configuration = mink.Configuration(model, START.copy())
        pairs = [([f"ball{k}" for k in range(8)], [f"obstacle{k}" for k in range(4)])]
        avoidance = mink.CollisionAvoidanceLimit(
            model, pairs, minimum_distance_from_collisions=CLEARANCE, gain=0.85
        )
        self.limits = [*self.limits, avoidance]


@pytest.mark.parametrize("place", ["far", "in the way"])
def test_against_collision_avoidance(race, seven_joints, place):
    """A whole tick of each among four spheres, beside the path or on it."""
    chain = RigidChain.from_urdf(seven_joints, "link7")
    at_start = chain(torch.tensor(START)).numpy()
    center = at_start + np.array([0.02, 0.05, -0.03])
    away = 0.16 if place == "in the way" else 0.5
    ways = np.array([[1.0, 0.0, 0.3], [0.0, 1.0, 0.2], [-1.0, 0.2, 0.4], [0.1, -1.0, 0.1]])
    scene = [(center + away * way / np.linalg.norm(way), 0.06) for way in ways]
    balls = [obstacles.Sphere(middle, radius) for middle, radius in scene]
    ours = InverseKinematics(
        chain,
        dq_max=2.0,
        q_pref=0.0,
        dt=DT,
        obstacles=balls,
        body_points=BALLS,
        clearance=CLEARANCE,
    )
    clear = ours.settings.clear
    tracker = ours.tracker(START)
    places = []
    for at, radius in BALLS:
        joint = min(int(at), N_JOINTS - 1)
        places.append((f"link{joint + 1}", [0.02 * (at - joint), 0.0, 0.15 * (at - joint)], radius))
    theirs = MinkAmongObstacles(seven_joints, scene, places)
    lap = figure_eight(center, (0.1, 0.05), duration=4.0, dt=DT).x
    gaps = []
    for point in [*lap, *lap]:
        q = tracker.step(point)
        theirs.step(point)
        gaps.append(float(clear.smallest(torch.tensor(q)[None], clear.scene)))
    assert min(gaps) > -1e-9
    assert (min(gaps) < 1e-3) == (place == "in the way")
    race(
        f"tracker, 7 joints, 8 balls and 4 spheres {place}",
        "mink (daqp) with collision avoidance, the same arm",
        ticking(tracker, lap),
        ticking(theirs, lap),
    )
