"""What the report says of the errors: static, hysteresis, and neither."""

import re

import numpy as np
import pytest
import torch

from hybridkin import ConstantCurvatureChain, HybridForwardModel, Hysteresis, datasets
from hybridkin.app.workflow.compare import AUTO, CALIBRATED, DATA_ELM
from hybridkin.app.workflow.errors import HeldOutErrors
from hybridkin.app.workflow.explained import explained_in_words
from hybridkin.app.workflow.log import checked

CHAIN = ConstantCurvatureChain([0.005], lengths=[0.1])
NOISE = 1e-4


def held_out(**means):
    fold = np.repeat([0, 1], 20)
    errors = {}
    for name, mean in means.items():
        errors[name] = HeldOutErrors.of_motions(np.full(40, mean), fold, fold)
    return errors


@pytest.mark.parametrize("width", [4e-4, 0.0])
def test_the_floor_is_the_noise_of_the_log(width):
    rng = np.random.default_rng(0)
    turn = np.linspace(0.0, 6.0, 80)
    ring = 2.0 * np.pi / 3.0 * np.arange(3)
    motions = []
    for k in range(12):  # each direction out and back, twice, once the other way round
        way = np.cos(ring - 0.5 * (k // 2))
        motions.append(0.003 * np.outer(np.sin(turn), way) * (-1.0) ** k)
    q = np.concatenate(motions)
    groups = np.repeat(np.arange(12), 80)
    y = Hysteresis.backlash(width).apply_by_group(q, groups)
    with torch.no_grad():
        x = CHAIN(torch.from_numpy(y)).numpy() + NOISE * rng.standard_normal((len(q), 3))
    rows = checked(datasets.Log(q, x, groups), None, base_is_free=False)
    model = HybridForwardModel(CHAIN, "drop", hysteresis=width).fit(q, x, groups=groups)
    errors = held_out(**{CALIBRATED: 3e-3, DATA_ELM: 2e-3, AUTO: 1e-3})
    words = explained_in_words(errors, rows, model)
    floors = [float(value) for value in re.findall(r"about (\S+) mm", words)]
    if width == 0.0:
        assert f"best function of q ({AUTO}) leaves 1 mm; the least" in words
    else:
        assert f"({DATA_ELM}) leaves 2 mm, and {AUTO}, with hysteresis, 1 mm; the" in words
    assert floors[-1] == pytest.approx(1e3 * NOISE * np.sqrt(8.0 / np.pi), rel=0.2)
    # What differs from motion to motion counts, too: pairs are rows of two motions.
    drift = 1e-3 * rng.standard_normal((12, 3))[groups]
    rows = checked(datasets.Log(q, x + drift, groups), None, base_is_free=False)
    words = explained_in_words(errors, rows, model)
    drifted = [float(value) for value in re.findall(r"about (\S+) mm", words)]
    assert drifted[-1] > 5.0 * floors[-1]
