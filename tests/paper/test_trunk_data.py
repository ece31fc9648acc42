"""Data of the simulated trunk: what is drawn, settled, kept in a checkpoint and shipped."""

import io

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from hybridkin.datasets import load_trunk
from paper import NotSettledError, TrunkPlant, make_trunk, paper_protocol, trunk_data

pytest.importorskip("mujoco", reason="the simulated trunk needs hybridkin[sim]")

SMALL = {"n_segment": 2, "n_random": 4, "random_state": 5}


@pytest.fixture
def small_chunks(monkeypatch):
    monkeypatch.setattr(trunk_data, "CHUNK", 3)


def test_shipped_rows_are_reproduced_by_the_plant():
    data = load_trunk()
    plant, seed = TrunkPlant(**data.parameters["plant"]), data.parameters["random_state"]
    for row in (0, 499, 500, 1000, 1499, 1500, 1999):
        q, pose = plant.settle(data.q_target[row], random_state=[seed, trunk_data.NOISE, row])
        assert_allclose(q, data.q[row], rtol=0, atol=1e-7)
        assert_allclose(pose[:3, 3], data.x[row], rtol=0, atol=1e-7)


@pytest.mark.slow
def test_resumed_equals_uninterrupted(small_chunks, monkeypatch, tmp_path):
    settled = []

    class Interrupted(TrunkPlant):
        def settle(self, *arguments, **options):
            if len(settled) == 6:
                raise KeyboardInterrupt
            settled.append(options["random_state"][-1])
            return super().settle(*arguments, **options)

    whole = make_trunk(**SMALL)
    with monkeypatch.context() as patch:
        patch.setattr(trunk_data, "TrunkPlant", Interrupted)
        with pytest.raises(KeyboardInterrupt):
            make_trunk(**SMALL, checkpoint=tmp_path)
        assert settled == [0, 1, 2, 3, 4, 5]
        settled[:] = [-1]  # so many more may be made: the chunks that are missing
        resumed = make_trunk(**SMALL, checkpoint=tmp_path)
        assert settled == [-1, 6, 7, 8, 9]
        # A complete checkpoint is the data.
        again = make_trunk(**SMALL, checkpoint=tmp_path)
        assert settled == [-1, 6, 7, 8, 9]
    assert_array_equal(again.x, resumed.x)
    assert_allclose(resumed.q, whole.q, rtol=0, atol=1e-12)
    assert_allclose(resumed.x, whole.x, rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    "change",
    [
        {"random_state": 6},
        {"cable_noise": 0.0},
        {"tilt": 0.0},
        {"q_target": np.full((1, 9), 0.25)},
    ],
)
def test_a_checkpoint_of_another_run_is_not_taken(tmp_path, change):
    arguments = {"n_segment": 0, "n_random": 1, "random_state": 5}
    make_trunk(**arguments, checkpoint=tmp_path)
    data = make_trunk(**{**arguments, **change}, checkpoint=tmp_path)
    assert_array_equal(data.x, make_trunk(**{**arguments, **change}).x)


@pytest.fixture
def stubborn(monkeypatch):
    """A plant that does not settle where the first chamber is long."""

    class Stubborn(TrunkPlant):
        def settle(self, q_target, **kwargs):
            if q_target[0] > 0.25:
                raise NotSettledError("Not settled: stubborn.")
            return super().settle(q_target, **kwargs)

    monkeypatch.setattr(trunk_data, "TrunkPlant", Stubborn)


@pytest.mark.slow
def test_rows_that_do_not_settle_are_drawn_again(stubborn):
    with pytest.warns(UserWarning, match="did not settle and were drawn again"):
        data = make_trunk(n_segment=2, n_random=12, random_state=0)
    assert np.bincount(data.part).tolist() == [2, 2, 2, 12]
    assert data.q_target[:, 0].max() <= 0.25
    assert_array_equal(data.row, np.arange(18))
    first_draw, _ = paper_protocol(0, n_segment=2, n_random=12)
    failed = {row for row, _, _ in data.failed}
    assert failed == set(np.flatnonzero(first_draw[:, 0] > 0.25).tolist())
    kept = np.setdiff1d(np.arange(18), list(failed))
    assert_array_equal(data.q_target[kept], first_draw[kept])


@pytest.mark.slow
def test_a_damaged_checkpoint_is_made_again_and_runs_nothing(tmp_path):
    options = {"n_segment": 1, "n_random": 1, "random_state": 0, "return_X_y": True}
    whole = make_trunk(**options, checkpoint=tmp_path)
    (file,) = tmp_path.iterdir()
    content = file.read_bytes()
    objects = np.array([print, None])
    file.write_bytes(content[:-100])
    np.testing.assert_array_equal(make_trunk(**options, checkpoint=tmp_path)[1], whole[1])
    assert np.load(file).files == np.load(io.BytesIO(content)).files
    np.savez(file, q=objects)
    np.testing.assert_array_equal(make_trunk(**options, checkpoint=tmp_path)[1], whole[1])
