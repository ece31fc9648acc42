"""Modules and objects that are pickled, described and stored alike in every process."""

from __future__ import annotations

import copy
from collections.abc import Callable
from contextlib import suppress
from typing import TYPE_CHECKING, Any, ClassVar

import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from hybridkin._core.arrays import as_array
from hybridkin._core.derived import KEPT, entries_of
from hybridkin._core.stored import KINDS_OF_MODELS, Layout, Restore, Stored

if TYPE_CHECKING:
    from typing_extensions import Self


class Portable:
    """An object whose pickle and joblib hash are the same in every process.

    Tensors, also those in dicts, are pickled as plain arrays. They are restored on their device,
    or on the CPU if this machine lacks it. What belongs to the process is not pickled.
    """

    def __init_subclass__(cls, **options: object) -> None:
        """Register a class that sets a `layout`, for plans and for files."""
        super().__init_subclass__(**options)
        layout = vars(cls).get("layout")
        if layout is not None and layout.kind:
            KINDS_OF_MODELS[layout.kind] = cls

    def __getstate__(self) -> dict[str, Any]:
        state = vars(self).copy()  # one copy: another thread may add its program
        for name in ("_program", "_lock", KEPT):
            state.pop(name, None)
        return _portable(state)

    def __copy__(self) -> Self:
        """Return a deep copy: the state holds arrays in place of tensors."""
        return copy.deepcopy(self)

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)


def _portable(state: dict[str, Any]) -> dict[str, Any]:
    """Return a state, and the dicts in it, with all tensors as arrays."""
    portable = type(state)()
    for name, value in state.items():
        if isinstance(value, Tensor):
            value = _Pickled(value)
        elif isinstance(value, dict):
            value = _portable(value)
        portable[name] = value
    return portable


class _Pickled:
    """A tensor that is pickled as an array; torch's own pickles contain memory addresses."""

    def __init__(self, tensor: Tensor) -> None:
        self.array = tensor.numpy(force=True)
        self.device = str(tensor.device)
        is_leaf = tensor.requires_grad and tensor.is_leaf  # a copy has no graph
        self.learned = isinstance(tensor, nn.Parameter), is_leaf

    def __reduce__(self) -> tuple[Callable[..., Tensor], tuple[Any, ...]]:
        if self.learned == (False, False):
            return _restored, (self.array, self.device)
        return _restored, (self.array, self.device, *self.learned)


def _restored(
    array: NDArray, device: str, parameter: bool = False, requires_grad: bool = False
) -> Tensor:
    tensor = torch.tensor(array, device="cpu")
    with suppress(AssertionError, RuntimeError):  # this machine may lack the device
        tensor = tensor.to(device)
    if parameter:
        return nn.Parameter(tensor, requires_grad)
    return tensor.requires_grad_(requires_grad)


class PortableModule(Portable, nn.Module):
    """A module of buffers whose pickle and joblib hash are the same in every process.

    A class that sets `layout` can be saved to files and compiled.
    """

    # no kind: it could only be stored as code.
    layout: ClassVar[Layout] = Layout("", {})
    # Entries of states of earlier versions that are computed from the others now.
    computed: ClassVar[tuple[str, ...]] = ()

    def stored(self) -> Stored:
        """Return the description of the module: kind, settings, arrays and parts.

        Raises
        ------
        TypeError
            For modules that could only be stored as code.
        """
        layout = self.layout
        if not layout.kind:
            raise TypeError(_only_code(self))
        parts = {name: _described(self._modules.get(name)) for name in layout.parts}
        settings = {name: vars(self)[name] for name in layout.settings}
        arrays = {}
        for name, entry in zip(layout.arrays, self.entries(), strict=True):
            arrays[name] = None if entry is None else entry.detach()
        stored = Stored.of(layout.kind, arrays, parts, **settings)
        for name in layout.derived:
            stored.derived[name] = as_array(getattr(self, name).detach())
        return stored

    def entries(self) -> list[Tensor | None]:
        """Return the entries of the state that describe the module, in the order of `layout`."""
        return entries_of(self, [*self.layout.arrays])

    @classmethod
    def from_stored(cls, stored: Stored, restore: Restore) -> Self:
        """Return the module built from a description; `restore` builds its parts."""
        arguments: dict[str, Any] = dict(stored.tensors(**cls.layout.arrays))
        for name, kind in cls.layout.settings.items():
            arguments[name] = stored.value(name, kind)
        for name in cls.layout.parts:
            part = stored.parts.get(name)
            arguments[name] = None if part is None else restore(part)
        return cls(**arguments)

    def _load_from_state_dict(
        self, state_dict: dict[str, Any], prefix: str, *args: Any, **kwargs: Any
    ) -> None:
        for key in [*state_dict]:
            if key.removeprefix(prefix).split(".")[0] in self.computed:
                del state_dict[key]
        super()._load_from_state_dict(state_dict, prefix, *args, **kwargs)

    if TYPE_CHECKING:  # attributes that no statement assigns are buffers

        def __getattr__(self, name: str) -> Tensor: ...


def _described(module: nn.Module | None) -> Stored | None:
    if module is None:
        return None
    if isinstance(module, PortableModule):
        return module.stored()
    if not isinstance(module, nn.ModuleList):
        raise TypeError(_only_code(module))
    parts = {str(k): _described(part) for k, part in enumerate(module)}
    return Stored.of("list", parts=parts)


def _only_code(module: nn.Module) -> str:
    return (
        f"a {type(module).__name__} could only be stored as code; a saved model is made of chains "
        "(ConstantCurvatureChain, ElasticTendonChain, RigidChain) and of error models given by "
        "name, ELMs, a LinearRegression or a KernelRidge with the kernel 'rbf'."
    )
