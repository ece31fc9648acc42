"""Models as graphs of torch: compiled without breaks, and exported for any number of rows."""

import shutil
import sys

import gpu_models
import pytest
import torch
from torch.testing import assert_close

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(
        tuple(map(int, torch.__version__.split(".")[:2])) < (2, 13),
        reason="needs a torch that compiles models",
    ),
    # What torch says of its own parts.
    pytest.mark.filterwarnings("ignore:`torch.jit.script_method` is deprecated"),
    pytest.mark.filterwarnings("ignore:No complete tensor found in the group"),
]


def with_gradient(work, q):
    leaf = q.clone().requires_grad_()
    x, J = work(leaf)
    (gradient,) = torch.autograd.grad(x.square().sum() + J.square().sum(), leaf)
    return x.detach(), J.detach(), gradient


# "aot_eager" also traces the graph of the derivative.
@pytest.mark.parametrize(
    ("name", "backend"),
    [
        ("extensible segments", "eager"),
        ("elastic tendons", "aot_eager"),
        ("rigid arm", "eager"),
        ("blend", "eager"),
        ("serial, quadratic", "eager"),
        ("hybrid, network", "aot_eager"),
    ],
)
def test_models_compile_without_breaks(name, backend):
    kind = gpu_models.KINDS[name]()
    q = kind.rows(20, part=1.2)  # of a hybrid some rows are outside its domain
    q[0] = 0.5 * torch.from_numpy(kind.low + kind.high)
    work = kind.module.forward_and_jacobian
    torch.compiler.reset()
    compiled = torch.compile(work, fullgraph=True, backend=backend)
    for found, expected in zip(with_gradient(compiled, q), with_gradient(work, q), strict=True):
        assert_close(found, expected, rtol=1e-12, atol=1e-12)
        assert found.isfinite().all()
    with torch.no_grad():
        forward = torch.compile(kind.module, fullgraph=True, backend="eager")
        assert_close(forward(q), kind.module(q), rtol=1e-12, atol=1e-12)


@pytest.mark.skipif(
    sys.platform != "linux" or shutil.which("g++") is None, reason="needs a C compiler"
)
def test_a_hybrid_compiles_to_code_of_the_processor():
    kind = gpu_models.KINDS["hybrid, network"]()
    q = kind.rows(50, part=1.2)
    torch.compiler.reset()
    work = kind.module.forward_and_jacobian
    with torch.no_grad():
        for found, expected in zip(torch.compile(work, fullgraph=True)(q), work(q), strict=True):
            assert_close(found, expected, rtol=1e-10, atol=1e-10)


class WithJacobian(torch.nn.Module):
    """A model whose `forward` returns tips and Jacobians."""

    def __init__(self, model):
        super().__init__()
        self.model = model

    def forward(self, q):
        return self.model.forward_and_jacobian(q)


@pytest.mark.parametrize("name", ["elastic tendons", "serial, quadratic", "hybrid, network"])
def test_models_are_exported_for_any_number_of_rows(name, tmp_path):
    kind = gpu_models.KINDS[name]()
    q = kind.rows(20, part=1.2)
    shapes = ({0: torch.export.Dim("rows")},)
    for model in (kind.module, WithJacobian(kind.module)):
        program = torch.export.export(model, (q,), dynamic_shapes=shapes)
        torch.export.save(program, tmp_path / "model.pt2")
        loaded = torch.export.load(tmp_path / "model.pt2").module()
        for n in (2, 7, 5000):
            rows = kind.rows(n, 1, part=1.2)
            assert_close(loaded(rows), model(rows), rtol=1e-12, atol=1e-12)
