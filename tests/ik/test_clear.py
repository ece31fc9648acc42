"""The body keeps clear of obstacles: in steps, trackers, tracks and solutions."""

import pickle

import numpy as np
import pytest
import torch

from hybridkin import (
    ConstantCurvatureChain,
    ElasticTendonChain,
    HybridForwardModel,
    IKStatus,
    InverseKinematics,
    RigidChain,
    obstacles,
    robots,
    tasks,
)

TRUNK = robots.bionic_handling_assistant()
TENDONS = {"lengths": [0.08, 0.08, 0.06], "routing": "base"}
# Robot, limits of q, start, and whether tendons can only pull.
ROBOTS = {
    "trunk": (TRUNK, 0.15, 0.35, 0.25),
    "tendons": (ConstantCurvatureChain([0.012, 0.010, 0.008], **TENDONS), -0.02, 0.02, 0.0),
    "elastic": (ElasticTendonChain([0.012, 0.010, 0.008], **TENDONS), -0.02, 0.005, 0.0),
}
FLOOR = obstacles.HalfSpace([0.0, 0.0, 1.0], 0.0)


def random_scene(draw, tip, size):
    """Return one to five random obstacles about a robot."""
    scene = []
    for _ in range(draw.integers(1, 6)):
        way = draw.normal(size=3)
        center = draw.uniform(0.3, 1.1) * tip + draw.uniform(0.2, 0.7) * size * way / 2.0
        side = tip - center
        kinds = [
            lambda c=center: obstacles.Sphere(c, size * draw.uniform(0.02, 0.15)),
            lambda c=center: obstacles.Capsule(
                c, c + 0.3 * size * draw.normal(size=3), 0.03 * size
            ),
            lambda c=center: obstacles.Box(c, size * draw.uniform(0.02, 0.3, 3)),
            lambda c=center, s=side: obstacles.HalfSpace(s, float(s @ (c - 0.3 * s))),
        ]
        scene.append(kinds[draw.integers(4)]())
    return scene


def gap(ik, q):
    """Return the smallest gap of the body at one configuration [m]."""
    clear = ik.settings.clear
    return float(clear.smallest(torch.as_tensor(q)[None], clear.scene))


def free_case(name, seed, **options):
    """Return a robot among obstacles that is free at its start, and this start."""
    chain, low, high, start = ROBOTS[name]
    draw = np.random.default_rng(seed)
    q0 = np.full(9, start)
    tip = chain(torch.from_numpy(q0)).numpy()
    size = float(chain.reach)
    while True:
        ik = InverseKinematics(
            chain,
            q_min=low,
            q_max=high,
            dq_max=(high - low) * draw.choice([0.5, 2.0, 10.0, np.inf]),
            obstacles=random_scene(draw, tip, size),
            body_points=int(draw.integers(4, 10)),
            clearance=float(draw.choice([0.0, 0.02 * size])),
            **options,
        )
        if gap(ik, q0) > 0.0:
            return ik, q0, tip + 0.5 * size * draw.normal(size=3)


@pytest.mark.parametrize("name", ROBOTS)
@pytest.mark.parametrize("options", [{}, {"ddq_max": 0.5}, {"weights": np.arange(1.0, 10.0)}])
def test_a_free_body_stays_free_and_within_all_limits(name, options):
    if "ddq_max" in options:
        low, high = ROBOTS[name][1:3]
        options = {"ddq_max": 10.0 * (high - low)}
    for seed in range(3):
        ik, q, target = free_case(name, seed, **options)
        settings = ik.settings
        tracker = ik.tracker(q)
        step = np.zeros(9)
        for _ in range(30):
            new = tracker.step(target)
            assert gap(ik, new) >= -1e-9
            assert (new >= settings.q_min.numpy()).all()
            assert (new <= settings.q_max.numpy()).all()
            assert (abs(new - q) <= settings.dq_max.numpy() * 0.01 + 1e-15).all()
            assert (abs(new - q - step) <= settings.ddq_max.numpy() * 1e-4 + 1e-15).all()
            step = new - q
            q = new


def test_far_obstacles_change_nothing():
    draw = np.random.default_rng(0)
    far = [obstacles.Sphere([3.0, 0.0, 0.0], 0.5), obstacles.Box([0.0, -3.0, 0.0], [1.0] * 3)]
    limits = {"q_min": 0.15, "q_max": 0.35, "dq_max": 0.5}
    q = draw.uniform(0.2, 0.3, (20, 9))
    x = draw.uniform([-0.3, -0.3, 0.6], [0.3, 0.3, 1.0], (20, 3))
    among = InverseKinematics(TRUNK, obstacles=far, body_points=6, **limits).step(q, x)
    alone = InverseKinematics(TRUNK, **limits).step(q, x)
    np.testing.assert_allclose(among.dq, alone.dq, rtol=0.0, atol=1e-11)


def wall_and_target():
    """Return a solver whose target lies beyond a wall, which the tip can touch beside it."""
    wall = obstacles.HalfSpace([-1.0, 0.0, 0.0], -0.3)  # x below 0.3 m is free
    ik = InverseKinematics(
        TRUNK,
        q_min=0.1,
        q_max=0.4,
        dq_max=0.5,
        q_pref=0.25,
        obstacles=[wall, FLOOR],
        body_points=[(1.0, 0.08), (2.0, 0.08), (3.0, 0.05)],
    )
    return ik, np.array([0.45, 0.1, 0.6])


def test_the_tip_slides_along_a_wall_to_the_nearest_point():
    ik, target = wall_and_target()
    tracker = ik.tracker(np.full(9, 0.25))
    for _ in range(300):
        before = tracker.q
        q = tracker.step(target)
    assert abs(q - before).max() < 1e-9
    np.testing.assert_allclose(tracker.x, [0.25, 0.1, 0.6], atol=1e-6)
    assert tracker.status == IKStatus.BLOCKED
    solution = ik.solve(target)
    np.testing.assert_allclose(solution.x, [0.25, 0.1, 0.6], atol=2e-4)
    assert solution.status == IKStatus.BLOCKED
    assert solution.error == pytest.approx(0.2, abs=2e-4)


def test_an_obstacle_that_comes_pushes_the_body_away():
    ball = obstacles.Sphere([0.5, 0.0, 0.6], 0.1)
    ik = InverseKinematics(TRUNK, q_min=0.1, q_max=0.4, obstacles=[ball], body_points=6)
    q0 = np.full(9, 0.25)
    tracker = ik.tracker(q0)
    at_rest = TRUNK(torch.from_numpy(q0)).numpy()
    for k in range(60):
        tracker.obstacles = [ball.moved([0.5 - 0.006 * k, 0.0, 0.6])]
        tracker.step(at_rest)
    here = ik.settings.clear.smallest(
        torch.from_numpy(tracker.q)[None], tracker.obstacles[0].numbers[None]
    )
    assert float(here) > -0.007  # it sees a motion one period late
    assert abs(tracker.q - q0).max() > 0.01
    with pytest.raises(ValueError, match="as many as before, 1, got 2"):
        tracker.obstacles = [ball, ball]
    tracker.reset(q0)
    assert tracker.obstacles[0].center[0] < 0.2


def test_a_body_that_starts_inside_leaves():
    ball = obstacles.Sphere([0.25, 0.0, 0.5], 0.15)
    ik = InverseKinematics(TRUNK, q_min=0.1, q_max=0.4, dq_max=0.5, obstacles=[ball], body_points=6)
    q = np.full(9, 0.25)
    start = gap(ik, q)
    assert start < -0.01
    tracker = ik.tracker(q)
    target = TRUNK(torch.from_numpy(q)).numpy()
    last = start
    for _ in range(60):
        now = gap(ik, tracker.step(target))
        assert now >= last - 1e-9
        last = now
    assert last > -1e-6


def test_the_body_keeps_clear_of_itself():
    chain = ConstantCurvatureChain([0.01] * 4, lengths=[0.1] * 4, routing="base")
    limits = {"q_min": -0.06, "q_max": 0.06, "dq_max": 0.1}
    curl = np.array([-0.0, 0.0, 0.0] * 4)
    target = np.array([0.02, 0.0, 0.1])
    inside = []
    for body_points in (None, 12):
        ik = InverseKinematics(chain, body_points=body_points, **limits)
        watch = InverseKinematics(chain, body_points=12, **limits)
        tracker = ik.tracker(curl)
        worst = np.inf
        for _ in range(200):
            worst = min(worst, gap(watch, tracker.step(target)))
        inside.append(worst)
    assert inside[0] < -1e-3
    assert inside[1] >= -1e-9


def test_no_solution_has_its_body_in_an_obstacle():
    draw = np.random.default_rng(3)
    scene = [obstacles.Capsule([0.3, -0.5, 0.7], [0.3, 0.5, 0.7], 0.05), FLOOR]
    limits = {"q_min": 0.15, "q_max": 0.35}
    ik = InverseKinematics(TRUNK, obstacles=scene, body_points=6, **limits)
    x = draw.uniform([-0.4, -0.4, 0.4], [0.4, 0.4, 1.0], (12, 3))
    solution = ik.solve(x, restarts=4)
    clear = ik.settings.clear
    gaps = clear.smallest(torch.from_numpy(solution.q), clear.scene).numpy()
    converged = solution.status == IKStatus.CONVERGED
    assert converged.sum() > 3
    assert (gaps[converged] >= -1e-6).all()
    alone = InverseKinematics(TRUNK, **limits).solve(x)
    others = clear.smallest(torch.from_numpy(alone.q), clear.scene).numpy()
    easy = (alone.status == IKStatus.CONVERGED) & (others > 0.0)
    assert solution.converged[easy].all()
    assert (others[alone.converged] < 0.0).any()


def test_a_track_tells_the_smallest_gap():
    ik, target = wall_and_target()
    path = np.linspace([0.0, 0.1, 0.75], target, 30)
    track = ik.track(path, q0=np.full(9, 0.25))
    assert track.clearance.shape == (30,)
    assert (track.clearance >= -1e-9).all()
    assert track.clearance.min() < 1e-3
    assert track.status[-1] == IKStatus.BLOCKED
    alone = InverseKinematics(TRUNK, q_min=0.1, q_max=0.4).track(path, q0=np.full(9, 0.25))
    assert np.isinf(alone.clearance).all()


def test_the_clearance_holds_the_expected_error():
    draw = np.random.default_rng(0)
    q = draw.uniform(0.2, 0.3, (120, 9))
    x = TRUNK(torch.from_numpy(q)).numpy() + 0.002 * draw.normal(size=(120, 3))
    model = HybridForwardModel(TRUNK, "linear", coverage=0.9).fit(q, x)
    ball = [obstacles.Sphere([0.4, 0.0, 0.5], 0.05)]
    options = {"q_min": 0.15, "q_max": 0.35, "obstacles": ball, "body_points": 5}
    plain = InverseKinematics(TRUNK, **options).settings.clear
    hybrid = InverseKinematics(model, clearance=0.01, **options).settings.clear
    expected = plain.keep + 0.01 + model.radius_.inside
    torch.testing.assert_close(hybrid.keep, expected)
    assert model.radius_.inside > 1e-3


def test_balls_cover_the_body():
    """Every point of the surface of a straight body lies in a ball."""
    ik = InverseKinematics(TRUNK, q_max=0.3, obstacles=[FLOOR])
    clear = ik.settings.clear
    length = TRUNK.body_lengths(torch.full((9,), 0.3, dtype=torch.float64))
    heights = torch.linspace(0.0, float(length[-1]), 500, dtype=torch.float64)
    segment = torch.bucketize(heights, length[1:-1], right=False)
    surface = torch.stack([TRUNK.body_radii[segment], 0.0 * heights, heights], dim=-1)
    centres = torch.stack([0.0 * clear.along, 0.0 * clear.along, clear.along], dim=-1)
    away = torch.cdist(surface, centres) - clear.radii
    assert (away.amin(-1) <= 1e-9).all()
    assert (clear.radii <= 1.3 * 0.1).all()


def test_a_rigid_arm_needs_the_radii_of_its_links():
    arm = RigidChain.from_urdf(ARM, end_link="hand")
    with pytest.raises(ValueError, match="`body_points` must give the radii"):
        InverseKinematics(arm, obstacles=[FLOOR])
    balls = [(1.0, 0.04), (2.0, 0.04), (3.0, 0.03)]
    wall = obstacles.HalfSpace([-1.0, 0.0, 0.0], -0.5)
    ik = InverseKinematics(
        arm, obstacles=[wall], body_points=balls, q_min=-3.0, q_max=3.0, dq_max=2
    )
    tracker = ik.tracker(np.array([0.1, 0.3, 0.4]))
    for _ in range(200):
        q = tracker.step([0.7, 0.0, 0.5])
    assert gap(ik, q) == pytest.approx(0.0, abs=1e-6)
    assert tracker.status == IKStatus.BLOCKED


ARM = """<robot name="arm"><link name="base"/><link name="upper"/><link name="lower"/>
<link name="wrist"/><link name="hand"/>
<joint name="a" type="revolute"><parent link="base"/><child link="upper"/><axis xyz="0 0 1"/>
<origin xyz="0 0 0.2"/><limit lower="-3" upper="3" velocity="2" effort="1"/></joint>
<joint name="b" type="revolute"><parent link="upper"/><child link="lower"/><axis xyz="0 1 0"/>
<origin xyz="0 0 0.2"/><limit lower="-3" upper="3" velocity="2" effort="1"/></joint>
<joint name="c" type="revolute"><parent link="lower"/><child link="wrist"/><axis xyz="0 1 0"/>
<origin xyz="0 0 0.3"/><limit lower="-3" upper="3" velocity="2" effort="1"/></joint>
<joint name="d" type="fixed"><parent link="wrist"/><child link="hand"/>
<origin xyz="0 0 0.3"/></joint></robot>"""


def test_a_pose_and_several_points_among_obstacles():
    ball = [obstacles.Sphere([0.3, 0.0, 0.6], 0.1)]
    options = {"q_min": 0.15, "q_max": 0.35, "dq_max": 0.5, "obstacles": ball, "body_points": 6}
    q0 = torch.full((9,), 0.25, dtype=torch.float64)
    pose = tasks.PoseTask(TRUNK)
    points = tasks.PointsTask(TRUNK, [2.0, 3.0])
    for task in (pose, points):
        target, _ = task.evaluate(q0[None] + torch.linspace(-0.05, 0.05, 9, dtype=torch.float64))
        ik = InverseKinematics(task, **options)
        tracker = ik.tracker(q0.numpy())
        for _ in range(50):
            assert gap(ik, tracker.step(target[0].numpy())) >= -1e-9


def test_a_motion_of_everything_changes_nothing():
    """Base, obstacles and targets turned together: the same commands."""
    ik, q, target = free_case("trunk", 5)
    angle = 0.8
    turn = np.eye(4)
    turn[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    turn[:3, 3] = [0.1, -0.3, 0.2]
    R = torch.from_numpy(turn[:3, :3])
    shift = torch.from_numpy(turn[:3, 3])
    moved = []
    for obstacle in ik.settings.obstacles:
        moved.append(
            obstacles.Obstacle(
                R @ obstacle.center + shift,
                obstacle.axes @ R.mT,
                obstacle.low,
                obstacle.high,
                obstacle.radius,
            )
        )
    settings = ik.settings
    other = InverseKinematics(
        TRUNK.moved(torch.from_numpy(turn)),
        q_min=0.15,
        q_max=0.35,
        dq_max=float(settings.dq_max),
        obstacles=moved,
        body_points=settings.body_points,
        clearance=settings.clearance,
    )
    one = ik.tracker(q)
    two = other.tracker(q)
    for _ in range(20):
        first = one.step(target)
        second = two.step(turn[:3, :3] @ target + turn[:3, 3])
        np.testing.assert_allclose(first, second, rtol=0.0, atol=1e-9)


def test_a_tracker_among_obstacles_is_pickled():
    ik, q, target = free_case("trunk", 1)
    tracker = ik.tracker(q)
    tracker.step(target)
    twin = pickle.loads(pickle.dumps(tracker))
    np.testing.assert_array_equal(tracker.step(target), twin.step(target))


def test_batches_equal_rows_and_nan_touches_its_row_alone():
    ik, q, target = free_case("trunk", 2)
    draw = np.random.default_rng(0)
    rows = q + 0.01 * draw.normal(size=(6, 9))
    rows[2, 4] = np.nan
    among = ik.step(rows, target)
    assert (among.dq[2, :4] == 0.0).all()
    for k in (0, 1, 3, 4, 5):
        np.testing.assert_allclose(among.dq[k], ik.step(rows[k], target).dq, rtol=0.0, atol=1e-12)


def test_single_precision():
    ik, q, target = free_case("trunk", 4)
    rows = torch.from_numpy(q).float()
    step = ik.step(rows, torch.from_numpy(target).float())
    assert step.dq.dtype == torch.float32
    assert gap(ik, (rows + step.dq).double()) >= -1e-5


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("obstacles", {"obstacles": FLOOR}),
        ("obstacles", {"obstacles": [1.0]}),
        ("clearance", {"clearance": -0.1}),
        ("clearance", {"clearance": np.nan}),
        ("body_points", {"body_points": 0}),
        ("body_points", {"body_points": [(1.0, -0.1)]}),
        ("body_points", {"body_points": [(2.0, 0.1), (1.0, 0.1)]}),
        ("body_points", {"body_points": [1.0, 2.0]}),
        ("q_max", {"q_max": np.inf, "obstacles": [FLOOR]}),
    ],
)
def test_arguments_are_refused_by_name(name, options):
    with pytest.raises((TypeError, ValueError), match=f"`{name}"):
        InverseKinematics(TRUNK, **{"q_min": 0.1, "q_max": 0.4, **options})


def test_a_function_has_no_body():
    with pytest.raises(TypeError, match="body"):
        InverseKinematics(lambda q: q, obstacles=[FLOOR], q_min=[0.0] * 3, q_max=1.0)


def test_derivatives_and_obstacles_exclude_each_other():
    ik, _ = wall_and_target()
    with pytest.raises(ValueError, match="differentiable"):
        ik.solve(torch.zeros(3, dtype=torch.float64), differentiable=True)
