"""The check of a log finds planted mistakes, names them, and finds nothing in clean logs."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest
import torch

from hybridkin import ConstantCurvatureChain, app, choose_rows, robots
from hybridkin.datasets import Log, load_armlab, load_ftdcr, load_trunk

CHAIN = ConstantCurvatureChain([0.0055, 0.005, 0.006], lengths=[0.06, 0.065, 0.06], routing="base")
NAMES = tuple("abcdefghi")
ANGLES = 2 * np.pi / 3 * np.arange(3)


def balanced(n_motions=12, n=20, seed=0):
    """Changes of the nine tendons of CHAIN, motion by motion, from rest."""
    rng, u = np.random.default_rng(seed), np.stack([np.cos(ANGLES), np.sin(ANGLES)])
    s, motions = np.linspace(0.0, 4.0, n)[:, None, None], []
    for _ in range(n_motions):
        way = 0.003 * rng.standard_normal((3, 3, 2)) @ u
        motions.append((way[0] + np.sin(s) * way[1] + np.sin(2 * s) * way[2]).reshape(n, 9))
    return np.concatenate(motions)


Q = balanced()


def measured(q=Q, **changes):
    """A simulated log of a robot like CHAIN, its radii and lengths 4 % off."""
    truth = ConstantCurvatureChain(1.04 * CHAIN.radii, lengths=0.96 * CHAIN.lengths, routing="base")
    x = truth(torch.from_numpy(q)).numpy()
    x = x + 1e-4 * np.random.default_rng(1).standard_normal(x.shape)
    log = {"q": q.copy(), "x": x, "groups": np.arange(len(q)) // 20, "q_names": NAMES}
    return Log(**{**log, "time": 0.1 * np.arange(len(q)), **changes})


def findings(log, chain=CHAIN, **options):
    """The findings, without the note that tendons are in balance, as all of them are here."""
    report = app.check_log(log, chain=chain, **options)
    return [f for f in report.findings if f.kind != "no motion"]


def with_rows(column, rows, value):
    """A log with other values of some rows of q or x."""
    log = measured()
    values = getattr(log, column[0])
    if len(column) > 1:
        values = values[:, int(column[1])]
    values[rows] = values[rows][0] if value is None else value
    return log


def copied(shift):
    log = measured()
    log.q[200:220], log.x[200:220] = log.q[20:40], log.x[20:40] + shift
    return log


def late(rows):
    log = measured()
    return replace(log.rows(slice(rows, None)), x=log.x[:-rows])


X = measured().x
STILL = slice(70, 85)
SHIFT = 0.003 * np.eye(9)[7]
WAY = np.linspace(0.0, 1.0, len(Q))[:, None]
# The log, the finding, its rows or None, and words of it.
OF_COLUMNS = {
    "frozen tip": (with_rows("x", STILL, None), "error", range(70, 85), "the tip"),
    "frozen tip, one coordinate": (
        with_rows("x1", STILL, None),
        "warning",
        range(70, 85),
        "'x[1]'",
    ),
    "frozen actuator": (with_rows("q4", STILL, None), "warning", range(70, 85), "'e'"),
    "invalid": (with_rows("x2", [3, 4, 90], np.nan), "error", [3, 4, 90], "rows 3-4, 90"),
    "constant": (with_rows("q2", slice(None), 0.001), "warning", None, "never move: 'c'"),
    "constant, coordinate": (with_rows("x0", slice(None), 0.0), "warning", None, "'x[0]'"),
    "constant, tip": (with_rows("x", slice(None), 0.0), "error", None, "never change"),
    "duplicates": (copied(0.0), "warning", range(200, 220), "20 of them in another motion"),
    # Pairs 0.3 mm apart: each has one degree of freedom, 0.3 mm / sqrt(2).
    "same command": (
        copied([3e-4, 0, 0]),
        "note",
        None,
        "40 rows have the same command as another row, as in a motion out and back; their tips "
        "differ by 0.212 mm rms",
    ),
    "jumps": (with_rows("x", [110], [0.3, 0.0, 0.0]), "warning", [110, 111], "soft_l1"),
    "time": (measured(time=0.1 * np.arange(240) * (np.arange(240) != 105)), "warning", [105], ""),
    "time, run": (
        measured(time=0.1 * np.arange(240) * (np.arange(240) != 100), runs=np.zeros(240)),
        "warning",
        [100],
        "",
    ),
    "time, gap": (
        measured(time=0.1 * np.arange(240) + 5.0 * (np.arange(240) > 104)),
        "warning",
        [105],
        "up to 5.1 s",
    ),
    "motions": (measured(groups=None), "warning", None, "--groups"),
    "motions, few": (measured(groups=np.arange(240) // 100), "warning", None, "only 3 motions"),
    "motions, single rows": (measured(groups=np.arange(240)), "warning", None, "random split"),
    "rows": (measured().rows(slice(0, 20)), "warning", None, "only 20 rows"),
    "same column": (measured(Q[:, [*range(8), 7]], x=X), "warning", None, "'h' and 'i'"),
    "drift": (measured(x=X + (WAY > 0.4) * [0.02, 0.0, 0.01]), "warning", None, "camera"),
    "lag": (late(3), "warning", None, "3 rows behind q"),
}


@pytest.mark.parametrize("case", OF_COLUMNS)
def test_mistakes_in_columns(case):
    log, severity, rows, words = OF_COLUMNS[case]
    same_kind = [f for f in findings(log) if f.kind == case.split(",")[0]]
    finding = next(f for f in same_kind if words in f.message + f.advice)
    assert finding.severity == severity
    if rows is not None:
        assert finding.rows.tolist() == [*rows]


def kinds_and_rows(log):
    """What a check without a chain finds, without the words."""
    found = app.check_log(log).findings
    return [(f.kind, f.severity, f.rows.tolist()) for f in found if f.kind != "no motion"]


def renamed(log):
    if log.groups is None:
        return log
    return replace(log, groups=np.array([f"motion {chr(110 - g % 13)}{g}" for g in log.groups]))


ELSEWHERE = {
    "names of motions, clock": lambda log: replace(renamed(log), time=1e3 * log.time + 1e6),
    "zeros and origin": lambda log: replace(log, q=log.q + 0.05, x=log.x - 2.0),
    "unit of an actuator": lambda log: replace(log, q=log.q * np.where(np.arange(9) == 4, 57.0, 1)),
}


@pytest.mark.parametrize("change", ELSEWHERE)
@pytest.mark.parametrize("case", [case for case in OF_COLUMNS if "coordinate" not in case])
def test_what_is_found_does_not_depend_on_names_zeros_and_units(case, change):
    log = OF_COLUMNS[case][0]
    assert kinds_and_rows(ELSEWHERE[change](log)) == kinds_and_rows(log)


def test_pauses_between_motions_are_no_gaps():
    """Also where each motion has a clock of its own."""
    within = 0.1 * np.tile(np.arange(20), 12)
    pauses = within + 60.0 * (np.arange(240) // 20)
    for time in (pauses, within):
        assert not [f for f in findings(measured(time=time), None) if f.kind == "time"]
    one_run = measured(time=within, runs=np.zeros(240))
    (late,) = (f for f in findings(one_run, None) if f.kind == "time")
    assert late.rows.tolist() == [*range(20, 240, 20)]
    # Pauses do not change what a usual step is: 0.1 s in motions of two rows.
    short = measured(time=0.1 * np.arange(240) + 60.0 * (np.arange(240) // 2))
    short = replace(short, groups=np.arange(240) // 2)
    assert not [f for f in findings(short, None) if f.kind == "time"]
    short.time[101:] += 2.0
    (gap,) = (f for f in findings(short, None) if f.kind == "time")
    assert gap.rows.tolist() == [101]
    assert "up to 2.1 s; the usual step is 100 ms" in gap.message


def test_a_usual_step_is_one_within_motions():
    """Poses far from each other, and some pairs of near ones, in one of which the tip jumps."""
    poses = np.random.default_rng(0).standard_normal((60, 4))
    rows = np.sort(np.append(np.arange(60), np.arange(20)))
    second = np.append(False, np.diff(rows) == 0)
    q = poses[rows] + 0.001 * second[:, None]
    x = q[:, :3].copy()
    x[21] += 0.05  # the second row of pair 10
    (jump,) = (f for f in app.check_log(Log(q, x, rows)).findings if f.kind == "jumps")
    assert jump.rows.tolist() == [21]


def test_a_lag_is_one_within_motions():
    """Each tip is that of the command three rows before, and exactly linear in it."""
    rng = np.random.default_rng(0)
    q = rng.standard_normal((12, 23, 4)).cumsum(axis=1)
    x = q[:, :-3] @ rng.standard_normal((4, 3))
    log = Log(q[:, 3:].reshape(-1, 4), x.reshape(-1, 3), np.repeat(np.arange(12), 20))
    (finding,) = (f for f in app.check_log(log).findings if f.kind == "lag")
    assert "3 rows behind q" in finding.message
    assert float(re.search(r"is (\S+) mm with this lag", finding.message)[1]) < 1e-9


@pytest.mark.parametrize(("routing", "ratio", "radius"), [("segment", 600, 6), ("base", 500, 18)])
def test_strokes_are_compared_with_the_radii_that_they_bend(routing, ratio, radius):
    """From the base the last tendon bends all segments: its radius counts three times."""
    chain = ConstantCurvatureChain([0.004, 0.005, 0.006], lengths=[0.06] * 3, routing=routing)
    bends = np.outer(np.sin(np.linspace(0.3, 0.5 * np.pi, 40)), [0.4, 0.5, 0.6])
    q = np.hstack([0.0 * bends, bends, 0.0 * bends]) @ chain._readings().numpy().T
    x = chain(torch.from_numpy(q)).numpy()
    assert not app.check_log(Log(q, x), chain=chain).errors
    (finding,) = app.check_log(Log(1e3 * q, x), chain=chain).errors
    text = f"stroke is {ratio * radius} mm, {ratio} times the radii ({radius} mm)"
    assert text in finding.message


def turned(order):
    return measured(Q[:, order], x=X, q_names=tuple(NAMES[i] for i in order))


WIDE = ConstantCurvatureChain(2 * CHAIN.radii, lengths=CHAIN.lengths, routing="base")
CLOCKWISE = CHAIN.with_geometry(angles=-CHAIN.angles)
MOUNTED = CHAIN.with_geometry(base=torch.diag(torch.tensor([-1.0, -1.0, 1.0, 1.0]).double()))
FIXED = {"base_is_free": False}
SIGN = np.where(np.arange(9) == 4, -1.0, 1.0)
# The log, the chain, options, and the kind and words of the only finding.
OF_GEOMETRY = {
    "one sign": (measured(SIGN * Q, x=X), CHAIN, {}, "sign", "q_sign = [1, 1, 1, 1, -1, 1"),
    "all signs": (measured(-Q, x=X), CHAIN, FIXED, "sign", "q_sign = -1"),
    "signs as read": (measured(-Q, x=X, q_sign=-1), CHAIN, FIXED, "sign", "set q_sign = 1 in"),
    "half turn": (measured(-Q, x=X), CHAIN, {}, "sign", "rotated by"),
    "only lengthened": (measured(np.abs(Q), x=X), CHAIN, {}, "sign", "only lengthened"),
    "clockwise": (measured(), CLOCKWISE, {}, "numbering", "clockwise = "),
    "clockwise, fixed base": (measured(), CLOCKWISE, FIXED, "numbering", "clockwise = "),
    "axes": (measured(x=X[:, [1, 2, 0]]), CHAIN, FIXED, "axes", "rotated."),
    "left-handed axes": (measured(x=X[:, [1, 0, 2]]), CHAIN, FIXED, "axes", "mirrored."),
    "diameters": (measured(), WIDE, {}, "size", "1.9 times as large"),  # 2 / 1.04
    "offset": (measured(Q + SHIFT, x=X), CHAIN, {}, "offset", "'h' is off by about 3 mm"),
    "drift": (measured(Q + WAY * SHIFT, x=X), CHAIN, {}, "drift", "'h' drifts"),
    "whole lengths": (measured(Q + 0.06, x=X), CHAIN, {}, "geometry", "straight robot"),
}


@pytest.mark.parametrize("case", OF_GEOMETRY)
def test_mistakes_against_the_chain(case):
    log, chain, options, kind, words = OF_GEOMETRY[case]
    (finding,) = findings(log, chain, **options)
    assert finding.kind == kind
    assert words in f"{finding.message} {finding.advice}"


@pytest.mark.slow
def test_only_pauses_within_a_motion_are_gaps():
    """Whatever the clock and its unit; between motions the robot may rest."""
    steps = np.full(240, 0.1)
    steps[20::20] = 7.0
    for unit, first in ((1.0, 0.0), (60.0, -50.0)):
        log = measured(time=first + unit * np.cumsum(steps))
        assert findings(log) == []
        names = np.array([*"lkjihgfedcba"])[log.groups]  # whatever motions are called
        assert findings(replace(log, groups=names)) == []
        (finding,) = findings(replace(log, groups=log.groups // 2))
        assert finding.kind == "time"
        assert finding.rows.tolist() == [*range(20, 240, 40)]
    # Nor do they count as usual steps, where every motion is short.
    steps = np.where(np.arange(240) % 2, 0.1, 7.0)
    steps[101] = 3.0
    found = findings(measured(time=np.cumsum(steps), groups=np.arange(240) // 2))
    assert [f.rows.tolist() for f in found if f.kind == "time"] == [[101]]


@pytest.mark.parametrize("base_is_free", [True, False])
@pytest.mark.parametrize(
    "order",
    [
        [0, 1, 2, 4, 3, 5, 6, 7, 8],  # two columns of a segment
        [6, 7, 8, 3, 4, 5, 0, 1, 2],  # tip first
        [4, 0, 8, 3, 7, 1, 6, 2, 5],
    ],
)
def test_columns_in_another_order_are_named(order, base_is_free):
    log = turned(order)
    (finding,) = findings(log, base_is_free=base_is_free)
    assert finding.kind == "order"
    listed = json.loads(re.search(r"set q = (\[[^]]*\])", finding.advice)[1])
    again = measured(log.q[:, [log.q_names.index(name) for name in listed]], x=X)
    assert findings(again, base_is_free=base_is_free) == []
    if not base_is_free:
        assert tuple(listed) == NAMES


@pytest.mark.parametrize(
    ("q", "x", "units", "advice"),
    [
        (1e3, 1e3, {"q": "m", "x": "m"}, ['q_unit = "mm"', 'x_unit = "mm"']),
        (1e2, 1.0, {"q": "m", "x": "mm"}, ['q_unit = "cm"']),
        (1.0, 1e3, {"q": "mm", "x": "m"}, ['x_unit = "mm"']),
        (1e-3, 1e-3, {"q": "mm", "x": "mm"}, ['q_unit = "m"', 'x_unit = "m"']),
        (1.0, 1e-2, {"q": "mm", "x": "mm"}, ["`x_unit`"]),
    ],
)
def test_units_that_cannot_be(q, x, units, advice):
    errors = findings(measured(q * Q, x=x * X, file_units=units))
    assert [f.kind for f in errors] == ["units"] * len(advice)
    for finding, wanted in zip(errors, advice, strict=True):
        assert wanted in finding.advice


@pytest.mark.parametrize(("radius", "length"), [(1, 1e3), (1e3, 1e3), (1e3, 1)])
def test_millimetres_in_the_description_are_named_instead_of_the_log(radius, length):
    geometry = {"lengths": length * CHAIN.lengths, "routing": "base"}
    with pytest.warns(UserWarning, match="looks like millimetres"):
        chain = ConstantCurvatureChain(radius * CHAIN.radii, **geometry)
    (finding,) = findings(measured(), chain)
    assert finding.kind == "units"
    assert "the description in metres" in finding.advice


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_logs_in_counts_are_checked_in_metres(sign):
    """Counts about 2050 at rest; their zeros have the sign of q after `q_sign`."""
    zeros = sign * (2050.0 + 20.0 * np.arange(9))
    counts = measured(Q / 2.7e-5 + zeros, x=X, units={"q": "1", "x": "m"})

    def chain(zeros):
        zeros = torch.from_numpy(zeros)
        return CHAIN.with_geometry(gains=2.7e-5 * CHAIN.gains, actuator_zeros=zeros)

    assert findings(counts, chain(zeros)) == []
    (finding,) = findings(counts, chain(-zeros))
    assert (finding.kind, finding.severity) == ("sign", "error")
    flipped = measured(-Q / 2.7e-5 + zeros, x=X, units={"q": "1", "x": "m"})
    wanted = findings(measured(-Q, x=X), **FIXED)
    (finding,) = findings(flipped, chain(zeros), **FIXED)
    assert finding.message == wanted[0].message


def test_clean_logs_pass():
    report = app.check_log(measured(), chain=CHAIN)
    (balance,) = report.findings  # what the log cannot show is no fault
    assert (balance.kind, balance.severity) == ("no motion", "note")
    assert "along +1 a +1 b +1 c; +1 " in balance.message
    assert report.ok
    assert "240 rows, 12 motions, 9 actuators" in str(report)
    assert findings(measured(-Q, x=X), MOUNTED) == []  # mounted upside down
    still = measured()
    still.q[STILL], still.x[STILL] = still.q[70], still.x[70]
    assert not any(f.kind == "frozen tip" for f in findings(still))


@pytest.mark.parametrize(
    ("name", "load"),
    [("ftdcr_v4", load_ftdcr), ("ftdcr_v4_elastic", load_ftdcr), ("armlab_3cable", load_armlab)],
)
def test_recordings_of_real_robots_raise_no_false_alarm(data_home, name, load):
    robot, data = robots.read_description(f"examples/robots/{name}.toml"), load(data_home)
    log = Log(data.q[::5], data.x[::5], data.groups[::5])
    kinds = {f.kind for f in findings(log, robot.chain, base_is_free="base" in robot.calibrate)}
    assert kinds <= {"jumps"}


def test_a_report_is_json_and_can_accept_a_finding():
    log = with_rows("x", STILL, None)
    log.q[0, 0] = np.nan
    report = app.check_log(replace(log, line=np.arange(240) + 2), drop_invalid=False)
    record = json.loads(json.dumps(report.to_dict()))
    assert record["n_rows"] == 240
    assert "(line 2)" in record["findings"][0]["message"]
    assert report.summary().startswith("2 errors")
    accepted = report.accepting("frozen tip")
    assert [f.kind for f in accepted.errors] == ["invalid"]
    assert accepted.findings[-1].severity == "note"


def test_the_chain_must_have_as_many_actuators():
    with pytest.raises(ValueError, match="9 actuators"):
        app.check_log(Log(np.ones((3, 3)), np.ones((3, 3))), chain=CHAIN)


def test_few_rows_of_a_plan_name_no_wrong_zero():
    """25 rows where the nominal model errs most looked like a chamber that is 2 cm off."""
    data = load_trunk()
    chain = robots.bionic_handling_assistant()
    pool = np.random.default_rng(11).choice(len(data.q), 400, replace=False)
    rows = pool[choose_rows(chain, data.q[pool], 25)[0]]
    report = app.check_log(Log(data.q[rows], data.x[rows]), chain=chain, base_is_free=True)
    assert not {f.kind for f in report.findings} & {"offset", "drift", "zeros"}


def test_few_rows_show_a_zero_that_is_far_off():
    few = slice(None, None, 8)
    clear = measured(Q + SHIFT, x=X).rows(few)
    (finding,) = [f for f in findings(clear) if f.kind == "offset"]
    assert "'h' is off by about 3 mm" in finding.message
