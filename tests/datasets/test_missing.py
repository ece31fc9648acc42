"""Numbers that stand for missing values: named by the check, and left out by `missing`."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose, assert_array_equal

from hybridkin import robots
from hybridkin.app import check_log
from hybridkin.datasets import Log, load_log, load_trunk

N = 300
SENTINELS = (9999.999, -9999.0, 99999.0, -1.0e6)


def log_of(seed, markers=1):
    """A simulated trunk, whose tips have some noise, in the unit of its file, mm."""
    rng = np.random.default_rng(seed)
    phase = np.linspace(0.0, 12.0, N)[:, None] * rng.uniform(0.5, 1.5, size=9)
    chain = robots.bionic_handling_assistant()
    q = np.mean(load_trunk().q, axis=0) + 0.02 * np.sin(phase)
    x = chain.forward(torch.as_tensor(q)).numpy() + 1e-3 * rng.normal(size=(N, 3))
    middle = 0.5 * x + 1e-3 * rng.normal(size=(N, 3))
    return Log(
        q,
        np.hstack([*[middle] * (markers - 1), x]),
        np.repeat(np.arange(10), N // 10),
        file_units={"q": "m", "x": "mm"},
    )


def found(log):
    return [finding for finding in check_log(log).findings if finding.kind == "missing"]


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("sentinel", SENTINELS)
def test_a_number_far_outside_is_named_with_its_rows(seed, sentinel):
    log = log_of(seed)
    rng = np.random.default_rng(seed)
    rows = np.sort(rng.choice(N, size=rng.integers(2, 40), replace=False))
    log.x[rows] = 1e-3 * sentinel
    (finding,) = found(log)
    assert finding.severity == "error"
    assert_array_equal(finding.rows, rows)
    assert f"{sentinel:.10g} stands in {len(rows)} rows" in finding.message
    assert f"missing = [{sentinel:.10g}]" in finding.advice
    report = check_log(log)
    assert {f.kind for f in report.errors} == {"missing"}  # the rest is checked without them


@pytest.mark.parametrize("seed", range(20))
def test_nothing_is_said_of_clean_logs(seed):
    log = log_of(seed, markers=1 + seed % 2)
    assert not found(log)
    rounded = replace(log, x=log.x.round(3), q=log.q.round(3))
    assert not found(rounded)
    assert not found(replace(log, x=log.x - log.x[0]))  # a tip at rest at the origin


def test_the_trunk_has_no_missing_values():
    data = load_trunk()
    assert not found(Log(data.q, data.x))


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("marker", [0, 1])
def test_a_marker_at_zero_is_named(seed, marker):
    log = log_of(seed, markers=2)
    rows = np.arange(40, 60)
    log.x[rows, 3 * marker : 3 * marker + 3] = 0.0
    (finding,) = found(log)
    assert_array_equal(finding.rows, rows)
    assert f"'x[{3 * marker}]'" in finding.message
    assert "at 0, 0, 0 in 20 rows" in finding.message


def test_an_outlier_that_is_not_repeated_is_no_missing_value():
    log = log_of(0)
    log.x[5] = [30.0, 31.0, 32.0]
    assert not found(log)


def test_an_encoder_that_was_lost():
    log = log_of(1)
    log.q[100:130, 2] = -9999.0
    (finding,) = found(log)
    assert "-9999 stands in 30 rows" in finding.message


def table(changes):
    values = np.arange(60.0).reshape(10, 6)
    for (row, column), value in changes.items():
        values[row, column] = value
    rows = [",".join(f"{v:.8g}" for v in row) for row in values]
    return "\n".join(["a,b,c,X,Y,Z", *rows]) + "\n"


NAMES = {"q": ["a", "b", "c"], "x": ["X", "Y", "Z"], "q_unit": "mm", "x_unit": "mm"}


def test_missing_numbers_become_nan(tmp_path):
    path = tmp_path / "log.csv"
    path.write_text(
        table({(2, 3): 9999.999, (2, 4): 9999.999, (4, 1): -9999, (6, 3): 0, (6, 4): 0, (6, 5): 0})
    )
    with pytest.raises(ValueError, match=r"3 of 10 rows .* \(lines 4, 6, 8\)"):
        load_log(path, **NAMES, missing=[9999.999, -9999, 0])
    log = load_log(path, **NAMES, missing=[9999.999, -9999], drop_invalid=True)
    assert log.invalid_lines.tolist() == [4, 6]
    log = load_log(path, **NAMES, missing=0, drop_invalid=True)
    assert log.invalid_lines.tolist() == [8]
    assert_allclose(log.q[0], [0.0, 1e-3, 2e-3])  # a zero elsewhere stays


def test_missing_must_be_numbers(tmp_path):
    path = tmp_path / "log.csv"
    path.write_text(table({}))
    with pytest.raises(ValueError, match="`missing` must be numeric"):
        load_log(path, **NAMES, missing="9999")


def test_counts_are_a_unit(tmp_path):
    path = tmp_path / "log.csv"
    path.write_text(table({}))
    names = {**NAMES, "q_unit": "counts"}
    log = load_log(path, **names)
    assert_array_equal(log.q, load_log(path, **{**names, "q_unit": "1"}).q)
    assert log.units["q"] == "1"
