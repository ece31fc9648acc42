"""Rows within the bounds of a chain need none of its warnings; others are checked by the chain."""

import numpy as np
import pytest
import torch

from hybridkin import ConstantCurvatureChain, ElasticTendonChain, HybridForwardModel
from hybridkin.chains.robots import bionic_handling_assistant

TENDONS = ConstantCurvatureChain([0.01, 0.008], lengths=[0.1, 0.08])
CHAINS = {
    "chambers": ConstantCurvatureChain([0.05, 0.04, 0.03]),
    "tendons": TENDONS,
    "counts": ConstantCurvatureChain([0.01], lengths=[0.1], gains=[2e-5] * 4, n_actuators=4),
    "elastic": ElasticTendonChain.from_chain(TENDONS),
    "robot": bionic_handling_assistant(),
}


@pytest.mark.parametrize("kind", CHAINS)
def test_rows_within_the_bounds_need_no_warning(kind):
    chain = CHAINS[kind]
    rng = np.random.default_rng(0)
    plausible = chain.plausible_rows()
    unit = 1.0 / chain.gains.detach().numpy()
    tested = 0
    for size in np.geomspace(1e-4, 1e3, 60):
        q = unit * size * rng.uniform(-1.0, 1.0, (5, chain.n_actuators))
        rows = torch.from_numpy(q)
        assert plausible.hold(q) == all(plausible.hold(row[None]) for row in q)
        if plausible.hold(q):
            tested += 1
            assert chain.unit_messages(rows, "q") == []
            assert chain.contradictions(rows) == []
    assert tested > 5
    assert not plausible.hold(q)  # the last rows are far too large


def test_numbers_without_a_product_are_outside():
    plausible = TENDONS.plausible_rows()
    for number in (1e308, np.inf, np.nan):
        assert not plausible.hold(np.full((1, 6), number))
        assert not plausible.hold(np.array([[number, 0.0, 0.0, 0.0, 0.0, 0.0]]))
    assert plausible.hold(np.zeros((0, 6)))


@pytest.mark.parametrize(
    ("row", "message"),
    [
        (np.array([30.0, -15.0, -15.0, 0.0, 0.0, 0.0]), "millimetres"),
        (np.array([-0.004, -0.004, -0.004, 0.0, 0.0, 0.0]), "pull the tendons"),
    ],
)
def test_predict_warns_as_before(row, message):
    pulls = np.random.default_rng(0).uniform(-0.002, 0.002, (60, 4))
    q = np.insert(pulls, [2, 4], -pulls.reshape(60, 2, 2).sum(axis=2), axis=1)
    x = TENDONS(torch.from_numpy(q)).numpy()
    hybrid = HybridForwardModel(TENDONS, "linear", guard=None).fit(q, x)
    with pytest.warns(UserWarning, match=message):
        hybrid.predict(np.stack([q[0], row]))
