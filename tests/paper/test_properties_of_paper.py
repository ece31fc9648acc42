"""Hostile values in any argument of the simulation, its data and their protocol."""

import numpy as np
import pytest
from entry_points import FOLDER, fuzz

from paper import TrunkPlant, make_trunk, paper_protocol

pytest.importorskip("mujoco", reason="the simulated trunk needs hybridkin[sim]")

PLANT = {"tilt": 0.6, "gravity": 9.8, "max_force": 150.0}
PLANT |= {"base_error": np.zeros(6), "cable_noise": 1e-3, "mocap_noise": 1e-3, "max_iter": 50}


def settled(q, **given):
    return TrunkPlant(**given).settle(q)


ENTRIES = {
    "make_trunk": (
        make_trunk,
        {
            **{"q_target": np.full((1, 9), 0.25), "n_segment": 0, "n_random": 1, "random_state": 0},
            **{"cable_noise": 1e-3, "mocap_noise": 1e-3, "return_X_y": False},
        },
    ),
    "paper_protocol": (
        paper_protocol,
        {"random_state": 0, "n_segment": 2, "n_random": 3},
    ),
    "TrunkPlant.settle": (settled, {"q": np.full(9, 0.25), **PLANT}),
}


@pytest.fixture(autouse=True)
def _elsewhere(monkeypatch):
    monkeypatch.chdir(FOLDER)


@pytest.mark.slow
@pytest.mark.parametrize("entry", ENTRIES)
def test_any_argument_gives_an_answer_or_an_error_of_ours(entry):
    fuzz(*ENTRIES[entry], share=1 if entry == "paper_protocol" else 40)
