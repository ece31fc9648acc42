"""Where work on a device makes the CPU wait for it, counted on a device that is pretended.

    python tests/synchronising.py            # a table of all entries
    python tests/synchronising.py solve      # also the lines that wait, of entries with this name

A GPU works through a queue. The CPU waits for it where it copies numbers (also from the CPU), asks
for a number (`bool`, `float`, `.any()` in an `if`), for a size that depends on numbers (`nonzero`,
masks as indices), or for the success of a factorisation. Run as a script, because the device stays
registered in its process; the compiled core takes no part, as for tensors of a GPU.
"""

import json
import sys
import traceback
import warnings
from collections import Counter
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path
from unittest import mock

import numpy as np
import torch
from pretended_device import NAME, Elsewhere, Pretended
from torch.utils import backend_registration
from torch.utils._pytree import tree_leaves

import hybridkin
from hybridkin import ELMRegressor, InverseKinematics
from hybridkin.ik import _box, _search
from hybridkin.ik._settings import StepSettings

FOLDER = Path(hybridkin.__file__).parent
ASKS = {"_local_scalar_dense", "equal", "_linalg_check_errors", "_linalg_eigh", "_linalg_svd"}
SIZES = {"nonzero", "masked_select", "_unique2", "unique_dim", "unique_consecutive", "bincount"}
INDEXED = {"index", "index_put", "index_put_"}
N = 32  # rows
EVALUATED = ("extensible segments", "rotating stage", "point on the backbone", "rigid arm")
EVALUATED += ("elastic tendons", "tendons by force", "network", "hybrid, network")
EVALUATED += ("hybrid, kernel ridge", "blend", "serial, quadratic", "adapted poses")
SOLVED = ("extensible segments", "hybrid, network")


class Waits(Pretended):
    """Count operations on the device, those that wait for it, and the rounds of loops."""

    def __init__(self):
        super().__init__()
        self.operations = 0
        self.lines = Counter()
        self.rounds = Counter()

    @property
    def count(self):
        return self.lines.total()

    def __torch_dispatch__(self, operation, types, args=(), kwargs=None):
        kwargs = kwargs or {}
        tensors = [a for a in tree_leaves((args, kwargs)) if isinstance(a, torch.Tensor)]
        if any(isinstance(a, Elsewhere) for a in tensors):
            self.operations += 1
        if waits(operation.overloadpacket.__name__, args, kwargs):
            self.lines[line_of_library()] += 1
        return super().__torch_dispatch__(operation, types, args, kwargs)


def waits(name, args, kwargs):
    """Return whether an operation waits for the device."""
    if name == "_to_copy":
        device = kwargs.get("device")
        there = isinstance(args[0], Elsewhere)
        return device is not None and there != (torch.device(device).type == NAME)
    if name == "copy_":
        return isinstance(args[0], Elsewhere) != isinstance(args[1], Elsewhere)
    if not isinstance(next(iter(tree_leaves(args)), None), Elsewhere):
        return False
    if name in INDEXED:
        # A number in place of masked entries is filled in without their count.
        fills = name != "index" and args[2].ndim == 0
        masks = [a for a in args[1] if a is not None and a.dtype == torch.bool]
        return bool(masks) and not fills
    if name == "repeat_interleave":
        return kwargs.get("output_size") is None
    return name in ASKS | SIZES


def line_of_library():
    """Return the place and the text of the innermost line of the library."""
    frames = traceback.extract_stack()
    ours = [frame for frame in frames if FOLDER in Path(frame.filename).parents]
    if not ours:
        return "outside"
    last = ours[-1]
    return f"{Path(last.filename).relative_to(FOLDER)}:{last.lineno} {last.line}"


def counted(work):
    """Return what a second call does; the first one may copy constants."""
    with Waits():
        work()
    with Waits() as seen, rounds_into(seen.rounds):
        work()
    return seen


@contextmanager
def rounds_into(rounds):
    """Count the rounds of the loops of inverse kinematics meanwhile."""

    def counting(name, function):
        def count(*args, **kwargs):
            rounds[name] += 1
            return function(*args, **kwargs)

        return count

    with ExitStack() as stack:
        for owner, name in (
            (_search.Search, "_lower_once"),
            (_search.Search, "_after_step"),
            (_search, "limited_step"),
            (_box, "solve_rows"),  # Newton's method in a box
            (StepSettings, "evaluate"),
        ):
            counted = counting(name, getattr(owner, name))
            stack.enter_context(mock.patch.object(owner, name, counted))
        yield


def with_question(work):
    """Return the work of a search that asks whether any row has arrived, in each iteration."""
    reached = _search.Search._reached

    def asking(search, at):
        arrived = reached(search, at)
        bool(arrived.any())
        return arrived

    def run():
        with mock.patch.object(_search.Search, "_reached", asking):
            work()

    return run


def entries():
    """Yield names of entry points, and their work on the device."""
    import gpu

    for name in EVALUATED:
        kind = gpu.KINDS[name]()
        with Pretended():
            module = gpu.moved(kind.module, NAME)
            q = kind.rows(N, part=1.2).to(NAME)
        yield f"{name}: FK and J", lambda m=module, q=q: m.forward_and_jacobian(q)
        yield f"{name}: FK", lambda m=module, q=q: m(q)
        yield f"{name}: in_domain", lambda m=module, q=q: m.in_domain(q)
        if module.has_pose:
            yield f"{name}: pose and J", lambda m=module, q=q: m.pose_and_jacobian(q)
    for name in SOLVED:
        kind = gpu.KINDS[name]()
        with Pretended():
            module = gpu.moved(kind.module, NAME)
            q = kind.rows(N, 1, 0.9).to(NAME)
            near = q + 0.1 * (kind.rows(N, 2, 0.9).to(NAME) - q)
            box = {"q_min": kind.low, "q_max": kind.high}
            ik = InverseKinematics(kind.task(module), **box, dq_max=0.1)
            target = ik.settings.task.evaluate(near)[0]
            tracker = ik.tracker(q[0])
        yield f"{name}: step", lambda ik=ik, q=q, x=target: ik.step(q, x)
        yield f"{name}: tracker.step", lambda t=tracker, x=target: t.step(x[0])
        solve = partial(ik.solve, target, restarts=0)
        yield f"{name}: solve", solve
        yield f"{name}: solve with a question", with_question(solve)
    X = np.random.default_rng(0).uniform(-1.0, 1.0, (40, 3))
    elm = ELMRegressor(8, input_scaling=[[-1.0] * 3, [1.0] * 3], device=NAME, random_state=0)
    yield "ELM: partial_fit", lambda: elm.partial_fit(X, np.sin(X))
    yield "ELM: fit", lambda: elm.fit(X, np.sin(X))
    yield "ELM: predict", lambda: elm.predict(X)


def say(text):
    sys.stdout.write(f"{text}\n")


def main(part=""):
    """Print a table, or as JSON what the test needs."""
    found = {}
    for name, work in entries():
        with torch.no_grad():
            seen = counted(work)
        found[name] = seen.count, dict(seen.rounds)
        if part != "--json":
            loops = ", ".join(f"{k} {n}" for k, n in seen.rounds.items())
            say(f"{seen.count:5d} of {seen.operations:6d}  {name}  {loops}")
        if part and part in name:
            for line, n in seen.lines.most_common():
                say(f"{n:8d}  {line}")
    if part == "--json":
        say(json.dumps(found))


if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).parents[1] / "examples" / "studies"))
    torch.set_num_threads(1)
    np.seterr(all="ignore")
    warnings.simplefilter("ignore")
    backend_registration._setup_privateuseone_for_python_backend(NAME)
    main(*sys.argv[1:])
