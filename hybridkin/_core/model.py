"""The interface of all models, q -> x, and the conversion of other objects to it."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import TYPE_CHECKING, Any, ClassVar, Protocol, runtime_checkable

import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.autograd import grad

from hybridkin._core.actuators import ActuatorLayout
from hybridkin._core.arrays import as_array
from hybridkin._core.blocks import check_tensor
from hybridkin._core.derived import KEPT, entries_of
from hybridkin._core.html import html_table
from hybridkin._core.stored import KINDS_OF_MODELS, Layout, Restore, Stored

if TYPE_CHECKING:
    from pytorch_kinematics import Transform3d
    from typing_extensions import Self

Function = Callable[[Tensor], Tensor]
"""A function that works row by row."""


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
        rows: dict[str, object] = {
            "structure": self.extra_repr() or None,
            "actuators": self.n_actuators or "not known",
            "outputs": self.n_outputs or "not known",
        }
        for name, part in self.named_children():
            if isinstance(part, ForwardModel):
                rows[name] = part.html_rows()
        return rows

    @property
    def limits(self) -> dict[str, Any]:
        """Defaults of `q_min`, `q_max`, `dq_max` and `ddq_max` of `InverseKinematics`."""
        unlimited = dict.fromkeys(("q_min", "q_max", "dq_max", "ddq_max"), math.inf)
        return {**unlimited, "q_min": -math.inf}

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
        """Whether the model has poses of the tip, as a chain has."""
        return False

    @property
    def robot(self) -> ForwardModel:
        """The model with the geometry: the mechanical model of a hybrid, else the model itself."""
        return self

    @property
    def without_errors(self) -> ForwardModel:
        """The model without errors of its structure; the model itself if it knows none."""
        return self

    @property
    def tip_model(self) -> ForwardModel:
        """The model of the tip alone: the last one of several markers, else the model itself."""
        return self

    def each_tip(self) -> list[Any]:
        """Return one model for each point of the robot: a chain of K markers has K."""
        return [self]

    @property
    def actuator_layout(self) -> ActuatorLayout:
        """Rest, kind and segment of every actuator."""
        return ActuatorLayout.independent(self.n_actuators)

    def softer(self) -> Sequence[ForwardModel]:
        """Return the same robot with actuators that give way, where that may matter."""
        return []

    def unit_messages(self, q: Tensor, name: str, factor: float = 1.0) -> list[str]:
        """Return warnings if q (N, n) holds values too large to be metres or radians.

        `factor` scales the limits.
        """
        return []

    @property
    def size(self) -> float:
        """Size of the robot [m]; infinite: unknown."""
        return math.inf

    @property
    def farthest(self) -> float:
        """Distance from a tip beyond which a target is in another unit [m]; infinite: unknown."""
        return math.inf

    @property
    def longest_usual(self) -> float:
        """Length of q up to which `unit_messages` has nothing to say; infinite: unknown."""
        return math.inf

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
        return (self.domain_distance(q) <= 1.0) & self.has_shape(q)

    def has_shape(self, q: Tensor) -> Tensor:
        """Return whether the robot has a shape at q, shape (...), bool: elastic ones may not."""
        return torch.ones_like(q[..., 0], dtype=torch.bool)

    @property
    def plane(self) -> tuple[Tensor, Tensor] | None:
        """A point (n,) and orthonormal normals (n, k) of the plane of q to keep to, if any."""
        return None

    def frozen(self) -> Self:
        """Return a copy without derivatives by its state, which does not change with this model."""
        twin = copy.deepcopy(self)
        for entry in (*twin.parameters(), *twin.buffers()):
            entry.requires_grad_(False)
        return twin

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

    def compliance_columns(self, q: Tensor) -> Tensor:
        """Return A (N, 3 K, C) at rows q (N, n): a force w at the tip moves it along A A' w.

        By default the actuators give way, all by as much.
        """
        return self.forward_and_jacobian(q)[1]


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
        Works row by row. A module computes in the dtype of its parameters.
    jacobian : callable, optional
        Maps q to dx/dq (..., m, n). Default: reverse mode.
    """

    def __init__(self, function: Function, jacobian: Function | None = None) -> None:
        super().__init__()
        self.function = function
        self.derivative = jacobian

    def frozen(self) -> Self:
        """Return this model: a function is called as it is, and may not have copies."""
        return self

    def forward(self, q: Tensor) -> Tensor:
        """Return x of shape (..., m)."""
        return _called(self.function, q)

    def forward_and_jacobian(self, q: Tensor) -> tuple[Tensor, Tensor]:
        """Return x (..., m) and dx/dq (..., m, n)."""
        if self.derivative is None:
            return reverse_jacobian(self, q)
        return self(q), _called(self.derivative, q)


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
        by its ``module_``. A module with more than `forward` derives from `ForwardModel`.

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
        if len(model) == 2 and callable(model[0]) and callable(model[1]):
            return FunctionModel(*model)
        raise TypeError(
            f"`model` must be two callables, q -> x and its Jacobian, got {model!r}."
        )
    if isinstance(model, Fitted):
        return as_forward_model(model.module_)
    if not callable(model):
        if hasattr(model, "get_params"):
            # Takes a second; the estimator has loaded it.
            from sklearn.utils.validation import check_is_fitted

            check_is_fitted(model)
        raise TypeError(
            "`model` must be a torch module, a callable q -> x or a fitted regressor with a "
            f"`module_`, got {type(model).__name__}; fit another regressor or a pipeline by "
            "HybridForwardModel(None, error_model=regressor).fit(q, x) and pass that; "
            "for a search pass its `best_estimator_`, for a robot description its `chain`."
        )
    return FunctionModel(model)  # pyright: ignore[reportArgumentType]


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


def reverse_jacobian(function: Function, q: Tensor) -> tuple[Tensor, Tensor]:
    """Return x and dx/dq by one backward pass per output coordinate."""
    keep = q.requires_grad and torch.is_grad_enabled()
    with torch.enable_grad():
        leaf = q if keep else q.detach().requires_grad_(True)
        x = function(leaf)
        J = slopes(x, leaf, create_graph=keep)
    if keep:
        return x, J
    return x.detach(), J.detach()


def slopes(x: Tensor, leaf: Tensor, create_graph: bool = False) -> Tensor:
    """Return dx/dq (..., m, n) for rows x (..., m) computed from the rows of a leaf tensor q."""
    rows = []
    for component in x.unbind(-1):
        (slope,) = grad(
            component.sum(),
            leaf,
            create_graph=create_graph,
            retain_graph=True,
            materialize_grads=True,
        )
        rows.append(slope)
    return torch.stack(rows, dim=-2)


def _called(function: Function, q: Tensor) -> Tensor:
    """Return what a function gives for q; a module computes in the dtype of its parameters."""
    dtype = q.dtype
    if isinstance(function, nn.Module):
        dtypes = (weight.dtype for weight in function.parameters())
        dtype = next((kind for kind in dtypes if kind.is_floating_point), dtype)
    x = function(q.to(dtype))
    if not isinstance(x, Tensor):
        raise TypeError(
            f"`model` must return torch tensors, got {type(x).__name__}; for NumPy functions use "
            "`tasks.PositionTask.from_numpy(function, jacobian)`."
        )
    return x if dtype == q.dtype else x.to(q.dtype)


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
