"""Threads and forks: what belongs to the process stays as it is."""

import os
import signal
import threading
import warnings

import numpy as np
import pytest
import torch
from saved_models import trunk, trunk_log

from hybridkin import ELMRegressor, ELMRegressorCV, HybridForwardModel
from hybridkin._core.turns import TURNS

Q, X, GROUPS = trunk_log()
ELM = ELMRegressor(4, random_state=0)
LONG = 60.0  # [s] that a deadlock is waited for


def hybrid(error_model, **settings):
    return HybridForwardModel(trunk(), error_model, random_state=0, **settings)


@pytest.fixture
def changes(monkeypatch):
    """Note for every change of the filters whether other threads were kept from changing them."""
    seen = []

    class Watched(warnings.catch_warnings):
        def __enter__(self):
            seen.append(TURNS.filters._is_owned())
            return super().__enter__()

    monkeypatch.setattr(warnings, "catch_warnings", Watched)
    return seen


@pytest.mark.parametrize("rows", [Q, Q.astype(np.float32), Q.tolist()], ids=type)
@pytest.mark.parametrize("model", [ELM, hybrid(ELM)], ids=["elm", "hybrid"])
def test_rows_without_fault_change_no_filters(changes, model, rows):
    """The filters for warnings belong to all threads."""
    model.fit(rows, X, sample_weight=np.ones(len(X)))
    model.partial_fit(rows, X).predict(rows)
    assert not changes
    with pytest.raises(ValueError, match="NaN"):
        model.partial_fit(np.full_like(Q, np.nan), X)
    with pytest.raises(ValueError, match=r"[Nn]egative"):
        model.fit(rows, X, sample_weight=-np.ones(len(X)))


@pytest.mark.parametrize(
    "model",
    [
        ELMRegressorCV(4, cv=3, relevance_rounds=0, max_hidden=4, random_state=0),
        ELMRegressorCV(4, relevance_rounds=0, max_hidden=4, random_state=0),
        hybrid("kernel"),
        hybrid("linear", calibrate=("radii",)),
    ],
    ids=["folds", "motions", "kernel", "calibrated"],
)
def test_threads_change_filters_in_turn(changes, model):
    model.fit(Q, X, groups=GROUPS)
    assert changes
    assert all(changes)


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs POSIX: fork")
@pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")
def test_a_child_computes_after_a_fork():
    """Many rows in two threads of torch; another thread has a lock."""
    model, threads = hybrid(ELM).fit(Q, X), torch.get_num_threads()
    rows = torch.from_numpy(np.tile(Q, (2000, 1)))
    held, done = threading.Event(), threading.Event()

    def hold():
        with TURNS.filters:
            held.set()
            done.wait(2.0 * LONG)

    holder = threading.Thread(target=hold, daemon=True)
    holder.start()
    try:
        torch.set_num_threads(2)
        expected = (rows.sin().sum(), model.module_(rows))
        assert held.wait(LONG)
        child = os.fork()
        if child == 0:
            signal.alarm(int(LONG))  # ends a child that waits
            x = model.module_(rows)
            found = (rows.sin().sum(), x)
            hybrid("kernel").fit(Q, X)
            same = all(torch.allclose(a, b) for a, b in zip(found, expected, strict=True))
            os._exit(0 if same else 1)
        assert os.waitpid(child, 0)[1] == 0
    finally:
        torch.set_num_threads(threads)
        done.set()
        holder.join(LONG)


def in_child(work):
    """Return the bytes that a function returns in a forked child."""
    reading, writing = os.pipe()
    child = os.fork()
    if child == 0:
        signal.alarm(int(LONG))
        os.write(writing, work())
        os._exit(0)
    assert os.waitpid(child, 0)[1] == 0
    os.close(writing)
    with os.fdopen(reading, "rb") as pipe:
        return pipe.read()


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs POSIX: fork")
@pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")
def test_a_child_keeps_its_number_of_threads():
    """Until it computes; a number that the child chooses itself stays."""
    module, rows, threads = trunk(), torch.from_numpy(Q), torch.get_num_threads()

    def counts():
        inherited = torch.get_num_threads()
        module(rows)
        return bytes([inherited, torch.get_num_threads()])

    def chosen():
        torch.set_num_threads(2)
        module(rows)
        return bytes([torch.get_num_threads()])

    try:
        torch.set_num_threads(3)
        assert in_child(counts) == bytes([3, 1])
        assert in_child(chosen) == bytes([2])
        module(rows)
        assert torch.get_num_threads() == 3
    finally:
        torch.set_num_threads(threads)
