import numpy as np
import pytest
import torch
from numpy.testing import assert_array_equal
from safetensors.numpy import load_file
from saved_models import trunk_log
from sklearn.kernel_ridge import KernelRidge
from sklearn.linear_model import Ridge
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler
from torch.testing import assert_close

from hybridkin import ELMRegressor, load_model, save_model
from hybridkin._core.digests import row_digests
from hybridkin._core.stored import Stored
from hybridkin.learning.regressor_modules import error_module


@pytest.mark.parametrize(
    "regressor",
    [
        Ridge(),
        ELMRegressor(4, direct_link=True, random_state=0),
        make_pipeline(StandardScaler(), KernelRidge(kernel="rbf", alpha=0.01)),
    ],
    ids=["affine", "network", "kernel"],
)
def test_modules_of_regressors_come_back(tmp_path, regressor):
    q, x, _ = trunk_log()
    rows = torch.from_numpy(q)
    module = error_module(regressor.fit(q, x), rows)
    save_model(module, tmp_path / "module")
    twin = load_model(tmp_path / "module")
    assert type(twin) is type(module)
    # Arrays come back in C order, which may change the last bit of a matrix product.
    was, came = module.forward_and_jacobian(rows), twin.forward_and_jacobian(rows)
    assert_close(came, was, rtol=1e-12, atol=1e-13)


@pytest.mark.parametrize("kind", ["parallel_elm", "serial_pose", "drift_and_radius", "blend"])
def test_equal_arrays_are_written_once(tmp_path, kind, fitted):
    save_model(fitted[kind][0], tmp_path / "model")
    arrays = load_file(tmp_path / "model").values()
    assert len({(a.shape, a.dtype.name, a.tobytes()) for a in arrays}) == len(arrays)


def test_entries_are_checked_when_they_are_read():
    arrays = {"a": np.zeros((2, 3)), "b": np.zeros(3), "n": np.full(2, np.nan)}
    stored = Stored.of("thing", {**arrays, "i": np.arange(3)}, count=3, flag=True, names=["x", 1])
    assert stored.value("count", float) == 3.0
    assert {*stored.tensors(a="kn", b="n")} == {"a", "b"}
    assert np.isnan(stored.array("n", "k", finite=False)).all()
    wrong = [
        ("`missing` of 'thing' is missing", lambda: stored.value("missing", str)),
        ("`flag` of 'thing' must be one of", lambda: stored.value("flag", (int, None))),
        ("must be a list of str", lambda: stored.list_of(str, "names")),
        ("the part 'x' of 'thing' is missing", lambda: stored.part("x")),
        ("the array 'x' of 'thing' is missing", lambda: stored.array("x")),
        ("'i' must be float32 or float64", lambda: stored.array("i")),
        (r"`a` must have shape \(2,\), got \(2, 3\)", lambda: stored.array("a", (2,))),
        (r"`b` must have shape \(2,\), got \(3,\)", lambda: stored.tensors(a="nk", b="n")),
        ("'n' must be finite", lambda: stored.array("n")),
    ]
    for message, read in wrong:
        with pytest.raises(ValueError, match=message):
            read()


def test_digests_of_rows_are_the_same_everywhere():
    q, x = np.array([[0.0, 0.0123], [-1.5, 2e-6]]), np.array([[0.1, 0.0, 0.3], [1e9, 1.0, 0.2]])
    digests = row_digests(q, x)
    assert digests.tolist() == [3617025846877243, 5702618512221831]
    assert_array_equal(row_digests(-0.0 * q + q, x + 1e-8), digests)
    assert_array_equal(row_digests(q, np.hstack([x, x])), digests)  # of a pose the position
    rows = np.random.default_rng(0).integers(-50, 50, (20000, 6)) * 1e-6
    digests = row_digests(rows[:, :3], rows[:, 3:])
    assert len(np.unique(digests)) == len(np.unique(rows, axis=0))
    assert digests.max() < 2.0**53
