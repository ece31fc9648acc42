"""Readings that are late, missing, noisy, or that cannot be."""

import ctypes
import math
import pickle
import shutil
import subprocess

import numpy as np
import pytest
import rounding
import torch

from hybridkin import InverseKinematics, native, robots, trajectories
from hybridkin.ik.results import IKStatus
from hybridkin.ik.tasks import PointsTask, PoseTask, PositionTask

DT = 0.01
CHAIN = robots.bionic_handling_assistant()
ROBOT = CHAIN.with_geometry(radii=1.05 * CHAIN.radii)
REACH = float(CHAIN.reach)
LIMITS = {"q_min": 0.1, "q_max": 0.4, "dq_max": 0.5, "dt": DT}
HOME = np.full(9, 0.25) + 0.01 * np.cos(np.arange(9))
TARGET = CHAIN(torch.from_numpy(HOME)).numpy() + np.array([0.02, -0.01, 0.005])
KINDS = {"core": np.asarray, "torch": lambda a: torch.from_numpy(np.asarray(a, dtype=float))}
pytestmark = pytest.mark.filterwarnings("ignore:`x_measured` spans")


def tip_of(q, robot=ROBOT):
    return native.evaluate(robot, np.asarray(q)[None])[0][0]


def late(tips, periods):
    """Return the tip some periods before the last one of a list, linear between two."""
    place = max(len(tips) - 1 - periods, 0.0)
    before = int(place)
    after = min(before + 1, len(tips) - 1)
    return tips[before] + (place - before) * (tips[after] - tips[before])


def missed(periods, given, gain=None, size=(0.3, 0.15)):
    """Return the distances of a robot from a figure eight, with a camera that is late."""
    path = trajectories.figure_eight((0.0, 0.0, 0.70), size, dt=DT, duration=8.0)
    ik = InverseKinematics(CHAIN, **LIMITS, gain=gain)
    tracker = ik.tracker(np.asarray(ik.solve(path.x[0]).q), delay=given * periods * DT)
    speeds = np.diff(path.x, axis=0, append=path.x[-1:]) / DT
    tips, errors = [], []
    for target, speed in zip(path.x, speeds, strict=True):
        tips.append(tip_of(tracker.q))
        errors.append(np.linalg.norm(tips[-1] - target))
        tracker.step(target, speed, x_measured=late(tips, periods))
    return np.array(errors)[100:]


@pytest.mark.needs_core
def test_late_readings_of_a_known_delay_do_no_harm():
    for periods in (0.0, 2.0, 3.5, 10.0):
        assert missed(periods, given=True, gain=1.0 / DT).mean() < 1e-3
        assert missed(periods, given=True).max() < 3e-3


@pytest.mark.needs_core
def test_readings_up_to_four_periods_late_need_not_be_known():
    whole = missed(4.0, given=False, gain=1.0 / DT)
    assert whole.mean() > 0.05  # where all of each reading is used
    errors = [missed(periods, given=False).mean() for periods in (0.0, 2.0, 4.0)]
    assert errors[0] < 1e-3
    assert errors == sorted(errors)
    assert errors[-1] < 6e-3


def readings_of(seed, count, tips, delay=2.5):
    """Return the reading of a late camera with noise, dropouts and outliers."""
    draw = np.random.default_rng((seed, count))
    tip = late(tips, delay) + 1e-3 * draw.standard_normal(3)
    if draw.random() < 0.08:
        tip = tip + 0.2 * np.roll([1.0, 0.0, 0.0], count)
    if draw.random() < 0.3:
        tip = np.full(3, np.nan)
    return tip


class State(ctypes.Structure):
    """The state of the exported controller."""

    _fields_ = [
        ("q", 9 * ctypes.c_double),
        ("dq", 9 * ctypes.c_double),
        ("x", 3 * ctypes.c_double),
        ("error", ctypes.c_double),
        ("sigma_min", ctypes.c_double),
        ("damping", ctypes.c_double),
        ("held", 9 * ctypes.c_ubyte),
        ("stopped", ctypes.c_ubyte),
        ("offset", 3 * ctypes.c_double),
        ("rest", 9 * ctypes.c_double),
        ("memory", ctypes.c_double),
        ("delay", ctypes.c_double),
        ("rejected", ctypes.c_ubyte),
        ("seen", 400 * ctypes.c_double),  # at least as many
    ]


class Exported:
    """The exported controller, with the interface of a tracker."""

    def __init__(self, ik, q, folder, delay):
        native.export_c(ik, folder, name="robot")
        command = ["cc", "-std=c99", "-O0", "-shared", "-fPIC", "robot.c", "-o", "robot.so", "-lm"]
        subprocess.run(command, cwd=folder, check=True)
        self.library = ctypes.CDLL(str(folder / "robot.so"))
        self.state = State()
        self.library.robot_reset(ctypes.byref(self.state), (9 * ctypes.c_double)(*q))
        assert self.state.memory == math.inf
        self.state.delay = delay
        self.q = np.array(self.state.q)

    def step(self, target, x_measured):
        vectors = [(3 * ctypes.c_double)(*v) for v in (target, x_measured)]
        self.library.robot_step(ctypes.byref(self.state), vectors[0], None, vectors[1])
        self.q = np.array(self.state.q)

    @property
    def rejected(self):
        return self.state.rejected > 0


@pytest.mark.slow
@pytest.mark.needs_core
@pytest.mark.skipif(shutil.which("cc") is None, reason="needs a C compiler")
@pytest.mark.parametrize("gain", [None, 40.0])
def test_torch_the_core_and_exported_code_use_readings_alike(gain, tmp_path):
    """Late by two and a half periods, with gaps, outliers, and a robot that is moved."""
    ik = InverseKinematics(CHAIN, **LIMITS, gain=gain)
    loops = [
        ik.tracker(HOME, delay=2.5 * DT),
        ik.tracker(torch.from_numpy(HOME), delay=2.5 * DT),
        Exported(ik, HOME, tmp_path, 2.5 * DT),
    ]
    assert loops[0].backend == "compiled"
    tips, commands, rejected = [], [HOME], 0
    for i in range(200):
        tips.append(tip_of(loops[0].q) + np.array([0.0, 0.06 * (i > 120), 0.0]))
        target = TARGET + 0.1 * np.array([np.sin(0.05 * i), np.cos(0.05 * i) - 1.0, 0.0])
        reading = readings_of(3, i, tips)
        loops[0].step(target, x_measured=reading)
        loops[1].step(torch.from_numpy(target), x_measured=torch.from_numpy(reading))
        loops[2].step(target, reading)
        commands.append(loops[0].q)
        close = rounding.of_commands(commands)
        for loop in loops[1:]:
            np.testing.assert_allclose(np.asarray(loop.q), loops[0].q, rtol=0, atol=close)
            assert loop.rejected == loops[0].rejected
        rejected += loops[0].rejected
    assert 5 < rejected < 40


@pytest.mark.parametrize("kind", KINDS)
def test_a_robot_that_is_moved_is_believed_after_a_few_readings(kind):
    convert = KINDS[kind]
    tracker = InverseKinematics(CHAIN, **LIMITS).tracker(convert(HOME))
    moved = np.zeros(3)
    errors, rejected = [], []
    for i in range(40):
        moved[1] = 0.06 * (i >= 25)
        reading = tip_of(tracker.q) + moved
        errors.append(np.linalg.norm(reading - TARGET))
        tracker.step(convert(TARGET), x_measured=convert(reading))
        rejected.append(tracker.rejected)
    assert errors[24] < 1e-3
    assert errors[35] < 5e-3
    assert [i for i, bad in enumerate(rejected) if bad] == [25, 26, 27, 28]


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("gain", [None, 100.0])
@pytest.mark.parametrize("times", [3.0, 1e3, 1e20, 1e300])
def test_readings_far_beyond_the_reach_move_nothing(kind, gain, times):
    """However often they come, and in whatever unit."""
    convert = KINDS[kind]
    ik = InverseKinematics(CHAIN, **LIMITS, gain=gain)
    ours, theirs = ik.tracker(convert(HOME)), ik.tracker(convert(HOME))
    far = np.array([0.0, times * REACH, 0.0])
    for i in range(20):
        good = i % 10 == 0  # between good ones, too
        for tracker, bad in ((ours, far), (theirs, np.full(3, np.nan))):
            reading = tip_of(tracker.q) if good else bad
            tracker.step(convert(TARGET), x_measured=convert(reading))
        assert ours.rejected == (not good)
        np.testing.assert_array_equal(ours.q, theirs.q)
        if not good:
            assert ours.status is IKStatus.INVALID_INPUT
    assert np.linalg.norm(tip_of(ours.q) - TARGET) < 0.02


def test_millimetres_are_named_and_not_used():
    tracker = InverseKinematics(CHAIN, **LIMITS).tracker(HOME)
    with pytest.warns(UserWarning, match="millimetres.*not used"):
        tracker.step(TARGET, x_measured=1e3 * TARGET)
    assert tracker.rejected


def tasks():
    start = torch.from_numpy(HOME)
    turned = CHAIN.pose(start).numpy()
    beside = np.stack([CHAIN.with_tip(at)(start).numpy() for at in (1.5, 3.0)])
    flipped = turned.copy()
    flipped[:3, 0] *= -1.0
    flipped[:3, 1] *= -1.0
    wrong = beside.copy()
    wrong[0, 1] += 0.2
    return [(PoseTask(CHAIN), turned, flipped), (PointsTask(CHAIN, [1.5, 3.0]), beside, wrong)]


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("case", [0, 1])
def test_poses_and_points_that_cannot_be_are_not_used(case, kind):
    """A marker body that is seen the other way round, and one of two points that jumps."""
    task, target, wrong = tasks()[case]
    convert = KINDS[kind]
    ik = InverseKinematics(task, **LIMITS)
    ours, theirs = ik.tracker(convert(HOME)), ik.tracker(convert(HOME))
    for _ in range(4):
        ours.step(convert(target), x_measured=convert(wrong))
        theirs.step(convert(target))
        assert ours.rejected
        np.testing.assert_array_equal(ours.q, theirs.q)
    ours.step(convert(target), x_measured=convert(target))
    assert not ours.rejected


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("case", [0, 1])
def test_the_error_of_a_task_goes_where_the_readings_say(case, kind):
    task, target, _ = tasks()[case]
    convert = KINDS[kind]
    goal = target + 0.02 * (target == target[-1 - case, -1])
    ik = InverseKinematics(task, q_min=0.1, q_max=0.4, dt=DT)
    tracker = ik.tracker(convert(HOME), delay=1.5 * DT)
    robot = type(task)(ROBOT, *([[1.5, 3.0]] if case else []))
    tips = []
    for _ in range(40):
        q = torch.from_numpy(np.asarray(tracker.q))[None]
        tips.append(robot.evaluate(q)[0][0].numpy())
        reading = late(tips, 1.5)
        if not case:
            U, _, V = np.linalg.svd(reading[:3, :3])
            reading[:3, :3] = U @ V
        tracker.step(convert(goal), x_measured=convert(reading))
    assert (
        float(np.linalg.norm(task.difference(*map(torch.from_numpy, (tips[-1][None], goal[None])))))
        < 1e-4
    )
    assert tracker.error < 1e-4


@pytest.mark.parametrize("kind", KINDS)
def test_a_row_that_is_not_known_leaves_its_offset(kind):
    convert = KINDS[kind]
    ik = InverseKinematics(CHAIN, q_min=0.1, q_max=0.4, gain=1.0 / DT, beta=0.0, dt=DT)
    tracker = ik.tracker(convert(HOME))
    off = np.array([0.004, -0.003, 0.006])
    nothing = np.full(3, np.nan)
    for more in (np.zeros(3), np.array([0.001, np.nan, 0.001]), nothing):
        for _ in range(10):
            reading = tip_of(tracker.q, CHAIN) + off + more
            tracker.step(convert(TARGET), x_measured=convert(reading))
    moved = tip_of(tracker.q, CHAIN) - TARGET
    np.testing.assert_allclose(moved, -off - [0.001, 0.0, 0.001], rtol=0, atol=1e-8)


@pytest.mark.parametrize("kind", KINDS)
def test_the_time_of_a_reading_counts(kind):
    """At varying ages, as with a delay that is known each time."""
    convert = KINDS[kind]
    ik = InverseKinematics(CHAIN, **LIMITS, gain=1.0 / DT)
    tracker = ik.tracker(convert(HOME))
    tips = []
    for i in range(60):
        tips.append(tip_of(tracker.q))
        assert tracker.time == pytest.approx(i * DT)
        age = 3.5 * (1.0 + math.sin(i))
        target = TARGET + np.array([0.05 * math.sin(0.1 * i), 0.0, 0.0])
        speed = convert([0.5 * math.cos(0.1 * i + 0.05), 0.0, 0.0])
        at = tracker.time - age * DT
        tracker.step(convert(target), speed, x_measured=convert(late(tips, age)), at=at)
    np.testing.assert_allclose(tips[-1], target, atol=2e-3)
    assert tracker.error < 2e-3


@pytest.mark.parametrize("kind", KINDS)
def test_times_of_readings_that_are_not_kept_are_refused(kind):
    convert = KINDS[kind]
    ik = InverseKinematics(CHAIN, q_min=0.1, q_max=0.4, dt=DT)
    for delay in (0.6301, -0.1, math.nan, math.inf):
        with pytest.raises(ValueError, match=r"`delay` must be a time from 0 to 0\.63 s"):
            ik.tracker(HOME, delay=delay)
    tracker = ik.tracker(convert(HOME), delay=0.63)
    tip = convert(tip_of(HOME))
    tracker.step(convert(TARGET), x_measured=tip, at=-7.0)  # it stood still there
    for _ in range(70):
        tracker.step(convert(TARGET))
    before = np.array(np.asarray(tracker.q))
    for at in (0.05, tracker.time + 0.01, math.nan, -math.inf):
        with pytest.raises(ValueError, match=r"`at` must be a time \[s\] from 0.08 to 0.71"):
            tracker.step(convert(TARGET), x_measured=tip, at=at)
    np.testing.assert_array_equal(tracker.q, before)
    assert tracker.time == pytest.approx(0.71)
    tracker.step(convert(TARGET), x_measured=tip, at=0.08)
    with pytest.raises(ValueError, match='`delay` requires feedback="measured"'):
        ik.track(np.tile(TARGET, (3, 1)), delay=0.1)


@pytest.mark.parametrize("kind", KINDS)
def test_a_tracker_goes_on_from_its_pickle_and_forgets_at_a_reset(kind):
    convert = KINDS[kind]
    tracker = InverseKinematics(CHAIN, **LIMITS).tracker(convert(HOME), delay=2.5 * DT, memory=1.0)
    tips = []

    def run(tracker, start, count):
        for i in range(start, start + count):
            tips.append(tip_of(tracker.q))
            reading = readings_of(5, i, tips)
            tracker.step(convert(TARGET), x_measured=convert(reading))
        return np.array(np.asarray(tracker.q))

    first = run(tracker, 0, 12)
    again = pickle.loads(pickle.dumps(tracker))
    kept = tips[:]
    one = run(tracker, 12, 12)
    tips[:] = kept
    np.testing.assert_array_equal(run(again, 12, 12), one)
    tips.clear()
    tracker.reset(convert(HOME))
    assert tracker.time == 0.0
    np.testing.assert_array_equal(run(tracker, 0, 12), first)


def test_single_precision_uses_readings_alike():
    chain = robots.bionic_handling_assistant().float()
    loops = [
        InverseKinematics(chain, **LIMITS).tracker(HOME.astype(np.float32), delay=1.5 * DT),
        InverseKinematics(CHAIN, **LIMITS).tracker(HOME, delay=1.5 * DT),
    ]
    tips = []
    for i in range(30):
        tips.append(tip_of(loops[1].q))
        reading = readings_of(1, i, tips, 1.5)
        for loop in loops:
            loop.step(TARGET.astype(loop.q.dtype), x_measured=reading.astype(loop.q.dtype))
        assert loops[0].rejected == loops[1].rejected
    assert loops[0].q.dtype == np.float32
    ends = [tip_of(loop.q.astype(float)) for loop in loops]
    np.testing.assert_allclose(ends[0], ends[1], rtol=0, atol=1e-5)


@pytest.mark.parametrize("kind", KINDS)
def test_a_track_counts_rejected_readings_and_knows_the_delay(kind):
    convert = KINDS[kind]
    ik = InverseKinematics(CHAIN, **LIMITS, gain=1.0 / DT)
    path = TARGET + 0.03 * np.sin(0.05 * np.arange(50))[:, None]
    tips = []

    def plant(q):
        tips.append(tip_of(q))
        return late(tips, 3.0) + np.array([0.0, 0.3 * (len(tips) == 31), 0.0])

    track = ik.track(
        convert(path), q0=convert(HOME), plant=plant, feedback="measured", delay=3.0 * DT, tol=2e-3
    )
    assert np.flatnonzero(np.asarray(track.rejected)).tolist() == [30]
    assert track.status[30] == IKStatus.INVALID_INPUT
    assert "<td>1</td>" in track._repr_html_().split("rejected readings")[1]
    errors = np.linalg.norm(np.array(tips) - path, axis=1)
    known = np.arange(50) != 30
    assert_close = np.testing.assert_allclose
    assert_close(np.asarray(track.error)[15:][known[15:]], errors[15:][known[15:]], atol=1e-3)
    assert ik.track(convert(path), q0=convert(HOME)).rejected is None
    with pytest.raises(ValueError, match=r"`delay` must be a time from 0 to 0\.63 s"):
        ik.track(convert(np.tile(TARGET, (70, 1))), plant=plant, feedback="measured", delay=0.7)


def test_a_model_without_a_size_has_that_of_its_tips():
    task = PositionTask(lambda q: CHAIN(q))
    ik = InverseKinematics(task, q_min=np.full(9, 0.1), q_max=np.full(9, 0.4), dt=DT)
    ours, theirs = ik.tracker(HOME), ik.tracker(HOME)
    for _ in range(8):
        ours.step(TARGET, x_measured=1e3 * TARGET)
        theirs.step(TARGET)
    assert ours.rejected
    np.testing.assert_array_equal(ours.q, theirs.q)
