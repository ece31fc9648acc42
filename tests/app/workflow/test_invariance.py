"""What the unit of the log, the names of motions and repeated rows may not change in reports."""

import csv
from dataclasses import replace

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose, assert_array_equal

from hybridkin import (
    ConstantCurvatureChain,
    HybridForwardModel,
    Hysteresis,
    open_model,
    robots,
    trajectories,
)
from hybridkin.app import workflow
from hybridkin.app.workflow import FitSettings
from hybridkin.app.workflow.compare import compare, mechanical_of
from hybridkin.app.workflow.domain import Domain
from hybridkin.app.workflow.errors import Errors, HeldOutErrors, Promise
from hybridkin.app.workflow.fit_record import largest_errors
from hybridkin.app.workflow.log import checked
from hybridkin.app.workflow.model import domain_distance, fitted_rows, tips_at, widths_in_log
from hybridkin.app.workflow.path import scaled_path
from hybridkin.datasets import Log

# ---------------------------------------------------------------- statistics of errors

LENGTHS = np.array([3, 9, 5, 1, 12])  # of motions
MOTIONS = np.repeat(np.arange(5), LENGTHS)
FOLD = np.repeat([0, 1, 0, 2, 1], LENGTHS)
ERRORS = np.random.default_rng(0).exponential(1e-3, len(MOTIONS)) * (1.0 + MOTIONS)


def statistics(errors, motions, fold):
    return vars(HeldOutErrors.of_motions(errors, motions, fold))


def test_held_out_errors_count_motions_whatever_their_names_and_the_order_of_rows():
    expected = statistics(ERRORS, MOTIONS, FOLD)
    order = np.random.default_rng(1).permutation(len(MOTIONS))
    names = np.array([*"zaqmk"])[MOTIONS]
    found = statistics(ERRORS[order], names[order], FOLD[order])
    twice = statistics(np.repeat(ERRORS, 2), np.repeat(MOTIONS, 2), np.repeat(FOLD, 2))
    scaled = statistics(2.0 * ERRORS, MOTIONS, FOLD)
    for name in ("mean", "std", "median", "max", "std_error", "std_folds", "by_fold"):
        assert_allclose(found[name], expected[name], rtol=1e-12, err_msg=name)
        assert_allclose(scaled[name], 2.0 * expected[name], rtol=1e-12, err_msg=name)
        # Repeated rows say nothing new: they are no further motions.
        assert_allclose(twice[name], expected[name], rtol=1e-12, err_msg=name)
    assert (found["rows"], twice["rows"]) == (30, 60)


def test_the_standard_error_in_closed_form():
    """Of motions of one row, of equal motions, and of one motion as two."""
    errors = ERRORS[:12]
    alone = statistics(errors, np.arange(12), np.zeros(12, int))
    assert alone["std_error"] == pytest.approx(errors.std(ddof=1) / np.sqrt(12))
    blocks = statistics(errors, np.arange(12) // 3, np.zeros(12, int))
    means = errors.reshape(4, 3).mean(axis=1)
    assert blocks["std_error"] == pytest.approx(means.std(ddof=1) / np.sqrt(4))
    folds = statistics(errors, np.arange(12), np.repeat([1, 0], [9, 3]))
    assert_allclose(folds["by_fold"], [errors[9:].mean(), errors[:9].mean()])
    assert folds["std_folds"] == pytest.approx(np.std([errors[9:].mean(), errors[:9].mean()]))


def test_a_promise_has_the_unit_of_its_errors_and_counts_rows():
    far = np.random.default_rng(2).uniform(0.0, 2.0, 300)
    errors = (2e-3 + 3e-3 * far) * np.random.default_rng(3).exponential(size=300)
    plain = vars(Promise.of(errors, far))
    scaled = vars(Promise.of(1e3 * errors, far))
    halved = vars(Promise.of(errors, 0.5 * far))
    weighted = vars(Promise.of(np.repeat(errors, 3), np.repeat(far, 3)))
    for name, value in plain.items():
        mm, per_half = (1.0, 1.0) if name == "p95" else (1e3, 1.0)
        if name == "per_distance":
            per_half = 2.0
        assert scaled[name] == pytest.approx(mm * value)
        assert halved[name] == pytest.approx(per_half * value)
        # The quantile lies between two rows; repeated, nearer to one of them.
        assert weighted[name] == pytest.approx(value, rel=0.02 if name == "p95" else 1e-9)
    expected = Promise.of(errors, far).at(np.array([0.0, 2.0]))
    assert_allclose(expected.p95, plain["p95"] * expected.mean)
    assert np.ptp(expected.mean) == pytest.approx(2.0 * plain["per_distance"])


# Errors of two models, as a comparison has them.
COMPARED = {"mechanical, calibrated": 1e-3 * np.ones(30), "hybrid, auto": ERRORS}


def test_the_motions_of_largest_errors_are_those_of_largest_means():
    """Not of the largest sums: the motions have other lengths."""
    means = np.array([ERRORS[MOTIONS == k].mean() for k in range(5)])
    names = np.array([*"zaqmk"])
    for labels in (names[MOTIONS], MOTIONS):
        entries = largest_errors(COMPARED, labels)
        order = np.argsort(means)[::-1]
        shown = names if labels.dtype.kind == "U" else np.arange(5)
        assert [entry.motion for entry in entries] == [str(shown[k]) for k in order]
        assert [entry.rows for entry in entries] == LENGTHS[order].tolist()
        found = [entry.means["hybrid, auto"] for entry in entries]
        assert_allclose(found, means[order])
        assert_allclose([entry.means["mechanical, calibrated"] for entry in entries], 1e-3)


# ---------------------------------------------------------------- motors and metres

GAINS = np.array([0.006, -0.012, 0.009, -0.006, 0.004, 0.006])  # [m] per radian
RADII = {"radii": [0.005, 0.005], "lengths": [0.1, 0.1]}
PLAIN = ConstantCurvatureChain(**RADII)
LIMITS = robots.Limits(
    np.array([-0.006, -0.005, -0.007, -0.006, -0.005, -0.006]),
    np.array([0.004, 0.005, 0.003, 0.005, 0.006, 0.004]),
    np.full(6, 0.02),
    np.full(6, 0.2),
)
COLUMNS = tuple("abcdef")


def loaded(gains, tmp_path, *, learned=False, width=0.0):
    """Return a robot whose q are metres over gains, of the same geometry and limits."""
    chain = ConstantCurvatureChain(**RADII, gains=gains)
    signs = tuple(np.sign(gains).astype(int).tolist())
    unit = "deg" if np.ptp(np.abs(gains)) > 0.0 else "ticks"
    log = robots.LogFormat(COLUMNS, ("x", "y", "z"), q_unit=unit, x_unit="cm", q_sign=signs)
    description = robots.RobotDescription("r", chain, (), log, LIMITS.scaled(1.0 / gains))
    model = chain
    if learned:
        rng = np.random.default_rng(0)
        bends = rng.uniform(-0.8, 0.8, (120, 2, 2))
        ring = 2.0 * np.pi / 3.0 * np.arange(3)
        q = -0.004 * (bends @ np.stack([np.cos(ring), np.sin(ring)])).reshape(120, 6)
        with torch.no_grad():
            x = PLAIN(torch.from_numpy(q)).numpy() + 0.1 * q[:, :3]
        model = HybridForwardModel(chain, "linear", hysteresis=width / np.abs(gains))
        model.fit(q / gains, x, groups=np.arange(120) // 10)
    if not learned:
        model = open_model(chain)
    known = replace(model.description_, robot=description, path=tmp_path / "model")
    return model.described(known)


@pytest.mark.parametrize("learned", [False, True])
def test_limits_are_those_of_metres(tmp_path, learned):
    """In motors some of which turn the other way: their limits are swapped.

    One end alone is the other one of these motors, and leaves their first one as described.
    """
    metres = loaded(np.ones(6), tmp_path, learned=learned)
    motors = loaded(GAINS, tmp_path, learned=learned)
    given = robots.Limits(np.full(6, -0.003), np.full(6, 0.002), ddq_max=np.full(6, 0.1))
    for limits in (robots.Limits(), given, robots.Limits(q_min=np.full(6, -0.002))):
        plain = workflow.path_limits(metres, **vars(limits))
        other = workflow.path_limits(motors, **vars(limits.scaled(1.0 / GAINS)))
        ends = np.sort([other.q_min * GAINS, other.q_max * GAINS], axis=0)
        assert_allclose(ends, [plain.q_min, plain.q_max], rtol=1e-12, atol=1e-15)
        for name in ("dq_max", "ddq_max"):
            assert_allclose(vars(other)[name] * np.abs(GAINS), vars(plain)[name], rtol=1e-12)
        assert_allclose(other.span * np.abs(GAINS), plain.span, rtol=1e-12)


def test_commands_exceed_the_limits_by_half_the_backlash_in_any_unit(tmp_path):
    width = 4e-4
    metres = loaded(np.ones(6), tmp_path, learned=True, width=width)
    motors = loaded(GAINS, tmp_path, learned=True, width=width)
    found = []
    for model, gains in ((metres, np.ones(6)), (motors, GAINS)):
        low, high = workflow.path_limits(model).commands
        found.append(np.sort([low * gains, high * gains], axis=0))
        described = workflow.path_limits(model, within_fit=False).commands
        ends = np.sort([described[0] * gains, described[1] * gains], axis=0)
        assert_allclose(ends, [LIMITS.q_min, LIMITS.q_max], rtol=1e-9)
        of_log = np.ravel(model.hysteresis_.width)
        if gains is GAINS:
            of_log = np.degrees(of_log)
        assert_allclose(widths_in_log(model), of_log, rtol=1e-12)
    assert_allclose(found[1], found[0], rtol=1e-9, atol=1e-12)
    inner = workflow.path_limits(metres)
    assert_allclose(found[0], [inner.q_min - 0.5 * width, inner.q_max + 0.5 * width])
    given = {"q_min": np.full(6, -0.003), "q_max": np.full(6, 0.002)}
    asked = workflow.path_limits(metres, **given).commands
    assert_allclose(asked, [*given.values()], rtol=1e-9)


@pytest.mark.parametrize("learned", [False, True])
def test_limits_beside_the_log_hold_what_a_domain_prefers(tmp_path, learned):
    given = {"q_min": np.full(6, 0.0005), "q_max": np.full(6, 0.002)}
    model = loaded(np.ones(6), tmp_path, learned=learned)
    domain = Domain(model, workflow.path_limits(model, **given))
    for q in (domain.preferred, domain.postures(50)):
        assert ((q >= 0.0005) & (q <= 0.002)).all()


def pulled(metres):
    """Return the common pull of the tendons of each segment (N, 2) [m]."""
    return metres.reshape(-1, 2, 3).sum(axis=2)


@pytest.mark.parametrize("learned", [False, True])
def test_the_domain_is_that_of_metres(tmp_path, learned):
    motors = loaded(GAINS, tmp_path, learned=learned)
    domain = Domain(motors, workflow.path_limits(motors))
    plain = loaded(np.ones(6), tmp_path, learned=learned)
    reference = Domain(plain, workflow.path_limits(plain))
    assert_allclose(domain.preferred * GAINS, reference.preferred, rtol=1e-9, atol=1e-12)
    assert_allclose(domain.rest * GAINS, reference.rest)
    projector = GAINS[:, None] ** -1 * domain.bending * GAINS
    assert_allclose(projector, reference.bending, rtol=0, atol=1e-9)
    assert_allclose(pulled(reference.bending), 0.0, atol=1e-9)
    limits = domain.limits
    balanced = domain.postures(2000)
    assert ((balanced >= limits.q_min) & (balanced <= limits.q_max)).all()
    assert 0.8 < len(balanced) / len(reference.postures(2000)) < 1.25
    metres = balanced * GAINS
    high = np.sort([limits.q_min * GAINS, limits.q_max * GAINS], axis=0)[1]
    slack = (high - metres).reshape(-1, 2, 3).min(axis=2)
    # Balanced, or the slackest tendon of the segment is at its limit.
    assert_allclose(np.minimum(np.abs(pulled(metres)), slack), 0.0, atol=1e-12)
    q, tips = domain.sample
    assert ((q >= limits.q_min) & (q <= limits.q_max)).all()
    assert_allclose(tips_at(motors, q), tips)
    size = np.ptp(reference.sample[1], axis=0)
    assert_allclose(np.ptp(tips, axis=0), size, rtol=0.25)
    if learned:
        assert_allclose(pulled(q * GAINS - reference.preferred), 0.0, atol=1e-12)
        assert (domain_distance(motors, q) <= 1.0).all()


@pytest.mark.slow
@pytest.mark.parametrize("learned", [False, True])
def test_gains_in_another_unit_draw_the_same_domain(tmp_path, learned):
    """Without a change of direction the same numbers are drawn, and the track is the same."""
    found = []
    for gains in (np.ones(6), np.abs(GAINS)):
        model = loaded(gains, tmp_path, learned=learned)
        domain = Domain(model, workflow.path_limits(model))
        drawn = [domain.sample[0], domain.postures(50), domain.preferred]
        found.append([q * gains for q in drawn])
    for ours, theirs in zip(*found, strict=True):
        assert_allclose(theirs, ours, rtol=0, atol=1e-9)


def columns(folder):
    with open(folder / "track.csv", encoding="utf-8") as lines:
        table = [*csv.DictReader(lines)]
    return {name: [row[name] for row in table] for name in table[0]}


def numbers(table, names):
    return np.column_stack([np.array(table[name], float) for name in names])


@pytest.mark.slow
def test_a_track_in_degrees_is_one_in_metres(tmp_path):
    """From the robot's place to the path, within speeds, in the unit and signs of the log."""
    phase = np.linspace(0.0, 0.5, 8)[:, None]
    ring = 2.0 * np.pi / 3.0 * np.arange(3)
    way = 0.002 * np.hstack([np.cos(ring + phase), np.cos(ring - phase)])
    path = trajectories.Trajectory(0.05 * np.arange(8), tips_at(loaded(np.ones(6), tmp_path), way))
    lengths = []
    # The speed decides how long the way to the path takes, then the acceleration.
    for gains, most in ((np.full(6, -1e-3), 2.0), (GAINS, 0.1)):
        model = loaded(gains, tmp_path)
        limits = replace(workflow.path_limits(model), ddq_max=most / np.abs(gains))
        start = np.array([1.0, -2.0, 1.0, 0.5, 0.0, -0.5]) * 1e-3
        out = tmp_path / f"track{len(lengths)}"
        report = workflow.track_path(model, path, out, limits=limits, start=start / gains)
        table = columns(out)
        n_lead = report.record.lead_in
        assert table["status"] == ["LEAD_IN"] * n_lead + ["CONVERGED"] * 8
        # The numbers of the file, in the unit of the log, whose sign is that of the gain.
        unit = np.pi / 180.0 if model.description_.log.q_unit == "deg" else 1.0
        q = numbers(table, COLUMNS) * unit * np.abs(gains)
        assert_allclose(q[0], start, rtol=0, atol=1e-9)
        lead = np.diff(q[: n_lead + 1], axis=0, prepend=q[:1]) / 0.05
        speed, change = np.abs(lead).max(), np.abs(np.diff(lead, axis=0)).max() / 0.05
        assert 0.6 < max(speed / 0.02, change / most) <= 1.0 + 1e-6
        tips = 1e-2 * numbers(table, "xyz")
        assert_allclose(tips[n_lead:], path.x, rtol=0, atol=1e-4)
        assert_allclose(tips, tips_at(model, q / gains), rtol=0, atol=1e-9)
        errors = 1e-2 * numbers(table, ["error"])[n_lead:, 0]
        assert_allclose(errors, np.linalg.norm(tips[n_lead:] - path.x, axis=1), atol=1e-9)
        assert report.record.errors.mean == pytest.approx(errors.mean(), abs=1e-9)
        assert "error in cm; t in s" in report.plain()
        lengths.append(n_lead)
    assert min(lengths) > 1


# ---------------------------------------------------------------- evaluation


def measured(model, gains, motions, far):
    """Return postures, every so many of them far out, of a robot that misses its model by 1 mm."""
    rng = np.random.default_rng(0)
    ring = 2.0 * np.pi / 3.0 * np.arange(3)
    bends = rng.uniform(-0.8, 0.8, (len(motions), 2, 2))
    q = -0.004 * (bends @ np.stack([np.cos(ring), np.sin(ring)])).reshape(-1, 6)
    q[::far] *= 2.5
    x = model.predict(q / gains) + 1e-3 * rng.standard_normal((len(q), 3))
    return q / gains, x


def test_an_evaluation_counts_rows_whatever_the_names_and_order_of_motions(tmp_path):
    model = loaded(GAINS, tmp_path, learned=True)
    q, x = measured(model, GAINS, MOTIONS, far=4)
    errors = np.linalg.norm(model.predict(q) - x, axis=1)
    inside = model.in_domain(q)
    assert 0.5 < inside.mean() < 0.9
    names = np.array([*"zaqmk"])[MOTIONS]
    order = np.random.default_rng(1).permutation(len(q))
    plain = workflow.evaluate_log(model, Log(q, x, MOTIONS), force=True).record
    other = workflow.evaluate_log(model, Log(q[order], x[order], names[order]), force=True).record
    assert {*other.motions} == {*"zaqmk"}
    for k, name in enumerate("zaqmk"):
        rows = k == MOTIONS
        for found in (plain.motions[str(k)], other.motions[name]):
            assert found.rows == LENGTHS[k]
            assert found.mean == pytest.approx(errors[rows].mean())
            assert found.p95 == pytest.approx(np.percentile(errors[rows], 95))
            assert found.share_in_domain == pytest.approx(inside[rows].mean())
    assert plain.all.mean == pytest.approx(errors.mean())
    assert vars(other.all) == pytest.approx(vars(plain.all), nan_ok=True)
    # The table has millimetres and percent, largest means first.
    text = workflow.evaluate_log(model, Log(q, x, names), force=True).plain()
    rows = [line.split("|")[1:-1] for line in text.splitlines() if line.startswith("| ")]
    table = {cells[0].strip(): [cell.strip() for cell in cells[1:]] for cells in rows}
    assert table["all rows"][1] == f"{1e3 * errors.mean():.2f}"
    assert table["all rows"][5] == f"{100.0 * inside.mean():.0f}"
    means = [float(table[name][1]) for name in table if name in "zaqmk"]
    assert len(means) == 5
    assert means == sorted(means, reverse=True)


def test_a_motion_is_fitted_if_half_of_its_rows_are_whatever_its_name(tmp_path):
    model = loaded(GAINS, tmp_path, learned=True)
    motions = np.repeat(np.arange(5), 5 * LENGTHS)
    q, x = measured(model, GAINS, motions, far=len(motions))
    fitted = np.arange(150) % 5 < 1 + motions % 3  # 1 to 3 of 5 rows
    model.fit(q[fitted], x[fitted])
    expected = fitted | (motions == 2)
    for names in (motions, np.array([*"zaqmk"])[motions], 10 - motions):
        assert_array_equal(fitted_rows(model, q, x, names), expected)


# ---------------------------------------------------------------- comparison, verification


def swings(n_motions=6, n=30):
    """Return balanced commands [m] along smooth motions, and the motion of every row."""
    rng = np.random.default_rng(4)
    ring = 2.0 * np.pi / 3.0 * np.arange(3)
    phase = np.linspace(0.0, 4.0, n)[:, None]
    q = []
    for _ in range(n_motions):
        way = rng.standard_normal((2, 2)) @ np.stack([np.cos(ring), np.sin(ring)])
        q.append(0.0015 * (np.sin(phase) * way.ravel() + np.sin(2.0 * phase) * way[::-1].ravel()))
    return np.concatenate(q), np.repeat(np.arange(n_motions), n)


@pytest.mark.slow
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_comparison_does_not_depend_on_units_and_names(tmp_path, sign):
    """Motors for metres, names for numbers of motions (in the same order), a later clock."""
    q, motions = swings(4, 15)
    rng = np.random.default_rng(5)
    with torch.no_grad():
        x = PLAIN(torch.from_numpy(q)).numpy() + 30.0 * q[:, :3] ** 2
    x += 1e-4 * rng.standard_normal(x.shape)
    names = np.array(["m0", "m1", "m5", "mz"])[motions]
    settings = FitSettings(n_folds=2, auto=False, hysteresis=0.0)
    found = []
    for gains, labels in ((np.ones(6), motions), (sign * np.abs(GAINS), names)):
        chain = ConstantCurvatureChain(**RADII, gains=gains)
        robot = robots.RobotDescription("r", chain, ("rest_bends", "base"), None)
        log = Log(q / gains, x, labels, time=0.1 * np.arange(60.0) + 1e3 * (sign < 0.0))
        rows = checked(log, chain, base_is_free=True)
        mechanical = mechanical_of(robot, rows, "linear")
        found.append(compare(rows, robot, settings, mechanical, n_jobs=1))
    ours, theirs = found
    assert_array_equal(ours.fold, theirs.fold)
    assert all(len({*ours.fold[motions == k]}) == 1 for k in range(4))  # whole motions
    assert_allclose(theirs.distances_from_others, ours.distances_from_others, rtol=1e-6, atol=1e-9)
    assert ours.names == theirs.names
    for name, error, other in zip(ours.names, ours.distances, theirs.distances, strict=True):
        if sign < 0.0 and "ELM" in name:
            continue  # its random features are other ones of mirrored inputs
        # Searches of the calibration end within 1e-8 of its unit.
        assert_allclose(other, error, rtol=0, atol=1e-6, err_msg=name)


def backlash(q):
    with torch.no_grad():
        return (
            PLAIN(torch.from_numpy(Hysteresis.backlash(6e-4).apply(q)[0])).numpy() + 0.1 * q[:, :3]
        )


def moved(q):
    with torch.no_grad():
        return PLAIN(torch.from_numpy(q)).numpy() + 0.1 * q[:, :3] + [0.004, -0.003, 0.001]


@pytest.mark.parametrize(("fault", "cause"), [(backlash, "backlash"), (moved, "moved base")])
def test_the_cause_of_an_error_does_not_depend_on_units(tmp_path, fault, cause):
    """Of the log, in motors that turn the other way, and of the clock, whose periods differ."""
    q, _ = swings(1, 60)
    t = np.cumsum(0.05 + 0.05 * (np.arange(60) % 3))
    promise = {"at_rows": 1e-4, "per_distance": 0.0, "p95": 2.0}
    notes = {"saved": "h", "promise": promise}
    found = []
    for gains in (np.ones(6), np.full(6, -2e-3)):
        model = loaded(gains, tmp_path, learned=True)
        model.described(replace(model.description_, training=notes))
        log = model.description_.log
        x = fault(q)
        table = np.column_stack([t, log.to_log(q / gains), 100.0 * x, 100.0 * x])
        head = ",".join(["t", *log.q, *"xyz", "target_x", "target_y", "target_z", "status"])
        lines = [",".join([*map(repr, map(float, row)), "CONVERGED"]) for row in table]
        (tmp_path / "track.csv").write_text("\n".join([head, *lines]))
        some = np.append(np.arange(20), np.arange(20, 60, 4))  # the camera gets slower
        later = Log(q[some] / gains, x[some], time=1e6 + t[some])
        for measured_log in (Log(q / gains, x), later):
            report = workflow.verify_track(model, tmp_path / "track.csv", measured_log)
            assert report.record.cause == cause
            found.append(report.record)
    for ours, theirs in (found[::2], found[1::2]):
        # Fits end where an iteration gains less than 1e-4 of the squared error.
        assert vars(theirs)["causes"] == pytest.approx(ours.causes, abs=1e-4)
        assert theirs.range == pytest.approx(ours.range, rel=1e-9)
        for name, part in ours.parts.items():
            assert vars(theirs.parts[name]) == pytest.approx(vars(part), rel=1e-6), name
    assert found[1].parts["path"].rows == 30  # of the track
    quarters = [found[0].parts[f"quarter {k}"].rows for k in (1, 2, 3, 4)]
    assert quarters == [15] * 4


# ---------------------------------------------------------------- paths


def test_a_scaled_path_keeps_its_times_and_its_centre():
    path = trajectories.spiral([0.1, 0.0, 0.5], (0.05, 0.1), duration=1.0, dt=0.1)
    half = scaled_path(path, 0.5)
    assert_array_equal(half.t, path.t)
    assert_allclose(np.ptp(half.x, axis=0), 0.5 * np.ptp(path.x, axis=0))
    middle = 0.5 * (path.x.min(axis=0) + path.x.max(axis=0))
    assert_allclose(0.5 * (half.x.min(axis=0) + half.x.max(axis=0)), middle)


def test_a_report_has_millimetres_and_percent_of_its_record():
    report = workflow.Report("r", {})
    entry = Errors.of(ERRORS)
    report.errors({"a": entry}, ("rows", "mean", "std", "median", "p95", "max"))
    cells = [cell.strip() for cell in report.plain().splitlines()[-1].split("|")[2:-1]]
    values = [entry.mean, entry.std, entry.median, entry.p95, entry.max]
    assert cells == ["30", *(f"{1e3 * value:.2f}" for value in values)]
    assert entry.median == np.median(ERRORS)
    assert replace(entry, max=np.nan).p95 == np.percentile(ERRORS, 95)
