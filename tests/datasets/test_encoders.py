"""Encoders that wrap, lose turns, or read whole turns off: random robots, periods and rows."""

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose
from simulated_log import run

from hybridkin import ConstantCurvatureChain
from hybridkin.app import check_log
from hybridkin.datasets import Log, load_log
from hybridkin.datasets.encoders import encoder_faults, given_periods, unwrapped

PERIODS = {"counts": (4096.0, 65536.0, 8192.0, 2.0**32), "deg": (360.0,), "rad": (2 * np.pi,)}


def clean(seed, *, smooth=True):
    """Readings of one to three segments over rows in time, tips with noise, and the period."""
    rng = np.random.default_rng(seed)
    n_segments = int(rng.integers(1, 4))
    n_rows = int(rng.integers(300, 900))
    unit = str(rng.choice([*PERIODS]))
    period = float(rng.choice(PERIODS[unit]))
    stroke = rng.uniform(0.1, 0.35) * period
    chain = ConstantCurvatureChain([0.01] * n_segments, lengths=[0.1] * n_segments, routing="base")
    knots = rng.uniform(-0.5, 0.5, (12, chain.n_actuators)) * stroke
    if smooth:
        t = np.linspace(0.0, 11.0, n_rows)
        q = np.column_stack([np.interp(t, np.arange(12.0), column) for column in knots.T])
    else:
        q = rng.uniform(-0.5, 0.5, (n_rows, chain.n_actuators)) * stroke
    if unit == "counts":
        q = np.round(q)
    x = chain(torch.from_numpy(q * 0.024 / stroke)).numpy()
    return rng, q, x + 2e-4 * rng.standard_normal(x.shape), unit, period


def faulty(kind, rng, q, period):
    """Return readings with a fault of a kind, and the rows that must be named."""
    bad = q.copy()
    column = int(rng.integers(q.shape[1]))
    amount = period * rng.choice([-1.0, 1.0])
    rows = np.zeros(0)
    if kind == "wrap":
        bad = np.mod(q, period)
    if kind == "turns":
        rows = [int(rng.integers(30, len(q) - 30))]
        bad[rows[0] :, column] += amount
    if kind == "glitch":
        rows = np.sort(rng.choice(np.arange(10, len(q) - 10), 3, replace=False))
        bad[rows, column] += amount
    return bad, column, rows


def tried(q, x, unit, unwrap=True):
    names = [f"m{k}" for k in range(q.shape[1])]
    periods = given_periods(unwrap, names, unit)
    same_run = np.ones(len(q) - 1, dtype=bool)
    return encoder_faults(q, x, same_run, periods), unwrapped(q, x, same_run, periods)


@pytest.mark.parametrize("kind", ["wrap", "turns", "glitch"])
@pytest.mark.parametrize("smooth", [True, False])
def test_a_fault_is_named_and_mended(kind, smooth):
    """Of 20 random logs; the period may be taken for a similar one in one or two of them."""
    right = 0
    for seed in range(20):
        rng, q, x, unit, period = clean(seed, smooth=smooth)
        bad, column, rows = faulty(kind, rng, q, period)
        before = bad.copy()
        faults, mended = tried(bad, x, unit)
        np.testing.assert_array_equal(bad, before, err_msg="the input stays")
        off = (mended - q) / period
        exact = np.abs(off - np.round(off[0])).max() < 1e-6
        exact &= np.ptp(off, axis=0).max() < 1e-6
        named = {fault.kind for fault in faults} == {kind}
        if kind != "wrap" and named:
            (fault,) = faults
            named = fault.column == column and [*fault.rows] == [*rows]
        right += named and exact
        # With the period of the encoder there is no doubt.
        mended = tried(bad, x, unit, period)[1]
        assert_allclose(np.ptp(mended - q, axis=0), 0.0, atol=1e-6 * period)
    assert right >= 17


@pytest.mark.parametrize("seed", range(30))
def test_clean_readings_have_no_faults(seed):
    _, q, x, unit, period = clean(seed, smooth=seed % 2 == 0)
    for unwrap in (True, period):
        faults, mended = tried(q, x, unit, unwrap)
        assert not faults
        np.testing.assert_array_equal(mended, q)


def test_commands_in_whole_turns_are_no_faults():
    """Held postures of whole turns, which a tip follows late: the adverse case."""
    alarms = 0
    for seed in range(60):
        rng = np.random.default_rng(seed)
        chain = ConstantCurvatureChain([0.01] * 2, lengths=[0.1] * 2, routing="base")
        turn = float(rng.choice([360.0, 1000.0, 1024.0, 4096.0]))
        q = np.repeat(rng.integers(-2, 3, (30, 6)) * turn, int(rng.integers(3, 15)), axis=0)
        late = q.copy()
        for k in range(1, len(q)):
            late[k] = late[k - 1] + rng.uniform(0.1, 1.0) * (q[k - 1] - late[k - 1])
        x = chain(torch.from_numpy(late * 0.01 / turn)).numpy()
        x += 2e-4 * rng.standard_normal(x.shape)
        for unit in ("counts", "deg"):
            alarms += bool(tried(q, x, unit)[0])
    assert alarms <= 2


def test_two_faults_of_one_log():
    _, q, x, unit, period = clean(4)
    bad = q.copy()
    bad[100:, 0] += period
    bad[[50, 180], 1] -= period
    faults, mended = tried(bad, x, unit)
    assert {(fault.kind, fault.column) for fault in faults} == {("turns", 0), ("glitch", 1)}
    assert_allclose(np.ptp(mended - q, axis=0), 0.0, atol=1e-6 * period)


def written(tmp_path, q, x):
    path = tmp_path / "log.csv"
    header = ",".join([*(f"m{k}" for k in range(q.shape[1])), "x", "y", "z"])
    np.savetxt(path, np.column_stack([q, x]), "%.9g", ",", header=header, comments="")
    return path


def columns(q, **options):
    names = [f"m{k}" for k in range(q.shape[1])]
    return {"q": names, "x": ["x", "y", "z"], "q_unit": "1", **options}


def test_load_log_unwraps_on_request(tmp_path):
    rng = np.random.default_rng(1)
    q = np.round(300.0 * np.sin(np.outer(np.arange(400), rng.uniform(0.02, 0.05, 3))))
    chain = ConstantCurvatureChain([0.01], lengths=[0.1])
    x = chain(torch.from_numpy(q * 3e-5)).numpy() + 1e-4 * rng.standard_normal((400, 3))
    path = written(tmp_path, np.mod(q, 4096.0), x)
    for unwrap in (True, 4096, {"m0": 4096, "m1": 4096.0, "m2": 4096}):
        assert_allclose(load_log(path, **columns(q, unwrap=unwrap)).q, q)
    one = load_log(path, **columns(q, unwrap={"m1": 4096}, q_sign=-1)).q
    assert_allclose(one[:, 1], -q[:, 1])
    assert_allclose(one[:, 0], -np.mod(q[:, 0], 4096.0))
    assert_allclose(load_log(path, **columns(q)).q, np.mod(q, 4096.0))


@pytest.mark.parametrize("unwrap", [-4096, 0, np.nan, np.inf, "4096", {"m9": 4096}, {"m0": True}])
def test_other_periods_are_refused(tmp_path, unwrap):
    path = written(tmp_path, np.ones((3, 3)), np.ones((3, 3)))
    with pytest.raises(ValueError, match="`unwrap` must be true, a positive period"):
        load_log(path, **columns(np.ones((3, 3)), unwrap=unwrap))
    with pytest.raises(ValueError, match=r"`unwrap` must be the period .* in mm"):
        load_log(path, **columns(np.ones((3, 3)), unwrap=True, q_unit="mm"))


def checked(q, x, **options):
    units = {"q": "1", "x": "m"}
    chain = ConstantCurvatureChain([0.01], lengths=[0.1], gains=3e-5)
    log = Log(q, x, units=units, file_units=units, **options)
    return check_log(log, chain=chain)


def test_the_check_names_rows_and_amounts_and_nothing_else_of_the_columns():
    """A fault looks like wrong orders, signs and zeros; they are not advised."""
    rng = np.random.default_rng(1)
    q = np.round(300.0 * np.sin(np.outer(np.arange(400), rng.uniform(0.02, 0.05, 3))))
    chain = ConstantCurvatureChain([0.01], lengths=[0.1], gains=3e-5)
    x = chain(torch.from_numpy(q)).numpy() + 1e-4 * rng.standard_normal((400, 3))
    assert not checked(q, x).findings[:1] or "encoder" not in [
        f.kind for f in checked(q, x).findings
    ]
    cases = {
        "wrap": (
            np.mod(q, 4096.0),
            "error",
            "'q[2]' wrap: they start again after 4096",
        ),
        "turns": (q + 4096.0 * (np.arange(400) >= 250)[:, None] * [0, 1, 0], "error", "row 250 on"),
        "glitch": (q - 4096.0 * (np.arange(400) == 99)[:, None] * [0, 0, 1], "warning", "by -4096"),
    }
    for bad, severity, words in cases.values():
        report = checked(bad, x)
        kinds = {finding.kind for finding in report.findings}
        found = [finding for finding in report.findings if finding.kind == "encoder"]
        assert not kinds & {"order", "sign", "numbering", "units", "offset", "drift", "size"}
        assert words in " ".join(finding.message for finding in found)
        assert {finding.severity for finding in found} == {severity}
        assert "--unwrap 4096" in found[0].advice


def test_unwrap_from_the_command_line_and_the_description(tmp_path, capsys):
    rng = np.random.default_rng(1)
    q = np.round(300.0 * np.sin(np.outer(np.arange(400), rng.uniform(0.02, 0.05, 3))))
    chain = ConstantCurvatureChain([0.01], lengths=[0.1], gains=3e-5)
    x = 1e3 * (chain(torch.from_numpy(q)).numpy() + 1e-4 * rng.standard_normal((400, 3)))
    log = written(tmp_path, np.mod(q, 4096.0), x)
    robot = tmp_path / "r.toml"
    text = (
        '[[segment]]\nradius = 0.01\nlength = 0.1\ngain = 3e-5\n[log]\nq = ["m0", "m1", "m2"]\n'
        'x = ["x", "y", "z"]\nq_unit = "counts"\nx_unit = "mm"\n'
    )
    robot.write_text(text)
    code, out, _ = run(capsys, "describe", log, "--robot", robot)
    assert code == 1
    assert "start again after 4096" in " ".join(out.split())
    assert run(capsys, "describe", log, "--robot", robot, "--unwrap", "4096")[0] == 0
    assert run(capsys, "describe", log, "--robot", robot, "--unwrap")[0] == 0
    for value in ("true", "4096", "{ m0 = 4096, m1 = 4096, m2 = 4096 }"):
        robot.write_text(f"{text}unwrap = {value}\n")
        assert run(capsys, "describe", log, "--robot", robot)[0] == 0
    robot.write_text(f"{text}unwrap = -1\n")
    assert (
        "`unwrap` in [log] must be true or false"
        in run(capsys, "describe", log, "--robot", robot)[2]
    )


def test_zeros_that_are_a_turn_off_after_unwrap_are_named(tmp_path, capsys):
    """A motor stood at 4200 in the straight robot, which the wrapped readings call 104."""
    rng = np.random.default_rng(1)
    q = np.round(300.0 * np.sin(np.outer(np.arange(400), rng.uniform(0.02, 0.05, 3))))
    chain = ConstantCurvatureChain([0.01], lengths=[0.1], gains=3e-5)
    x = 1e3 * (chain(torch.from_numpy(q)).numpy() + 1e-4 * rng.standard_normal((400, 3)))
    log = written(tmp_path, np.mod(q + 4200.0, 4096.0), x)
    robot = tmp_path / "r.toml"
    text = (
        "[[segment]]\nradius = 0.01\nlength = 0.1\ngain = 3e-5\nzeros = [{0}, 104, 104]\n"
        '[log]\nq = ["m0", "m1", "m2"]\nx = ["x", "y", "z"]\nq_unit = "counts"\nx_unit = "mm"\n'
    )
    robot.write_text(text.format(4200))
    out = " ".join(run(capsys, "describe", log, "--robot", robot)[1].split())
    assert "`zeros` can then be whole turns off" in out
    unwrapped_log = ["describe", log, "--robot", robot, "--unwrap", "4096"]
    out = run(capsys, *unwrapped_log)[1]
    assert "add or subtract turns there" in " ".join(out.split())
    robot.write_text(text.format(4200 - 4096))
    code, out, _ = run(capsys, *unwrapped_log)
    assert code == 0
    assert "turns" not in out
