"""What modules compute from their state, kept until the state changes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial, wraps
from typing import Generic, TypeVar

import torch
from torch import Tensor, nn
from torch.autograd import forward_ad

from hybridkin._core.constants import outlives_transforms

Tensors = TypeVar("Tensors", bound=tuple[Tensor, ...])
KEPT = "_derived"
"""The attribute of a module with what it keeps; pickles do without it."""


def derived(
    *names: str,
) -> Callable[[Callable[..., Tensors]], Callable[..., Tensors]]:
    """Return a decorator of methods that compute tensors from entries of a module's state.

    The result is kept until an entry is another tensor or holds other numbers, however they were
    written. On another device than the CPU a comparison of numbers would wait for it: there every
    write counts that torch counts, which are all except those through ``.data``. The result is
    computed anew where derivatives by the state may be asked for, in functional transforms of the
    state, and while torch compiles.

    Parameters
    ----------
    *names : str
        The parameters and buffers, or None, that the result depends on. Further arguments of the
        method are compared.
    """

    def decorate(compute: Callable[..., Tensors]) -> Callable[..., Tensors]:
        place = compute.__name__

        @wraps(compute)
        def current(module: nn.Module, *settings: object) -> Tensors:
            if torch.compiler.is_compiling():
                return compute(module, *settings)
            kept = module.__dict__.get(KEPT, {}).get(place)
            if kept is not None and kept.holds(module, settings):
                return kept.values
            present = _at_present(module)
            entries = dict(zip(names, entries_of(present, names), strict=True))
            if _has_derivatives(entries):
                return compute(present, *settings)
            try:
                kept = _Kept(entries, settings)
            except (RuntimeError, TypeError):
                return compute(present, *settings)
            # Later derivatives cannot use tensors of the inference mode.
            with torch.inference_mode(False), torch.no_grad():
                values = compute(present, *settings)
            if kept.keeps(values):  # at once, for other threads
                module.__dict__.setdefault(KEPT, {})[place] = kept
            return values

        return current

    return decorate


def entries_of(module: nn.Module, names: Sequence[str]) -> list[Tensor | None]:
    """Return entries of the state of a module: buffers, parameters or None."""
    buffers = module._buffers  # faster than attributes
    entries = []
    for name in names:
        entries.append(buffers[name] if name in buffers else getattr(module, name))
    return entries


def _at_present(module: nn.Module) -> nn.Module:
    """Return the module with its present entries, whatever other threads assign meanwhile."""
    present = object.__new__(type(module))
    state = vars(module).copy()
    for place in ("_buffers", "_parameters"):
        state[place] = state[place].copy()
    vars(present).update(state)
    return present


class _Kept(Generic[Tensors]):
    """A result, and the entries of a state that it was computed from.

    On the CPU they are compared by their bytes, because writes through ``.data`` or NumPy do not
    change the version of a tensor; elsewhere by their version.

    Raises
    ------
    RuntimeError, TypeError
        For tensors without memory, as in functional transforms.
    """

    def __init__(self, entries: dict[str, Tensor | None], settings: tuple[object, ...]) -> None:
        self.settings = settings
        self.values: Tensors | None = None
        self._absent = [name for name, entry in entries.items() if entry is None]
        self._entries = []
        for name, entry in entries.items():
            if entry is None:
                continue
            read = partial(_version, entry)
            if entry.device.type == "cpu":
                read = entry.detach().numpy().tobytes
            place = entry.data_ptr()
            self._entries.append((name, entry, place, entry.stride(), read, read()))

    def holds(self, module: nn.Module, settings: tuple[object, ...]) -> bool:
        """Return whether the module still has the same entries, with the same numbers."""
        buffers = module._buffers
        learns = torch.is_grad_enabled()
        for name, entry, place, stride, read, content in self._entries:
            if (
                (buffers[name] if name in buffers else getattr(module, name)) is not entry
                or (learns and entry.requires_grad)
                or entry.data_ptr() != place
                or entry.stride() != stride
                or read() != content
            ):
                return False
        for name in self._absent:
            if getattr(module, name) is not None:
                return False
        return settings == self.settings and forward_ad._current_level < 0

    def keeps(self, values: Tensors) -> bool:
        """Keep a result; return whether it may be used later."""
        self.values = values
        return all(outlives_transforms(value) for value in values)


def _version(entry: Tensor) -> int:
    """Return how often a tensor was written; raise a RuntimeError if nobody counts."""
    return entry._version


def _has_derivatives(entries: dict[str, Tensor | None]) -> bool:
    """Return whether derivatives by entries may be asked for."""
    if forward_ad._current_level >= 0:
        return True
    asked = [entry is not None and entry.requires_grad for entry in entries.values()]
    return torch.is_grad_enabled() and any(asked)
