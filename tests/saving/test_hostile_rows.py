"""One rule for rows of q that are huge or not finite, for every kind of model and entry.

A finite row is computed, whatever its size: where its numbers overflow it is NaN or infinite, and
the others are as they are without it. NaN and infinity raise in estimators. Modules and chains,
which may be in a control loop, do not raise: that row is not finite, with the core and without.
"""

import warnings

import numpy as np
import pytest
import saved_models
import torch
from numpy.testing import assert_allclose, assert_array_equal

from hybridkin import Commands, as_forward_model, load_model
from hybridkin.native.library import program_of

NAMES = sorted(path.stem for path in saved_models.FOLDER.glob("*.safetensors"))
ENTRIES = ("predict", "jacobian", "in_domain", "error_weight", "predict_and_jacobian")


def loaded(name):
    model = load_model(saved_models.FOLDER / f"{name}.safetensors")
    q = np.load(saved_models.FOLDER / "predictions.npz")[f"{name}.q"].astype(float)
    return model, q[:2]


def outcome(model, entry, q):
    rows = q
    if as_forward_model(model).hysteresis.needs_time:
        rows = Commands(q, time=np.arange(len(q), dtype=float))
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "`X` (reaches|has no tip: compressed)")
        warnings.filterwarnings("ignore", "compressed: in row 2")  # again in torch
        values = getattr(model, entry)(rows)
    return values if isinstance(values, tuple) else (values,)


@pytest.mark.parametrize("name", NAMES)
def test_a_huge_row_is_computed_and_leaves_the_others_alone(name):
    model, q = loaded(name)
    entries = [entry for entry in ENTRIES if hasattr(model, entry)]
    for size in (1e74, 1e76, -1e154, 1e308):
        far = np.vstack([q, q[:1]])
        far[-1, 0] = size
        for entry in entries if hasattr(model, "predict") else ():
            found = outcome(model, entry, far)
            for values, expected in zip(found, outcome(model, entry, q), strict=True):
                assert_allclose(values[:2], expected, rtol=1e-12, atol=1e-12, err_msg=entry)
        module = as_forward_model(model)
        with torch.no_grad(), warnings.catch_warnings():
            warnings.filterwarnings("ignore", "compressed: in row 2")
            tips = module(torch.from_numpy(far))
        assert_allclose(tips[:2], module(torch.from_numpy(q)).detach(), atol=1e-12)


@pytest.mark.parametrize("value", [np.inf, -np.inf, np.nan])
@pytest.mark.parametrize("name", NAMES)
def test_a_row_that_is_not_finite_raises_in_estimators_and_not_in_modules(name, value):
    model, q = loaded(name)
    bad = np.vstack([q, q[:1]])
    bad[-1, 0] = value
    for entry in ENTRIES if hasattr(model, "predict") else ():
        if hasattr(model, entry):
            with pytest.raises(ValueError, match=r"NaN|infinity"):
                outcome(model, entry, bad)
    module = as_forward_model(model)
    with torch.no_grad():
        x = module(torch.from_numpy(bad))
        assert_allclose(x[:2], module(torch.from_numpy(q)), atol=1e-12)
    assert not x[-1].isfinite().all()
    program = program_of(module)
    if program is not None:
        assert_array_equal(np.isfinite(program.evaluate(bad)[0]), x.isfinite())
