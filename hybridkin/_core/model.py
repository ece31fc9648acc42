"""The interface of all models, q -> x, and the conversion of other objects to it."""

from __future__ import annotations

import copy
import math
from bisect import bisect_left
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, ClassVar, Protocol, cast, runtime_checkable

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.autograd import grad

from hybridkin._core.actuation import DIRECT, Actuation
from hybridkin._core.actuators import ActuatorLayout
from hybridkin._core.arrays import identity
from hybridkin._core.blocks import check_tensor, check_vectors, in_blocks
from hybridkin._core.frames import Frames, Marker
from hybridkin._core.html import html_table
from hybridkin._core.plan import NoKernel, Plan
from hybridkin._core.planes import PlaneOfQ
from hybridkin._core.plausible import PlausibleRows
from hybridkin._core.portable import PortableModule
from hybridkin._core.stored import Layout, Stored

if TYPE_CHECKING:
    from pytorch_kinematics import Transform3d
    from typing_extensions import Self

Function = Callable[[Tensor], Tensor]
"""A function that works row by row."""


class ForwardModel(PortableModule):
    """A model of a robot: a torch module that maps every row of q to a row of x.

    Chains, error models, hybrids and wrapped functions are forward models; inverse kinematics,
    calibration and plots use nothing else. A subclass defines `forward`, and
    `forward_and_jacobian` if it has a closed form.

    Everything else is an answer that suits a model of which nothing is known: no geometry, no
    limits, no segments, no warnings. A model that knows more overrides it.

    Attributes
    ----------
    n_actuators : int
        Length of q; 0 if unknown, e.g. for a function.
    n_outputs : int
        Length of x; 0 if unknown.
    markers : tuple of K tuples of four floats
        Places of the points of the robot that are the outputs, in segments and their offset [m];
        empty: unknown.
    takes_lengths : bool
        Whether q holds lengths, or their changes, of a known geometry.
    """

    n_actuators: int = 0
    n_outputs: int = 0
    markers: tuple[Marker, ...] = ()
    takes_lengths: ClassVar[bool] = False

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

    # What is known of the actuators.

    @property
    def unit_of_q(self) -> str | list[str]:
        """Unit of q, or of each actuator."""
        return "as in training"

    @property
    def unit_of_x(self) -> str:
        """Unit of x."""
        return "as in training"

    @property
    def in_metres(self) -> bool:
        """Whether q is taken as metres, without a gain."""
        return True

    @property
    def actuator_layout(self) -> ActuatorLayout:
        """Rest, kind and segment of every actuator."""
        return ActuatorLayout.independent(self.n_actuators)

    @property
    def rings(self) -> tuple[slice, ...]:
        """Actuators that stand about the backbone together, segment by segment; maybe none."""
        return ()

    def effective_directions(self) -> NDArray:
        """Return the projector (n, n) on directions of q that move the robot; default: all."""
        return np.eye(self.n_actuators)

    def balanced(self, q: NDArray, low: NDArray, high: NDArray) -> NDArray:
        """Return rows near q (N, n) in which no tendons pull against each other, within limits.

        Rows that have no such neighbour are left out. Default: q itself.
        """
        return q

    def pulled(self, q: Tensor, low: Tensor, high: Tensor) -> Tensor:
        """Return how far actuators are pulled, 0 to 1, at q (..., n): from `high` to `low`."""
        return (high - q) / (high - low)

    def slack(self, q: Tensor) -> Tensor:
        """Return which actuators are slack at q (..., n), bool; default: none."""
        return torch.zeros_like(q, dtype=torch.bool)

    # What is known of the body.

    @property
    def hysteresis(self) -> Actuation:
        """The hysteresis between commands and q, which is what the actuators do; maybe none."""
        return DIRECT

    @property
    def has_pose(self) -> bool:
        """Whether the model has poses of the tip, as a chain has."""
        return False

    def geometry(self) -> dict[str, Tensor]:
        """Return the geometry by name; empty if the model has none that can be calibrated."""
        return {}

    @property
    def default_parameters(self) -> tuple[str, ...]:
        """Names of the entries of the geometry that a calibration fits by default."""
        return ()

    @property
    def origin(self) -> Tensor:
        """Where the base of the robot is in the measuring frame, shape (3,) [m]."""
        return torch.zeros(3, dtype=torch.float64, device="cpu")

    @property
    def reach(self) -> Tensor:
        """Length of the robot, the unit of its motions, shape () [m]; 1 where it is unknown."""
        return torch.ones((), dtype=torch.float64, device="cpu")

    @property
    def least_radius(self) -> float:
        """Smallest radius of the body [m]; infinite: unknown."""
        return math.inf

    @property
    def n_arcs(self) -> int:
        """Number of arcs of the body; 0: it is not made of arcs."""
        return 0

    @property
    def has_one_arc_per_segment(self) -> bool:
        """Whether the body is made of segments of one arc each."""
        return False

    def frames_and_moves(self, rows: Tensor) -> Frames:
        """Return the frames after all segments at rows q (N, n), with derivatives of the end.

        Only models with `n_arcs` have them.
        """
        raise NotImplementedError

    def with_tip(self, at: float) -> ForwardModel:
        """Return a model of another point of the robot, `at` in segments from the base."""
        raise TypeError(_without_body("have with_tip(at)", self))

    def body_lengths(self, q: Tensor) -> Tensor:
        """Return the length of the body from its start to the end of every segment [m].

        Parameters
        ----------
        q : Tensor of shape (..., n_actuators)
            Actuator vectors.

        Returns
        -------
        Tensor of shape (..., S + 1)
            Cumulative lengths at the places 0, 1, ..., S of `with_tip`; the first one is 0.

        Raises
        ------
        TypeError
            For models whose body is not known, e.g. functions.

        Examples
        --------
        >>> import torch
        >>> from hybridkin import ConstantCurvatureChain
        >>> chain = ConstantCurvatureChain([0.01] * 2, lengths=[0.1, 0.2], offsets=[0.05, 0.0])
        >>> chain.body_lengths(torch.zeros(6, dtype=torch.float64))
        tensor([0.0000, 0.1500, 0.3500], dtype=torch.float64)
        """
        raise TypeError(_without_body("have body_lengths(q)", self))

    def at_length(self, length: float, q: Tensor) -> ForwardModel:
        """Return the model of the point of the body after a length of it [m], as long as at q (n,).

        `length` is from 0, exclusive, to that of the whole body, inclusive.
        """
        ends = self.body_lengths(q).tolist()
        segment = max(bisect_left(ends, length, hi=len(ends) - 1), 1) - 1
        inside = (length - ends[segment]) / (ends[segment + 1] - ends[segment])
        return self.with_tip(segment + min(inside, 1.0))

    @property
    def body_radii(self) -> Tensor:
        """Radius of the body in every segment, shape (S,) [m]; infinite where it is unknown.

        Models whose body is not known raise a TypeError.
        """
        raise TypeError(_without_body("have body_radii", self))

    def joined(self, tips: list[ForwardModel]) -> ForwardModel:
        """Return the model of the points of several models of one point each, side by side."""
        return SideBySide(tips)

    # Other models of the same robot.

    @property
    def robot(self) -> ForwardModel:
        """The model with the geometry: the mechanical model of a hybrid, else the model itself."""
        return self

    @property
    def without_hysteresis(self) -> ForwardModel:
        """The model of actuators that do what they are commanded."""
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

    def softer(self) -> Sequence[ForwardModel]:
        """Return the same robot with actuators that give way, where that may matter."""
        return []

    def unit_messages(self, q: Tensor, name: str, factor: float = 1.0) -> list[str]:
        """Return warnings if q (N, n) holds values too large to be metres or radians.

        `factor` scales the limits.
        """
        return []

    def check_actuators(self, q: Tensor, name: str = "q") -> list[str]:
        """Return warnings about the units of q (..., n); raise if it cannot be a log."""
        return []

    def contradictions(self, q: Tensor, name: str = "q") -> list[str]:
        """Return a warning if the actuators of q (..., n) contradict each other."""
        return []

    def tip_messages(self, q: Tensor, x: Tensor, name: str, calibrated: bool = False) -> list[str]:
        """Return a warning if tips x (N, m), measured at rows q (N, n), span too far for metres.

        If the model is calibrated, its own tips are counted with them. Missing markers are NaN.
        """
        return []

    def plausible_rows(self) -> PlausibleRows:
        """Return bounds of rows that need no warning about units or contradictions."""
        return PlausibleRows.all_of(self.n_actuators)

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

    def by_rows(
        self,
        function: Callable[[Tensor], tuple[Tensor, ...]],
        q: Tensor,
        size: int = 4096,
    ) -> tuple[Tensor, ...]:
        """Return the tensors (..., K) of a function of rows (N, n) at q (..., n), by blocks."""
        return in_blocks(function, q, size)

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
    def is_stepwise(self) -> bool:
        """Whether a part of the model is constant almost everywhere, as trees are."""
        parts = [part for part in self.modules() if isinstance(part, ForwardModel)]
        return any(part.is_stepwise for part in parts if part is not self)

    @property
    def plane(self) -> PlaneOfQ:
        """The plane of q to keep to: the whole space if nothing is known of one."""
        return PlaneOfQ.whole()

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

    def tips_by_coordinates(self) -> Callable[[Tensor], tuple[Tensor, Tensor]]:
        """Return `from_coordinates_and_jacobian` for many calls without derivatives."""
        return self.from_coordinates_and_jacobian

    def up_to_tip(self, coordinates: Tensor) -> Tensor:
        """Return inner coordinates of the whole robot (C, ...), or their slope, up to the tip."""
        return coordinates

    def compliance_columns(self, q: Tensor) -> Tensor:
        """Return A (N, 3 K, C) at rows q (N, n): a force w at the tip moves it along A A' w.

        By default the actuators give way, all by as much.
        """
        return self.forward_and_jacobian(q)[1]

    # Poses, which a `PoseModel` has.

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

    # The robot after a change.

    def shifted(self, shift: Tensor) -> ForwardModel:
        """Return the model f(q + shift), after a shift (n,) of the actuator zeros [unit of q]."""
        return Shifted(self, shift) if shift.any() else self

    def moved(self, motion: Tensor) -> ForwardModel:
        """Return the model T f(q), after a motion T (4, 4) of the base."""
        return self if is_at_rest(motion) else Moved(self, motion)


class PoseModel(ForwardModel):
    """A forward model of the tip position that can also return the tip pose."""

    n_outputs: int = 3

    @property
    def unit_of_x(self) -> str:
        """Unit of x."""
        return "m"

    @property
    def has_pose(self) -> bool:
        """Whether the model has poses of the tip."""
        return True


class Wrapped(PoseModel):
    """A model that stands before or after another one, of positions or of poses.

    Parameters
    ----------
    model : ForwardModel
        The other model.
    """

    model: ForwardModel

    def __init__(self, model: ForwardModel) -> None:
        super().__init__()
        self.model = model
        self.n_actuators = model.n_actuators
        self.n_outputs = model.n_outputs

    @property
    def unit_of_q(self) -> str | list[str]:
        """Unit of q of the other model."""
        return self.model.unit_of_q

    @property
    def unit_of_x(self) -> str:
        """Unit of x of the other model."""
        return self.model.unit_of_x

    @property
    def has_pose(self) -> bool:
        """Whether the other model has poses."""
        return self.model.has_pose

    @property
    def robot(self) -> ForwardModel:
        """The model with the geometry, changed like this one."""
        robot = self.model.robot
        return self if robot is self.model else self.around(robot)

    @property
    def tip_model(self) -> ForwardModel:
        """The model of the tip alone, changed like this one."""
        tip = self.model.tip_model
        return self if tip is self.model else self.around(tip)

    @property
    def plane(self) -> PlaneOfQ:
        """The plane of the log."""
        return self.model.plane

    @property
    def hysteresis(self) -> Actuation:
        """The hysteresis between commands and q."""
        return self.model.hysteresis

    @property
    def without_hysteresis(self) -> ForwardModel:
        """The model of actuators that do what they are commanded."""
        return self.around(self.model.without_hysteresis)

    def with_tip(self, at: float) -> ForwardModel:
        """Return a model of another point of the robot, changed like this one."""
        return self.around(self.model.with_tip(at))

    def body_lengths(self, q: Tensor) -> Tensor:
        """Return the cumulative lengths (..., S + 1) of the other model's body [m]."""
        return self.model.body_lengths(self._inner(q))

    def at_length(self, length: float, q: Tensor) -> ForwardModel:
        """Return the model of the point after a length of the other model's body [m]."""
        return self.around(self.model.at_length(length, self._inner(q)))

    @property
    def body_radii(self) -> Tensor:
        """Radius of the other model's body in every segment, shape (S,) [m]."""
        return self.model.body_radii

    def around(self, model: ForwardModel) -> ForwardModel:
        """Return another model, changed like this one."""
        raise NotImplementedError

    def forward(self, q: Tensor) -> Tensor:
        """Return the outputs of the other model for what it gets, shape (..., m) [m]."""
        return self.model(self._inner(q))

    def forward_and_jacobian(self, q: Tensor) -> tuple[Tensor, Tensor]:
        """Return x (..., m) and dx/dq (..., m, n)."""
        return self.model.forward_and_jacobian(self._inner(q))

    def pose_and_jacobian(self, q: Tensor) -> tuple[Tensor, Tensor]:
        """Return `pose(q)` and `pose_jacobian(q)` in one pass."""
        return self.model.pose_and_jacobian(self._inner(q))

    def domain_distance(self, q: Tensor) -> Tensor:
        """Return the distance from the training rows of what the other model gets, (...)."""
        return self.model.domain_distance(self._inner(q))

    def has_shape(self, q: Tensor) -> Tensor:
        """Return whether the other model has a shape, (...), bool."""
        return self.model.has_shape(self._inner(q))

    def _inner(self, q: Tensor) -> Tensor:
        """Return what the other model gets for q."""
        return q


class SideBySide(ForwardModel):
    """The outputs of several models of one robot, one after another.

    Parameters
    ----------
    models : list of ForwardModel
        At least one.
    """

    def __init__(self, models: list[ForwardModel]) -> None:
        super().__init__()
        self.models = nn.ModuleList(models)
        self.n_actuators = models[0].n_actuators
        self.n_outputs = sum(model.n_outputs for model in models)

    def forward(self, q: Tensor) -> Tensor:
        """Return all outputs (..., m)."""
        return torch.cat([model(q) for model in self.models], dim=-1)

    def forward_and_jacobian(self, q: Tensor) -> tuple[Tensor, Tensor]:
        """Return all outputs (..., m) and their derivatives (..., m, n)."""
        outputs = []
        derivatives = []
        for model in self.models:
            x, J = cast(ForwardModel, model).forward_and_jacobian(q)
            outputs.append(x)
            derivatives.append(J)
        return torch.cat(outputs, dim=-1), torch.cat(derivatives, dim=-2)


def _place_within(plan: Plan, stored: Stored, *before: str) -> int:
    """Return the place of the model within; kernels know no model of the kinds `before` there."""
    place = plan.node_of(stored.part("model"))
    if plan.kind(place) in before:
        raise NoKernel(f"a model {plan.kind(place)} within one {stored.kind}")
    return place


def _write_shifted(plan: Plan, stored: Stored) -> int:
    model = _place_within(plan, stored, "shifted")
    n, m = plan.lengths(model)
    return plan.node("shifted", n, m, [stored.array("shift", (n,))], model)


class Shifted(Wrapped):
    """The model f(q + shift) of a robot whose actuator zeros have shifted.

    Parameters
    ----------
    model : ForwardModel
        f.
    shift : Tensor of shape (n,)
        Shift of the zeros [unit of q].
    """

    layout = Layout("shifted", {"shift": "n"}, parts=("model",), write_plan=_write_shifted)

    def __init__(self, model: ForwardModel, shift: Tensor) -> None:
        super().__init__(model)
        self.register_buffer("shift", shift)
        self.n_actuators = len(shift)

    @property
    def plane(self) -> PlaneOfQ:
        """The plane of the log, where it lies after the shift."""
        return self.model.plane.shifted(self.shift)

    def around(self, model: ForwardModel) -> ForwardModel:
        """Return another model after the same shift."""
        return model.shifted(self.shift)

    def misses(self, x: Tensor, largest: Tensor) -> Tensor:
        """Return by how much targets are out of reach of f, shape (...) [m]."""
        return self.model.misses(x, largest + self.shift.abs().to(largest.device))

    def _inner(self, q: Tensor) -> Tensor:
        check_vectors(q, len(self.shift), "q", f"this robot has {len(self.shift)} actuators")
        return q + self.shift.to(q)


def _write_moved(plan: Plan, stored: Stored) -> int:
    model = _place_within(plan, stored, "shifted", "moved")
    n, m = plan.lengths(model)
    motion = stored.array("motion", (4, 4))
    return plan.node("moved", n, m, [motion[:3, :3], motion[:3, 3]], model)


class Moved(Wrapped):
    """The model T f(q) of a robot whose base has moved.

    Parameters
    ----------
    model : ForwardModel
        f, whose outputs are one or several tips in space.
    motion : Tensor of shape (4, 4)
        T, the motion of the base in the measuring frame.
    """

    layout = Layout("moved", {"motion": "44"}, parts=("model",), write_plan=_write_moved)

    def __init__(self, model: ForwardModel, motion: Tensor) -> None:
        super().__init__(model)
        self.register_buffer("motion", motion)

    def around(self, model: ForwardModel) -> ForwardModel:
        """Return another model after the same motion."""
        return model.moved(self.motion)

    def forward(self, q: Tensor) -> Tensor:
        """Return T f(q), shape (..., m) [m]."""
        return moved_points(super().forward(q), self.motion)

    def forward_and_jacobian(self, q: Tensor) -> tuple[Tensor, Tensor]:
        """Return T f(q) (..., m) and its derivative (..., m, n)."""
        x, J = super().forward_and_jacobian(q)
        return moved_points(x, self.motion), _turned(J.mT, self.motion).mT

    def pose_and_jacobian(self, q: Tensor) -> tuple[Tensor, Tensor]:
        """Return `pose(q)` and `pose_jacobian(q)` in one pass."""
        T, J = super().pose_and_jacobian(q)
        return self.motion.to(T) @ T, _turned(J.mT, self.motion).mT

    def misses(self, x: Tensor, largest: Tensor) -> Tensor:
        """Return by how much targets before T are out of reach of f, shape (...) [m]."""
        before = moved_points(x, torch.linalg.inv(self.motion))
        return self.model.misses(before, largest)


def _without_body(need: str, model: ForwardModel) -> str:
    """Return the message of a model that knows no body."""
    return (
        f"`chain` must {need}, e.g. a chain of arcs or a RigidChain, got {type(model).__name__}; "
        "pass the chain, or of a hybrid its `robot`."
    )


def is_at_rest(motion: Tensor) -> bool:
    """Return whether a motion (4, 4) moves nothing."""
    return torch.equal(motion, identity(4, motion))


def moved_points(x: Tensor, motion: Tensor) -> Tensor:
    """Return points (..., 3), or several of them in (..., m), moved by a motion (4, 4)."""
    return _turned(x, motion) + motion[:3, 3].to(x).repeat(x.shape[-1] // 3)


def _turned(v: Tensor, motion: Tensor) -> Tensor:
    """Return vectors (..., 3), or several of them in (..., m), rotated by a motion (4, 4)."""
    return (v.unflatten(-1, (-1, 3)) @ motion[:3, :3].to(v).mT).flatten(-2)


class ZeroModel(ForwardModel):
    """The model x = 0 of n actuators: no mechanics, so that all of x is the residual."""

    def __init__(self, n_actuators: int, n_outputs: int) -> None:
        super().__init__()
        self.n_actuators = n_actuators
        self.n_outputs = n_outputs

    def forward(self, q: Tensor) -> Tensor:
        """Return zeros (..., m)."""
        return q.new_zeros(*q.shape[:-1], self.n_outputs)

    def forward_and_jacobian(self, q: Tensor) -> tuple[Tensor, Tensor]:
        """Return zeros (..., m) and (..., m, n)."""
        x = self(q)
        return x, x.new_zeros(*x.shape, self.n_actuators)


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
        raise TypeError(f"`model` must be two callables, q -> x and its Jacobian, got {model!r}.")
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
