"""Models on a device that is pretended: the CPU computes, but tensors say that they are elsewhere.

Run as a script, because the device stays registered in its process. As on a GPU, an operation
refuses tensors of two devices, and NumPy gets no tensor without a copy to the CPU.
"""

import sys
import warnings

import numpy as np
import torch
from torch.utils import backend_registration
from torch.utils._python_dispatch import TorchDispatchMode, return_and_correct_aliasing
from torch.utils._pytree import tree_leaves, tree_map

NAME = "pretended"
SOLVED = ("hybrid, network", "adapted poses")
EVALUATED = (
    "tendons by force",
    "backlash and creep",
    "blend",
    "hybrid, quadratic",
    "hybrid, kernel ridge",
    "serial, network",
    "hybrid of a rigid arm",
)
aten = torch.ops.aten
COPIES = (aten._to_copy.default, aten.copy_.default)
INDEXED = (aten.index.Tensor, aten.index_put.default, aten.index_put_.default)


class Elsewhere(torch.Tensor):
    """A tensor of the pretended device."""

    @staticmethod
    def __new__(cls, numbers):
        return torch.Tensor._make_wrapper_subclass(
            cls,
            numbers.size(),
            strides=numbers.stride(),
            storage_offset=numbers.storage_offset(),
            dtype=numbers.dtype,
            device=torch.device(NAME, 0),
        )

    def __init__(self, numbers):
        self.numbers = numbers

    __torch_function__ = torch._C._disabled_torch_function_impl

    @classmethod
    def __torch_dispatch__(cls, operation, types, args=(), kwargs=None):
        return computed(operation, args, kwargs or {})

    def tolist(self):
        return self.cpu().tolist()

    def numpy(self, *, force=False):
        if not force:
            raise TypeError("can't convert a tensor of another device to NumPy")
        return self.detach().cpu().numpy()

    def __array__(self, *_):
        return self.numpy()


class Pretended(TorchDispatchMode):
    """New tensors of the device."""

    def __enter__(self):
        torch._C._set_only_lift_cpu_tensors(True)
        return super().__enter__()

    def __exit__(self, *error):
        torch._C._set_only_lift_cpu_tensors(False)
        return super().__exit__(*error)

    def __torch_dispatch__(self, operation, types, args=(), kwargs=None):
        return computed(operation, args, kwargs or {})


def computed(operation, args, kwargs):
    """Return the result of an operation, on the device where a GPU would have it."""
    tensors = [a for a in tree_leaves((args, kwargs)) if isinstance(a, torch.Tensor)]
    there = [a for a in tensors if isinstance(a, Elsewhere)]
    device = kwargs.get("device")
    if operation in INDEXED:
        # Indices may be on the CPU, for a tensor that is elsewhere.
        same = isinstance(args[0], Elsewhere) or not there
    else:
        same = operation in COPIES or not there
        same = same or all(isinstance(a, Elsewhere) or a.ndim == 0 for a in tensors)
    if not same:
        raise RuntimeError(f"{operation}: tensors of two devices")
    stays = bool(there) if device is None else torch.device(device).type == NAME
    if operation is aten.copy_.default:
        stays = isinstance(args[0], Elsewhere)
    if device is not None:
        kwargs = {**kwargs, "device": torch.device("cpu")}
    result = operation(*tree_map(_numbers, args), **tree_map(_numbers, kwargs))
    if not stays:
        return result
    result = tree_map(_elsewhere, result)
    if there:
        return return_and_correct_aliasing(operation, args, kwargs, result)
    return result


def _numbers(a):
    return a.numbers if isinstance(a, Elsewhere) else a


def _elsewhere(a):
    return Elsewhere(a) if isinstance(a, torch.Tensor) else a


def compare():
    """Return what differs, or fails, on the device."""
    import gpu
    from gpu_report import Study

    from hybridkin import InverseKinematics
    from hybridkin._core.blocks import in_blocks

    device = torch.device(NAME)
    study = Study(device, 60.0, quick=True)
    kinds = {name: gpu.KINDS[name]() for name in (*SOLVED, *EVALUATED)}
    with Pretended():
        for name, kind in kinds.items():
            with study.attempt(name):
                gpu.compare_model(study, name, kind, 2)
        for name in SOLVED:
            kind = kinds[name]
            # Inverse kinematics follows its inputs, wherever the model is.
            box = {"q_min": kind.low, "q_max": kind.high, "dq_max": 0.1}
            solutions = []
            for model, rows in (("cpu", "cpu"), (NAME, NAME), ("cpu", NAME), (NAME, "cpu")):
                with study.attempt(f"{name} on {model}, rows on {rows}"):
                    module = gpu.moved(kind.module, model)
                    ik = InverseKinematics(kind.task(module), **box)
                    q = kind.rows(1).to(rows)
                    target = ik.settings.task.evaluate(q)[0]
                    solution = ik.solve(target, 0.99 * q, restarts=0, max_iter=2)
                    assert solution.q.device.type == rows
                    solutions += [solution.q, ik.step(0.99 * q, target).dq]
            for there in solutions[2::2]:
                study.compare(name, "solve", gpu.apart(solutions[0], there), 1e-8)
            for there in solutions[3::2]:
                study.compare(name, "step", gpu.apart(solutions[1], there), 1e-8)
        with study.attempt("fits"):
            gpu.compare_fits(study)

        # What is kept of the state follows its changes.
        for name, entry in (("extensible segments", "radii"), ("network", "input_scale")):
            kind = gpu.KINDS[name]()
            q = kind.rows(2)
            there = gpu.moved(kind.module, NAME)
            for change in (1.0, 1.1):
                for module in (kind.module, there):
                    getattr(module, entry).mul_(change)
                expected = kind.module.forward_and_jacobian(q)
                found = there.forward_and_jacobian(q.to(NAME))
                for ours, theirs in zip(expected, found, strict=True):
                    study.compare(name, f"{entry} times {change}", gpu.apart(ours, theirs), 1e-12)

        # The CPU takes blocks that fit its cache; they would leave a GPU idle.
        sizes = []
        for rows in (torch.zeros(10_000, 2), torch.zeros(10_000, 2, device=device)):
            in_blocks(lambda block: (sizes.append(len(block)) or block,), rows)
    assert sizes == [4096, 4096, 1808, 10_000], sizes
    assert study.results
    return study.failed


if __name__ == "__main__":
    torch.set_num_threads(1)
    np.seterr(all="ignore")
    warnings.simplefilter("ignore")
    backend_registration._setup_privateuseone_for_python_backend(NAME)
    sys.exit("\n".join(compare()) or 0)
