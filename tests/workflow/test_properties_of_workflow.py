"""Hostile values in any argument of what takes its time: fits, tracks, reports."""

import numpy as np
import pytest
from entry_points import (
    DESCRIPTION,
    FOLDER,
    GROUPS,
    LIMITS,
    LOADED,
    LOG,
    PATH,
    Q,
    X,
    fuzz,
)

from hybridkin import ConstantCurvatureChain, fit_play, workflow

SETTINGS = {"n_folds": 2, "auto": False, "loss": "linear", "coverage": None}
SETTINGS |= {"play": None, "max_rows": None}
OUT, TRACK = FOLDER / "out", FOLDER / "sent.csv"
TRACK.write_text("q1,q2,q3,x,y,z\n" + "\n".join(",".join(map(str, row)) for row in np.c_[Q, X]))
TENDONS = ConstantCurvatureChain([0.005], lengths=[0.1])


def with_settings(function):
    """Return a function that takes the fields of its settings one by one."""

    def call(n_jobs=1, **given):
        own = {name: given.pop(name) for name in SETTINGS}
        return function(**given, settings=workflow.FitSettings(**own), n_jobs=n_jobs)

    return call


ENTRIES = {
    "LoadedModel.effective": (LOADED.effective, {"q": Q, "groups": GROUPS}),
    "LoadedModel.expected_errors": (LOADED.expected_errors, {"q": Q}),
    "RobotDescription.to_log": (DESCRIPTION.to_log, {"q": Q}),
    "RobotDescription.from_log": (DESCRIPTION.from_log, {"q": Q}),
    "fit_play": (
        fit_play,
        {
            "chain": TENDONS,
            "q": 1e-3 * X,
            "x": X,
            "groups": GROUPS,
            "widths": [1e-4],
            "parameters": ["radii"],
        },
    ),
    "evaluate_log": (
        workflow.evaluate_log,
        {"loaded": LOADED, "log": LOG, "out": None, "force": True},
    ),
    "verify_track": (
        workflow.verify_track,
        {"loaded": LOADED, "track": TRACK, "log": LOG, "out": None},
    ),
    "next_rows": (
        workflow.next_rows,
        {"loaded": LOADED, "out": OUT, "n": 2, "limits": LIMITS, "path": PATH},
    ),
    "track_path": (
        workflow.track_path,
        {
            **{"loaded": LOADED, "path": PATH, "out": OUT, "limits": LIMITS, "start": "rest"},
            **{"tol": 1e-3, "force": True},
        },
    ),
    "fit_log": (
        with_settings(workflow.fit_log),
        {"log": LOG, "robot": DESCRIPTION, "out": OUT, "force": True, **SETTINGS},
    ),
}


@pytest.fixture(autouse=True)
def _elsewhere(monkeypatch):
    monkeypatch.chdir(FOLDER)


@pytest.mark.slow
@pytest.mark.parametrize("entry", ENTRIES)
def test_any_argument_gives_an_answer_or_an_error_of_ours(entry):
    fuzz(*ENTRIES[entry], share=40 if "_" in entry and "." not in entry else 2)
