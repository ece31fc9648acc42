"""Labels of rows: a missing one is refused by name and row, whatever holds it."""

import datetime
import decimal

import numpy as np
import pandas as pd
import pytest
import torch
from sklearn.inspection import permutation_importance
from sklearn.model_selection import (
    GroupKFold,
    cross_validate,
    learning_curve,
    train_test_split,
)

from hybridkin import (
    Commands,
    ConstantCurvatureChain,
    ELMRegressorCV,
    HybridForwardModel,
    Hysteresis,
    calibrate,
    choose_rows,
    datasets,
)
from hybridkin._core.arrays import labels

CHAIN = ConstantCurvatureChain([0.05])
N = 12
Q = 0.2 + 0.05 * np.random.default_rng(0).random((N, 3))
X = CHAIN(torch.from_numpy(Q)).numpy()
MODEL = HybridForwardModel(CHAIN, "drop", hysteresis=0.002).fit(Q, X)
MISSING = [None, np.nan, pd.NaT, pd.NA, decimal.Decimal("nan"), np.inf]
DAYS = [datetime.date(2026, 1, 1 + k) for k in range(3)]


def masked(names, missing):
    return np.ma.array(names, mask=missing)


def with_entry(entry, dtype=object):
    """Return a way to replace the missing labels by an entry, in an array or in a list."""

    def holding(names, missing):
        array = np.array(names, dtype=object)
        array[missing] = entry
        return array.tolist() if dtype is list else array.astype(dtype)

    return holding


def series(dtype):
    def holding(names, missing):
        return pd.Series(np.where(missing, None, names.astype(object)), dtype=dtype)

    return holding


WAYS = {
    **{f"object {entry}": (["a", "b"], with_entry(entry)) for entry in MISSING},
    **{f"list {entry}": (["a", "b"], with_entry(entry, list)) for entry in MISSING},
    "float": ([1.0, 2.0], with_entry(np.nan, float)),
    "float32": ([1.0, 2.0], with_entry(np.nan, np.float32)),
    "infinite": ([1.0, 2.0], with_entry(-np.inf, float)),
    "complex": ([1j, 2j], with_entry(np.nan, complex)),
    "days": (np.array(DAYS, "M8[D]"), with_entry(None, "M8[D]")),
    "times": (np.array([1, 2], "m8[s]"), with_entry(None, "m8[s]")),
    "masked texts": (["a", "b"], masked),
    "masked numbers": ([1, 2], masked),
    "texts": (["a", "b"], series("string")),
    "Series": (["a", "b"], series(None)),
    "category": (["a", "b"], series("category")),
    "Int64": ([1, 2], series("Int64")),
    "Float64": ([1.0, 2.0], series("Float64")),
    "boolean": ([True, False], series("boolean")),
    "time zone": (np.array(DAYS, "M8[ns]"), series("datetime64[ns, UTC]")),
    "tensor": ([1.0, 2.0], lambda *a: torch.from_numpy(with_entry(np.nan, float)(*a))),
}


@pytest.mark.parametrize("way", WAYS)
def test_a_missing_label_is_refused_with_its_row(way):
    rng = np.random.default_rng(0)
    kinds, holding = WAYS[way]
    for _ in range(20):
        n = rng.integers(1, 30)
        names = np.asarray(kinds)[rng.integers(len(kinds), size=n)]
        missing = rng.random(n) < 0.3
        if not missing.any():
            assert labels(holding(names, missing), n).shape == (n,)
            continue
        count = rf"`runs` .* in {missing.sum()} of {n} rows \(first: row {missing.argmax()}\)"
        with pytest.raises(ValueError, match=count):
            labels(holding(names, missing), n, "runs")


@pytest.mark.parametrize("names", [["None", "nan", "NaT"], ["", "a", "b"], [1, "1", True], [b"a"]])
def test_texts_that_look_missing_are_names(names):
    assert len(labels(names, len(names))) == len(names)


def refusals(missing):
    """Yield the argument and a call for every function that takes labels."""
    yield "runs", lambda: Commands(Q, missing)
    yield "groups", lambda: datasets.Log(Q, X, missing)
    yield "runs", lambda: datasets.Log(Q, X, runs=missing)
    yield "groups", lambda: HybridForwardModel(CHAIN, "drop").fit(Q, X, groups=missing)
    yield "groups", lambda: MODEL.predict(Q, groups=missing)
    yield "groups", lambda: MODEL.adapt(Q, X, groups=missing)
    yield "groups", lambda: ELMRegressorCV().fit(Q, X, groups=missing)
    yield "groups", lambda: calibrate(CHAIN, Q, X, groups=missing)
    yield "groups", lambda: choose_rows(CHAIN, Q, 2, groups=missing)
    yield "groups", lambda: Hysteresis.backlash(0.01).apply_by_group(Q, missing)


@pytest.mark.parametrize("entry", [None, pd.NA, pd.NaT, np.nan])
def test_every_function_refuses_them_by_name(entry):
    names = with_entry(entry)(np.repeat(["a", "b", "c"], 4), np.arange(N) == 7)
    for argument, call in refusals(names):
        with pytest.raises(ValueError, match=rf"`{argument}` must name .*first: row 7\)"):
            call()


@pytest.mark.parametrize("q", [3.0, None, [1.0, 2.0, 3.0], np.zeros((2, 2, 2)), "q"])
def test_commands_are_rows(q):
    with pytest.raises(ValueError, match="`q` must"):
        Commands(q)


def test_a_number_gives_one_row_and_iteration_all():
    commands = Commands(Q, np.arange(N) // 4, np.arange(N))
    assert repr(commands) == "Commands(12 rows of 3 actuators, 3 runs, time from 0 to 11 s)"
    assert repr(Commands(Q)) == "Commands(12 rows of 3 actuators)"
    for k, row in enumerate(commands):
        assert row.shape == (1, 3)
        assert (row.q[0].tolist(), row.runs, row.time) == (Q[k].tolist(), k // 4, k)
    assert k == N - 1
    assert commands[-1].time == [N - 1]
    frame = Commands(pd.DataFrame(Q, columns=["a", "b", "c"]), runs=np.arange(N))
    assert [row.runs[0] for row in frame] == [*range(N)]
    with pytest.raises(IndexError):
        commands[N]


def test_scikit_learn_splits_commands_and_says_why_it_cannot_permute_them():
    commands = Commands(Q, np.arange(N) // 3)
    train, test, _, of_test = train_test_split(commands, X, shuffle=False)
    assert (len(train), len(test), len(of_test)) == (9, 3, 3)
    folds = GroupKFold(2)
    cross_validate(MODEL, commands, X, groups=commands.runs, cv=folds, error_score="raise")
    learning_curve(MODEL, commands, X, cv=2, train_sizes=[4], error_score="raise")
    with pytest.raises(TypeError, match=r"no array: .* permutation_importance, take `commands.q`"):
        permutation_importance(MODEL, commands, X)
