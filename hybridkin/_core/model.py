"""The interface of all models, q -> x, and the conversion of other objects to it."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple, Protocol, runtime_checkable

import torch
from numpy.typing import NDArray
from sklearn.base import BaseEstimator
from sklearn.utils.validation import check_is_fitted
from torch import Tensor, nn
from torch.autograd import grad

from hybridkin._core.arrays import as_array
from hybridkin._core.blocks import check_tensor
from hybridkin._core.html import html_table
from hybridkin._core.stored import KINDS_OF_MODELS, Layout, Restore, Stored

if TYPE_CHECKING:
    from pytorch_kinematics import Transform3d
    from typing_extensions import Self


class _Closed(NamedTuple):
    """A tensor as it is pickled; torch's own pickles contain memory addresses."""

    array: NDArray
    device: str


class Portable:
    """An object whose pickle and joblib hash are the same in every process.

    Tensors, also those in dicts, are pickled as plain arrays. They are restored on their device,
    else on the first device of its kind, else on the CPU. What belongs to the process is not
    pickled.
    """

    def __init_subclass__(cls, **options: Any) -> None:
        """Register a class that sets a `layout`, for plans and for files."""
        super().__init_subclass__(**options)
        layout = vars(cls).get("layout")
        if layout is not None and layout.kind:
            KINDS_OF_MODELS[layout.kind] = cls

    def __getstate__(self) -> dict[str, Any]:
        state = vars(self).copy()  # one copy: another thread may add its program
        return _closed(
            {k: value for k, value in state.items() if "_program" != k != "_lock"}
        )

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(_opened(state))


def _closed(value: object) -> Any:
    if isinstance(value, dict):
        return type(value)((key, _closed(entry)) for key, entry in value.items())
    tensor = isinstance(value, Tensor)
    return _Closed(value.numpy(force=True), str(value.device)) if tensor else value


def _opened(value: object) -> Any:
    if isinstance(value, dict):
        return type(value)((key, _opened(entry)) for key, entry in value.items())
    if not isinstance(value, _Closed):
        return value
    return torch.tensor(value.array, device=_present(torch.device(value.device)))


def _present(device: torch.device) -> torch.device:
    """Return a device, or the first one of its kind, or the CPU, whatever this machine has."""
    count = torch.cuda.device_count() if device.type == "cuda" else 0
    if device.type != "cpu" and count == 0:
        return torch.device("cpu")
    if device.index is not None and device.index >= count > 0:
        return torch.device(device.type, 0)
    return device


class PortableModule(Portable, nn.Module):
    """A module of buffers whose pickle and joblib hash are the same in every process.

    A class that sets `layout` can be saved to files and compiled.
    """

    # no kind: it could only be stored as code.
    layout: ClassVar[Layout] = Layout("", {})

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
        buffers = {
            name: None if a is None else a.detach() for name, a in self._buffers.items()
        }
        stored = Stored.of(
            layout.kind,
            {name: buffers[name] for name in layout.arrays},
            {name: _described(self._modules.get(name)) for name in layout.parts},
            **{name: vars(self)[name] for name in layout.settings},
        )
        for name in layout.derived:
            stored.derived[name] = as_array(self.get_buffer(name).detach())
        return stored

    @classmethod
    def from_stored(cls, stored: Stored, restore: Restore) -> Self:
        """Return the module built from a description; `restore` builds its parts."""
        parts = {name: stored.parts.get(name) for name in cls.layout.parts}
        return cls(
            **stored.tensors(**cls.layout.arrays),
            **{
                name: stored.value(name, kind)
                for name, kind in cls.layout.settings.items()
            },
            **{
                name: None if part is None else restore(part)
                for name, part in parts.items()
            },
        )

    if TYPE_CHECKING:  # attributes that no statement assigns are buffers

        def __getattr__(self, name: str) -> Tensor: ...


class ForwardModel(PortableModule):
    """A model of a robot: a torch module that maps every row of q to a row of x.

    Chains, error models, hybrids and wrapped functions are forward models; inverse kinematics,
    calibration and plots use nothing else. A subclass defines `forward`, and
    `forward_and_jacobian` if it has a closed form.

    Attributes
    ----------
    n_actuators : int
        Length of q; 0 if unknown, e.g. for a function.
    n_outputs : int
        Length of x; 0 if unknown.
    """

    n_actuators: int = 0
    n_outputs: int = 0

    def _repr_html_(self) -> str:
        return html_table(type(self).__name__, self.html_rows())

    def html_rows(self) -> dict[str, object]:
        """Return names and values that a notebook shows of the model."""
        parts = self.named_children()
        return {
            "structure": self.extra_repr() or None,
            "actuators": self.n_actuators or "not known",
            "outputs": self.n_outputs or "not known",
            **{
                name: part.html_rows()
                for name, part in parts
                if isinstance(part, ForwardModel)
            },
        }

    @property
    def limits(self) -> dict[str, Any]:
        """Defaults of `q_min`, `q_max` and `dq_max` of `InverseKinematics`."""
        return {"q_min": -math.inf, "q_max": math.inf, "dq_max": math.inf}

    @property
    def turns(self) -> Tensor | bool:
        """Actuators that are angles with a period of one turn, bool () or (n,)."""
        return False

    @property
    def pulls(self) -> Tensor | float:
        """Sign of q in which an actuator can only pull, () or (n,); 0 if it can also push."""
        return 0.0

    @property
    def has_pose(self) -> bool:
        """Whether the model has poses of the tip, as a `PoseModel`."""
        return False

    @property
    def robot(self) -> ForwardModel:
        """The model with the geometry: the mechanical model of a hybrid, else the model itself."""
        return self

    @property
    def tip_model(self) -> ForwardModel:
        """The model of the tip alone: the last one of several markers, else the model itself."""
        return self

    def unit_messages(self, q: Tensor, name: str, factor: float = 1.0) -> list[str]:
        """Return warnings if q (N, n) holds values too large to be metres or radians.

        `factor` scales the limits.
        """
        return []

    def far_messages(self, x: Tensor, name: str) -> list[str]:
        """Return warnings if tips (..., 3) lie too far from the base to be in metres."""
        return []

    def misses(self, x: Tensor, largest: Tensor) -> Tensor:
        """Return lower bounds (...) of the distances [m] from targets x (..., m) to all tips.

        All tips of q with ``|q| <= largest``, shape () or (n,). Default: 0, no bound is known.
        """
        return x.new_zeros(x.shape[:-1])

    def forward(self, q: Tensor) -> Tensor:
        """Return x of shape (..., n_outputs) for q of shape (..., n_actuators)."""
        raise NotImplementedError

    def forward_and_jacobian(self, q: Tensor) -> tuple[Tensor, Tensor]:
        """Return x (..., n_outputs) and dx/dq (..., n_outputs, n_actuators).

        By default one backward pass per output coordinate.
        """
        return reverse_jacobian(self, q)

    def jacobian(self, q: Tensor) -> Tensor:
        """Return dx/dq, shape (..., n_outputs, n_actuators)."""
        return self.forward_and_jacobian(q)[1]

    def domain_distance(self, q: Tensor) -> Tensor:
        """Return the relative distance of q from the training rows, shape (...).

        At most 1 inside the domain, larger outside; 0 without training rows. Differentiable.
        """
        check_tensor(q, "q")
        return q.new_zeros(q.shape[:-1])

    def in_domain(self, q: Tensor) -> Tensor:
        """Return whether q lies inside the domain of the model, shape (...), bool."""
        return self.domain_distance(q) <= 1.0

    @property
    def plane(self) -> tuple[Tensor, Tensor] | None:
        """A point (n,) and orthonormal normals (n, k) of the plane of q to keep to, if any."""
        return None

    def frozen(self) -> Self:
        """Return a copy, which does not change with this model."""
        return copy.deepcopy(self)

    # Serial coupling corrects a model at inner coordinates z between q and x. By default z is q.

    def coordinates(self, q: Tensor) -> tuple[Tensor, Tensor]:
        """Return the inner coordinates z (N, C) of rows q (N, n) and dz/dq, (C, n) or (N, C, n)."""
        return q, torch.eye(q.shape[1], dtype=q.dtype, device=q.device)

    def from_coordinates(self, z: Tensor) -> Tensor:
        """Return x (N, m) of inner coordinates z (N, C)."""
        return self(z)

    def from_coordinates_and_jacobian(self, z: Tensor) -> tuple[Tensor, Tensor]:
        """Return x (N, m) of inner coordinates z (N, C) and dx/dz (N, m, C)."""
        return self.forward_and_jacobian(z)


class PoseModel(ForwardModel):
    """A forward model of the tip position that can also return the tip pose."""

    n_outputs: int = 3

    @property
    def has_pose(self) -> bool:
        """Whether the model has poses of the tip."""
        return True

    def pose(self, q: Tensor) -> Tensor:
        """Return the tip's pose in the measuring frame, shape (..., 4, 4)."""
        return self.pose_and_jacobian(q)[0]

    def pose_jacobian(self, q: Tensor) -> Tensor:
        """Return the tip's linear and angular Jacobian, shape (..., 6, n_actuators).

        The angular rows give the angular velocity in the measuring frame.
        """
        return self.pose_and_jacobian(q)[1]

    def pose_and_jacobian(self, q: Tensor) -> tuple[Tensor, Tensor]:
        """Return `pose(q)` and `pose_jacobian(q)` in one pass."""
        raise NotImplementedError

    def tip_transform(self, q: Tensor) -> Transform3d:
        """Return the tip pose as a pytorch_kinematics Transform3d, for q of shape (N, n)."""
        from pytorch_kinematics import Transform3d  # takes a second and loads pyplot

        return Transform3d(matrix=self.pose(q))


class FunctionModel(ForwardModel):
    """Any function q (..., n) -> x (..., m), torch to torch, as a forward model.

    Parameters
    ----------
    function : nn.Module or callable
        Works row by row. If it has the methods ``forward_and_jacobian`` or ``jacobian``,
        ``in_domain`` or the attribute ``n_actuators``, they are used.
    jacobian : callable, optional
        Maps q to dx/dq (..., m, n). Default: the module's own, else reverse mode.
    """

    def __init__(
        self, function: Callable[..., Any], jacobian: Callable[..., Any] | None = None
    ) -> None:
        super().__init__()
        self.function = function
        names = ("jacobian", "forward_and_jacobian", "in_domain", "n_actuators")
        own_jacobian, pair, self.own_domain, n = (
            getattr(function, name, None) for name in names
        )
        if jacobian is None:
            self.own_jacobian = own_jacobian
            self.own_pair = pair
        else:
            self.own_jacobian = jacobian
            self.own_pair = None
        self.n_actuators = int(n or 0)

    def frozen(self) -> Self:
        """Return this model: a function is called as it is, and may not have copies."""
        return self

    def forward(self, q: Tensor) -> Tensor:
        """Return x of shape (..., m)."""
        return _checked(self.function(q))

    def forward_and_jacobian(self, q: Tensor) -> tuple[Tensor, Tensor]:
        """Return x (..., m) and dx/dq (..., m, n)."""
        if self.own_pair is not None:
            return self.own_pair(q)
        if self.own_jacobian is not None:
            return self(q), _checked(self.own_jacobian(q))
        return reverse_jacobian(self, q)

    def domain_distance(self, q: Tensor) -> Tensor:
        """Return 0 inside the domain of the function and 2 outside, shape (...)."""
        if self.own_domain is None:
            return super().domain_distance(q)
        inside = torch.as_tensor(self.own_domain(q), device=q.device)
        return torch.where(inside, 0.0, 2.0).to(q)


@runtime_checkable
class Fitted(Protocol):
    """A fitted estimator. Every fit sets another module; none changes."""

    module_: nn.Module


def as_forward_model(model: object) -> ForwardModel:
    """Return a model of a robot as a `ForwardModel`.

    Parameters
    ----------
    model : ForwardModel, nn.Module, callable, (callable, callable) or fitted estimator
        A function or module maps q ``(..., n)`` to x ``(..., m)`` row by row, torch to torch; a
        pair is such a function and its Jacobian ``(..., m, n)``. A fitted estimator is replaced
        by its ``module_``.

    Returns
    -------
    ForwardModel
        The model itself if it is a `ForwardModel`.

    Raises
    ------
    TypeError
        For anything else.

    Examples
    --------
    >>> import torch
    >>> from hybridkin import as_forward_model
    >>> square = as_forward_model(lambda q: q**2)
    >>> square.jacobian(torch.tensor([1.0, 3.0]))
    tensor([[2., 0.],
            [0., 6.]])
    """
    if isinstance(model, ForwardModel):
        return model
    if isinstance(model, (tuple, list)):
        if len(model) != 2 or not all(callable(part) for part in model):
            raise TypeError(
                f"`model` must be two callables, q -> x and its Jacobian, got {model!r}."
            )
        return FunctionModel(*model)
    if isinstance(model, Fitted):
        return as_forward_model(model.module_)
    if not callable(model):
        if isinstance(model, BaseEstimator):
            check_is_fitted(model)
        raise TypeError(
            "`model` must be a torch module, a callable q -> x or a fitted regressor with a "
            f"`module_`, got {type(model).__name__}; fit another regressor or a pipeline by "
            "HybridForwardModel(None, error_model=regressor).fit(q, x) and pass that; "
            "for a search pass its `best_estimator_`, for a robot description its `chain`."
        )
    return FunctionModel(model)


def jacobian(model: object, q: Tensor) -> Tensor:
    """Return dx/dq of any model that maps each row of q independently to a row of x.

    In closed form if the model has one, else by one backward pass per output coordinate.

    Parameters
    ----------
    model : ForwardModel, nn.Module or callable
        Maps ``(..., n)`` to ``(..., m)``, row by row; see `as_forward_model`.
    q : Tensor of shape (..., n)
        Actuator vectors.

    Returns
    -------
    Tensor of shape (..., m, n)
        Jacobian at every row.

    Examples
    --------
    >>> import torch
    >>> from hybridkin import jacobian
    >>> jacobian(lambda q: q**2, torch.tensor([1.0, 3.0]))
    tensor([[2., 0.],
            [0., 6.]])
    """
    check_tensor(q, "q")
    return as_forward_model(model).jacobian(q)


def reverse_jacobian(
    function: Callable[[Tensor], Tensor], q: Tensor
) -> tuple[Tensor, Tensor]:
    """Return x and dx/dq by one backward pass per output coordinate."""
    keep = q.requires_grad and torch.is_grad_enabled()
    with torch.enable_grad():
        leaf = q if keep else q.detach().requires_grad_(True)
        x = function(leaf)
        J = slopes(x, leaf, create_graph=keep)
    return (x, J) if keep else (x.detach(), J.detach())


def slopes(x: Tensor, leaf: Tensor, create_graph: bool = False) -> Tensor:
    """Return dx/dq (..., m, n) for rows x (..., m) computed from the rows of a leaf tensor q."""
    slope = partial(
        grad, create_graph=create_graph, retain_graph=True, materialize_grads=True
    )
    return torch.stack([slope(a.sum(), leaf)[0] for a in x.unbind(-1)], dim=-2)


def _checked(x: object) -> Tensor:
    if not isinstance(x, Tensor):
        raise TypeError(
            f"`model` must return torch tensors, got {type(x).__name__}; for NumPy functions use "
            "`tasks.PositionTask.from_numpy(function, jacobian)`."
        )
    return x


def _described(module: nn.Module | None) -> Stored | None:
    if module is None or isinstance(module, PortableModule):
        return None if module is None else module.stored()
    if not isinstance(module, nn.ModuleList):
        raise TypeError(_only_code(module))
    return Stored.of(
        "list", parts={str(k): _described(part) for k, part in enumerate(module)}
    )


def _only_code(module: nn.Module) -> str:
    return (
        f"a {type(module).__name__} could only be stored as code; a saved model is made of chains "
        "(ConstantCurvatureChain, ElasticTendonChain, RigidChain) and of error models given by "
        "name, ELMs, a LinearRegression or a KernelRidge with the kernel 'rbf'."
    )
