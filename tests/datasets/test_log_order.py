import json
import re
from dataclasses import replace

import numpy as np
import pytest
import torch

from hybridkin import ConstantCurvatureChain, datasets, robots
from hybridkin.datasets import Log, load_armlab, load_ftdcr

CHAIN = ConstantCurvatureChain([0.0055, 0.005, 0.006], lengths=[0.06, 0.065, 0.06], routing="base")
ANGLES = 2 * np.pi / 3 * np.arange(3)
NAMES = tuple("abcdefghi")


def check_log(log, **options):
    """Return the check without the note that tendons are in balance, as all of them are here."""
    report = datasets.check_log(log, **options)
    return replace(report, findings=tuple(f for f in report.findings if f.kind != "no motion"))


def balanced(n_motions=12, n=20, seed=0):
    """Changes of the nine tendons of CHAIN, motion by motion."""
    rng, u = np.random.default_rng(seed), np.stack([np.cos(ANGLES), np.sin(ANGLES)])
    s, motions = np.linspace(0.0, 4.0, n)[:, None, None], []
    for _ in range(n_motions):
        way = 0.003 * rng.standard_normal((3, 3, 2)) @ u
        motions.append((way[0] + np.sin(s) * way[1] + np.sin(2 * s) * way[2]).reshape(n, 9))
    return np.concatenate(motions)


def measured(q=None, **changes):
    """A simulated log of a robot like CHAIN, its radii and lengths 4 % off."""
    q = balanced() if q is None else q
    truth = ConstantCurvatureChain(1.04 * CHAIN.radii, lengths=0.96 * CHAIN.lengths, routing="base")
    x = truth(torch.from_numpy(q)).numpy()
    x = x + 1e-4 * np.random.default_rng(1).standard_normal(x.shape)
    log = {"q": q, "x": x, "groups": np.arange(len(q)) // 20, "q_names": NAMES}
    return Log(**{**log, **changes})


def only(log, chain=CHAIN, **options):
    """The single finding of a check."""
    (finding,) = check_log(log, chain=chain, **options).findings
    return finding


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
    log = measured()
    shuffled = measured(x=log.x, q=log.q[:, order], q_names=tuple(NAMES[i] for i in order))
    finding = only(shuffled, base_is_free=base_is_free)
    assert finding.kind == "order"
    listed = json.loads(re.search(r"set q = (\[[^]]*\])", finding.advice)[1])
    again = measured(x=log.x, q=log.q[:, [NAMES.index(name) for name in listed]])
    assert check_log(again, chain=CHAIN, base_is_free=base_is_free).findings == ()
    if not base_is_free:
        assert tuple(listed) == NAMES


def test_the_sign_of_one_column_is_named():
    log, sign = measured(), np.where(np.arange(9) == 4, -1.0, 1.0)
    finding = only(measured(x=log.x, q=sign * log.q))
    assert finding.kind == "sign"
    assert "set q_sign = [1, 1, 1, 1, -1, 1, 1, 1, 1]" in finding.advice


@pytest.mark.parametrize(("turn", "kind"), [([1, 2, 0], "rotated."), ([1, 0, 2], "mirrored.")])
def test_axes_of_the_tip_are_named_where_the_base_is_fixed(turn, kind):
    log = measured()
    finding = only(measured(x=log.x[:, turn]), base_is_free=False)
    assert (finding.kind, finding.message.endswith(kind)) == ("axes", True)


def test_radii_that_are_diameters_are_named():
    wide = ConstantCurvatureChain(2 * CHAIN.radii, lengths=CHAIN.lengths, routing="base")
    finding = only(measured(), wide)
    assert finding.kind == "size"
    assert "bends are 2 times as large" in finding.message


def test_offset_and_drift_of_one_actuator():
    log = measured()
    shift = 0.003 * np.eye(9)[7]
    finding = only(measured(x=log.x, q=log.q + shift))
    assert finding.kind == "offset"
    assert "'h' is off by about 3 mm" in finding.message
    drifting = log.q + np.linspace(0.0, 1.0, len(log.q))[:, None] * shift
    finding = only(measured(x=log.x, q=drifting))
    assert finding.kind == "drift"
    assert "'h' drifts by about" in finding.message


def test_a_moved_camera_and_tips_that_come_late():
    log = measured()
    later = (np.arange(len(log.x)) >= 100)[:, None] * [0.02, 0.0, 0.01]
    findings = check_log(measured(x=log.x + later), chain=CHAIN).findings
    assert "drift" in {f.kind for f in findings}
    late = Log(log.q[3:], log.x[:-3], log.groups[3:], q_names=NAMES)
    finding = {f.kind: f for f in check_log(late).findings}["lag"]
    assert "3 rows behind q" in finding.message
    early = Log(log.q[:-3], log.x[3:], log.groups[3:], q_names=NAMES)
    assert "3 rows ahead of q" in {f.kind: f for f in check_log(early).findings}["lag"].message


def test_columns_that_hold_the_same():
    log = measured()
    finding = only(measured(x=log.x, q=log.q[:, [0, 1, 2, 3, 4, 5, 6, 7, 7]]), None)
    assert finding.kind == "same column"
    assert "'h' and 'i'" in finding.message


def test_whole_lengths_where_changes_are_meant():
    log = measured()
    finding = only(measured(x=log.x, q=log.q + np.repeat([0.06, 0.125, 0.185], 3)))
    assert (finding.kind, finding.severity) == ("geometry", "error")
    assert "value at the straight robot" in finding.advice


def test_negative_lengths_of_chambers_are_a_sign():
    chain = ConstantCurvatureChain([0.05])
    q = 0.2 + 0.02 * np.random.default_rng(0).standard_normal((50, 3))
    x = chain(torch.from_numpy(q)).numpy()
    finding = check_log(Log(-q, x), chain=chain).errors[0]
    assert (finding.kind, "q_sign = -1" in finding.advice) == ("sign", True)
    finding = check_log(Log(q * [1, -1, 1], x, q_names=("a", "b", "c")), chain=chain).errors[0]
    assert "set q_sign = [1, -1, 1] in [log]" in finding.advice


@pytest.mark.parametrize(
    ("name", "load"),
    [("ftdcr_v4", load_ftdcr), ("ftdcr_v4_elastic", load_ftdcr), ("armlab_3cable", load_armlab)],
)
def test_recordings_of_real_robots_raise_no_false_alarm(data_home, name, load):
    robot, data = robots.read_description(f"examples/robots/{name}.toml"), load(data_home)
    log = Log(data.q[::5], data.x[::5], data.groups[::5])
    report = check_log(log, chain=robot.chain, base_is_free="base" in robot.calibrate)
    assert {f.kind for f in report.findings} <= {"jumps"}


@pytest.mark.parametrize(("radius", "length"), [(1, 1e3), (1e3, 1e3), (1e3, 1)])
@pytest.mark.parametrize("unit", ["m", "mm"])
def test_millimetres_in_the_description_are_named_instead_of_the_log(radius, length, unit):
    radii, lengths = radius * CHAIN.radii, length * CHAIN.lengths
    with pytest.warns(UserWarning, match="looks like millimetres"):
        chain = ConstantCurvatureChain(radii, lengths=lengths, routing="base")
    log = measured(file_units={"q": unit, "x": unit})
    (finding,) = check_log(log, chain=chain).errors
    assert finding.kind == "units"
    assert "the description in metres" in finding.advice
    assert "_unit" not in finding.advice


def test_zeros_of_the_wrong_sign_are_named():
    """Counts about 2050 at rest; their zeros have the sign of q after `q_sign`."""
    gain, zeros = 2.7e-5, 2050.0 + 20.0 * np.arange(9)
    log = measured()
    for sign in (1.0, -1.0):
        counts = measured(x=log.x, q=log.q / gain + sign * zeros, units={"q": "1", "x": "m"})
        chains = [
            CHAIN.with_geometry(
                gains=CHAIN.gains * gain, actuator_zeros=torch.from_numpy(way * zeros)
            )
            for way in (sign, -sign)
        ]
        assert check_log(counts, chain=chains[0]).findings == ()
        (finding,) = check_log(counts, chain=chains[1]).findings
        assert (finding.kind, finding.severity) == ("sign", "error")
        assert finding.advice.startswith("negate `zeros`")
