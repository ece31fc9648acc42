"""Constants that are kept on each device."""

import subprocess
import sys

import pytest
import torch
from torch._subclasses.fake_tensor import FakeTensorMode
from torch.func import hessian, jacfwd, jacrev

from hybridkin import ConstantCurvatureChain
from hybridkin._core.constants import constant, moved

NUMBERS = ((1.5, 2.5), (3.5, 4.5))


def test_a_constant_is_made_once_for_each_precision():
    like = torch.zeros(1, dtype=torch.float64)
    first = constant(NUMBERS, like)
    assert torch.equal(first, torch.tensor(NUMBERS, dtype=torch.float64))
    assert constant(NUMBERS, like) is first
    assert constant(NUMBERS, like.float()).dtype == torch.float32
    assert constant((1, 0), like, torch.bool).tolist() == [True, False]


def test_constants_of_a_traced_graph_or_of_inference_are_not_left_behind():
    q = torch.full((2, 3), 0.2, dtype=torch.float64)
    like = q.sum()
    with FakeTensorMode() as mode:
        traced = constant((7.25, 8.25), mode.from_tensor(like))
    assert type(traced) is not torch.Tensor
    assert type(constant((7.25, 8.25), like)) is torch.Tensor
    with torch.inference_mode():
        kept = constant((9.25,), like)
        chain = ConstantCurvatureChain([0.05])
        chain(q)
    assert not kept.is_inference()
    leaf = q.clone().requires_grad_()
    (slope,) = torch.autograd.grad(ConstantCurvatureChain([0.05])(leaf).sum(), leaf)
    assert slope.abs().max() > 0.0


@pytest.mark.parametrize(("first", "factor"), [(jacrev, 5.25), (jacfwd, 5.5), (hessian, 5.75)])
def test_constants_of_transforms_are_not_left_behind(first, factor):
    def curve(q):
        return constant((factor,), q) * q**2

    q = torch.full((1,), 3.0, dtype=torch.float64)
    jacrev(first(curve))(q)  # no call before has kept this factor
    assert jacrev(curve)(q).item() == 6.0 * factor
    assert constant((factor,), q).tolist() == [factor]


def test_a_hessian_may_come_first():
    """No constant may stay in its transforms; in a process of its own, where none is kept."""
    code = (
        "import torch\n"
        "from hybridkin import ConstantCurvatureChain\n"
        "chain = ConstantCurvatureChain([0.05])\n"
        "q = torch.tensor([0.2, 0.21, 0.22], dtype=torch.float64)\n"
        "second = torch.func.hessian(chain)(q)\n"
        "torch.testing.assert_close(torch.func.hessian(chain)(q), second)\n"
        "torch.testing.assert_close(torch.func.jacrev(chain)(q), chain.jacobian(q))\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_a_copy_elsewhere_follows_writes():
    elsewhere = torch.zeros(1, dtype=torch.float64, device="meta")
    limits = torch.ones(3, dtype=torch.float64)
    copy = moved(limits, elsewhere)
    assert copy.device.type == "meta"
    assert moved(limits, elsewhere) is copy
    limits[0] = 2.0
    assert moved(limits, elsewhere) is not copy
    assert moved(limits, limits) is limits
