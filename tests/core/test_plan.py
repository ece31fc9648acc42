"""Plans, the registration of their writers, and the numbers that Python and C share."""

import re
from pathlib import Path

import numpy as np
import pytest

import hybridkin
from hybridkin._core import kernel_numbers
from hybridkin._core.plan import MOST, NoKernel, Plan
from hybridkin._core.portable import PortableModule
from hybridkin._core.stored import KINDS_OF_MODELS, Layout, Stored

SOURCES = Path(hybridkin.__file__).parent / "native" / "src"


def write_constant(plan, stored):
    return plan.node("affine", 2, 1, [stored.array("value")], 7)


@pytest.fixture
def constant():
    class Constant(PortableModule):
        layout = Layout("constant", {"value": "n"}, write_plan=write_constant)

    yield Stored("constant", arrays={"value": np.arange(3.0)})
    del KINDS_OF_MODELS[Constant.layout.kind]


def test_a_class_with_a_layout_registers_its_writer(constant):
    plan = Plan(constant)
    assert plan.kind(plan.root) == "affine"
    assert (plan.n_inputs, plan.n_outputs) == plan.lengths(plan.root) == (2, 1)
    assert plan.entry(plan.root, 0) == 7
    assert plan.data[plan.begin(plan.root) :][:3].tolist() == [0.0, 1.0, 2.0]


def test_sizes_are_limited():
    for what, most in MOST.items():
        with pytest.raises(NoKernel, match=f"{most + 1} {what}: the kernels support at most"):
            Plan(lambda plan, what=what, most=most: plan.limit(what, most + 1))


def test_no_shared_number_is_typed_in_c():
    defined = re.compile(r"(?:#define |enum \{ )((?:HK|IK)_\w+)")
    shared = set(defined.findall(kernel_numbers.c_header()))
    assert {"HK_ARCS", "HK_GAUSSIAN", "HK_GROUP", "HK_MAX_N", "IK_SLACK"} <= shared
    for path in SOURCES.glob("*.[ch]"):
        assert not shared & set(defined.findall(path.read_text())), path.name
