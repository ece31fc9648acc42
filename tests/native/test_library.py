import multiprocessing
import os
import shutil

import numpy as np
import pytest
import torch
from torch.testing import assert_close

from hybridkin import (
    ConstantCurvatureChain,
    ForwardModel,
    HybridForwardModel,
    as_forward_model,
    datasets,
    robots,
)
from hybridkin.native import available, backend, library

CHAIN = {"radii": [0.01, 0.012], "lengths": [0.1, 0.08], "routing": "base"}
ROWS = np.random.default_rng(0).uniform(-0.01, 0.01, (45_001, 6))


def chain(**options):
    return ConstantCurvatureChain(**CHAIN, **options)


def by_torch(model, q):
    return [a.numpy() for a in model.forward_and_jacobian(torch.tensor(q, dtype=torch.float64))]


def agree(found, expected):
    for ours, right in zip(found, expected, strict=True):
        assert_close(ours, right, rtol=1e-12, atol=1e-13)


@pytest.fixture
def reopened(monkeypatch):
    """Search for the library anew, in this test alone."""
    library._opened.cache_clear()
    yield monkeypatch
    monkeypatch.undo()
    library._opened.cache_clear()


@pytest.fixture
def elsewhere(reopened, tmp_path):
    """Let the library be searched for in a copy of its folder."""
    shutil.copytree(library._FOLDER / "src", tmp_path / "src")
    shutil.copytree(library._FOLDER / "lib", tmp_path / "lib")
    reopened.setattr(library, "_FOLDER", tmp_path)
    return tmp_path


@pytest.mark.needs_core
@pytest.mark.parametrize("lead", [(), (1,), (7,), (0,), (3, 1, 2), (2, 0)])
def test_results_are_those_of_torch(lead):
    q, model = ROWS[: int(np.prod(lead))].reshape(*lead, 6), chain()
    x, J, distance = library.program_of(model).evaluate(q, jacobian=True, distance=True)
    agree((x, J), by_torch(model, q))
    assert distance.shape == lead
    assert not distance.any()
    assert all(a.flags.c_contiguous and a.dtype == np.float64 for a in (x, J, distance))
    (alone,) = library.program_of(model).evaluate(q)
    assert_close(alone, x, rtol=0.0, atol=1e-15)


@pytest.mark.needs_core
def test_the_number_of_threads_changes_nothing():
    program, threads = library.program_of(chain()), torch.get_num_threads()
    try:
        found = []
        for n in (1, 2, 5):
            torch.set_num_threads(n)
            found.append(program.evaluate(ROWS, jacobian=True, distance=True))
    finally:
        torch.set_num_threads(threads)
    for one, other in [(0, 1), (0, 2)]:
        assert all(np.array_equal(a, b) for a, b in zip(found[one], found[other], strict=True))
    agree(found[0][:2], by_torch(chain(), ROWS))


@pytest.mark.needs_core
def test_a_row_is_the_same_in_every_batch():
    """Wherever it stands, also in a last block that is not full, and beside a row of NaN."""
    data = datasets.load_trunk()
    model = HybridForwardModel(robots.bionic_handling_assistant(), random_state=0)
    program = library.program_of(model.fit(data.q[:300], data.x[:300]).module_)
    middle = data.q.mean(axis=0)
    rows = middle + np.linspace(0.2, 1.5, 40)[:, None] * (data.q[:40] - middle)
    whole = program.evaluate(rows, jacobian=True, distance=True)
    assert (whole[2] > 3.0).any()  # the guard fades these
    assert (whole[2] < 2.0).any()
    beside = rows.copy()
    beside[::5] = np.nan
    for batch in range(2, 25):
        for start in (0, 1, 7, 40 - batch):
            some = slice(start, start + batch)
            expected = [part[some] for part in whole]
            assert all(map(np.array_equal, program.evaluate(rows[some], True, True), expected))
            assert all(map(np.array_equal, program.evaluate(rows[some], True), expected))
            finite = np.isfinite(beside[some, 0])
            for part, right in zip(
                program.evaluate(beside[some], True, True), expected, strict=True
            ):
                assert np.array_equal(part[finite], right[finite])
                assert np.isnan(part[~finite]).all()


@pytest.mark.needs_core
@pytest.mark.parametrize("variant", ["v2", "v3", "v4", "generic"])
def test_variants_agree(reopened, variant):
    right = library.program_of(chain()).evaluate(ROWS[:9], jacobian=True)[:2]
    library._opened.cache_clear()
    reopened.setenv("HYBRIDKIN_NATIVE", variant)
    if not available():
        pytest.skip(f"needs another processor: this one has no {variant}")
    assert variant in library.library()._name
    agree(library.program_of(chain()).evaluate(ROWS[:9], jacobian=True)[:2], right)


def test_the_core_can_be_off(reopened):
    reopened.setenv("HYBRIDKIN_NATIVE", "off")
    assert not available()
    assert library.program_of(chain()) is None
    assert backend(chain()) == "torch: HYBRIDKIN_NATIVE=off"


def test_without_a_library_torch_computes(reopened, tmp_path):
    reopened.delenv("HYBRIDKIN_NATIVE", raising=False)
    reopened.setattr(library, "_FOLDER", tmp_path)
    assert backend(chain()).startswith("torch: hybridkin was installed without compiled kernels")
    with pytest.raises(RuntimeError, match=r"install a C compiler, then run `.*hatch_build.py`"):
        library.Program(None)


@pytest.mark.needs_core
def test_a_library_of_other_sources_is_refused(elsewhere):
    with open(elsewhere / "src" / "hk.c", "a") as source:
        source.write("\n")
    with pytest.warns(UserWarning, match="compiled from other sources; compile it anew by `"):
        assert "was compiled from other sources" in backend(chain())


@pytest.mark.needs_core
@pytest.mark.parametrize("kind", ["arcs", "elm"])
def test_wrong_numbers_are_refused(elsewhere, monkeypatch, kind):
    evaluate = library.Program.evaluate

    def wrong(self, q, *what):
        results = evaluate(self, q, *what)
        results[0][..., 2] *= 1.0 + 1e-11 * (self.plan.kind(self.plan.root) == kind)
        return results

    monkeypatch.setattr(library.Program, "evaluate", wrong)
    with pytest.warns(UserWarning, match="computes wrong numbers; compile it anew by `"):
        assert "computes wrong numbers" in backend(chain())


@pytest.mark.needs_core
def test_a_program_is_kept_until_the_model_changes():
    model = chain()
    first = library.program_of(model)
    assert library.program_of(model) is first
    for change in (
        lambda: model.offsets.add_(0.01),
        lambda: setattr(model, "base", torch.diag(torch.tensor([1.0, -1, -1, 1])).double()),
        lambda: model.load_state_dict(chain().state_dict()),
        lambda: model.float(),
    ):
        change()
        program = library.program_of(model)
        assert program is not first
        assert library.program_of(model) is program
        agree(program.evaluate(ROWS[:3], jacobian=True)[:2], by_torch(model, ROWS[:3]))
        first = program


@pytest.mark.needs_core
def test_single_rows_see_each_change():
    """They are compared in the core; a row of another length is none for it."""
    model, q = chain(), ROWS[:1]
    library.evaluate(model, q)
    for change in (
        lambda: model.offsets.add_(0.01),
        lambda: model.offsets.data.mul_(2.0),
        lambda: model.base.numpy().__setitem__((0, 3), 0.02),
        lambda: setattr(model.base, "data", model.base.data.clone()),
        lambda: setattr(model.base, "data", model.base.data.flip(0)),
        lambda: model.base.t_(),
        lambda: setattr(model, "base", torch.diag(torch.tensor([1.0, -1, -1, 1])).double()),
        lambda: model.load_state_dict(chain(base=torch.eye(4)).state_dict()),
        lambda: model.load_state_dict(chain().state_dict(), assign=True),
        lambda: model.float(),
        lambda: model.double(),
    ):
        change()
        agree(library.evaluate(model, q, jacobian=True), by_torch(model, q))
    with pytest.raises(ValueError, match="must have shape"):
        library.evaluate(model, q[:, :5])


def compute(model):
    return backend(model), library.program_of(model).evaluate(ROWS, jacobian=True)[:2]


@pytest.mark.needs_core
@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs POSIX: fork")
@pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")
def test_models_work_after_a_fork():
    model = chain()
    compute(model)
    with multiprocessing.get_context("fork").Pool(1) as pool:
        said, found = pool.apply_async(compute, (model,)).get(timeout=300)
    assert said == "compiled"
    agree(found, by_torch(model, ROWS))


class Longer(ConstantCurvatureChain):
    def forward(self, q):
        return 2.0 * super().forward(q)


@pytest.mark.needs_core
def test_what_has_no_kernel_says_so():
    longer = Longer(**CHAIN)
    assert library.program_of(longer) is None
    assert backend(longer) == "torch: a Longer has no kernel"
    assert backend(as_forward_model(lambda q: q)) == "torch: a FunctionModel has no kernel"
    assert backend(ForwardModel()) == "torch: a ForwardModel has no kernel"
    many = ConstantCurvatureChain(np.full(17, 0.01))
    assert backend(many) == "torch: 17 segments: the kernels support at most 16"
    with torch.inference_mode():
        frozen = chain()
    for model in (chain().to("meta"), frozen):
        for _ in range(2):  # the second answer is that of the program that was kept
            assert backend(model).startswith("torch: the compiled core needs tensors on the CPU")
