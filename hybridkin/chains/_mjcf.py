"""Rigid arms in MuJoCo's MJCF: the joints from one body to another body or site."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from importlib import import_module
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hybridkin.chains._arm_files import (
    Joint,
    JointLimits,
    check_link,
    offset_origin,
    source_of,
)

if TYPE_CHECKING:
    from mujoco import MjModel  # pyright: ignore[reportAttributeAccessIssue]

# Numbers of MuJoCo's enumerations.
_KINDS = {2: "prismatic", 3: "revolute"}  # mjJNT_SLIDE, mjJNT_HINGE
_CLOSES_A_LOOP = {0: "connect", 1: "weld"}  # mjEQ_CONNECT, mjEQ_WELD
_OF_JOINTS = 2  # mjEQ_JOINT
_OF_TENDONS = 3  # mjEQ_TENDON
_DRIVES_A_JOINT = (0, 1)  # mjTRN_JOINT, mjTRN_JOINTINPARENT
_DRIVES_A_TENDON = 3  # mjTRN_TENDON
_FIXED_TENDON = 1  # mjWRAP_JOINT
_NONE = -1  # the number of an object that an element does not name


def mjcf_path(
    text_or_path: str | PathLike[str], end_link: str, root_link: str | None
) -> list[Joint]:
    """Return the joints of a MuJoCo model from one body to another body or site."""
    try:
        mujoco = import_module("mujoco")
    except ImportError as error:
        raise ImportError(
            "RigidChain.from_mjcf needs MuJoCo: pip install 'hybridkin[sim]'."
        ) from error
    source = source_of(text_or_path)
    try:
        if isinstance(source, Path):
            model = mujoco.MjModel.from_xml_path(str(source))
        else:
            model = mujoco.MjModel.from_xml_string(source)
    except (ValueError, RuntimeError, MemoryError) as error:
        raise ValueError(f"`text_or_path` must be a valid MJCF: {error!s:.400}.") from error
    bodies = {model.body(i).name: i for i in range(model.nbody)}
    sites = {model.site(i).name: i for i in range(model.nsite)}
    check_link(end_link, [*bodies, *sites], "end_link")
    # MuJoCo's own kinematics at q = 0: global poses, anchors and axes.
    data = mujoco.MjData(model)
    data.qpos[:] = 0.0
    mujoco.mj_kinematics(model, data)
    if end_link in bodies:
        body = bodies[end_link]
        end = data.body(body)
    else:
        body = model.site_bodyid[sites[end_link]]
        end = data.site(sites[end_link])
    root = 0
    if root_link is not None:
        check_link(root_link, [*bodies], "root_link")
        root = bodies[root_link]
    carrying = _carrying(model, root, body)
    if carrying is None:
        raise ValueError(f"`root_link` must lead to {end_link!r}, but {root_link!r} does not.")
    _warn_of_loops(model, carrying)
    couplings = _Couplings(model)
    path: list[Joint] = []
    before = _pose(data.xpos[root], data.xmat[root])
    joints = _joints_of(model, carrying)
    for j in joints:
        carried = data.body(model.jnt_bodyid[j])
        kind = _kind(model, j)
        placed = _pose(carried.xpos, carried.xmat)
        if kind == "revolute":
            placed[:3, 3] = data.xanchor[j]
        origin = np.linalg.solve(before, placed)
        axis = placed[:3, :3].T @ data.xaxis[j]
        coupling = couplings.of(j)
        origin = offset_origin(origin, kind, axis, coupling.offset)
        driver = coupling.driver
        if driver == _NONE:
            path.append(Joint(origin))
        else:
            name = model.joint(driver).name or f"joint_{len(path) + 1}"
            limits = _limits(model, driver)
            path.append(Joint(origin, kind, axis, driver, name, limits, coupling.factor))
        before = placed
    _check_tendons(model, {j: couplings.of(j).driver for j in joints})
    path.append(Joint(np.linalg.solve(before, _pose(end.xpos, end.xmat))))
    return path


def _carrying(model: MjModel, root: int, body: int) -> list[int] | None:
    """Return the bodies from after `root` to a body; None if `root` does not carry it."""
    carrying: list[int] = []
    while body != root:
        if body == 0:
            return None
        carrying.insert(0, body)
        body = int(model.body_parentid[body])
    return carrying


def _joints_of(model: MjModel, bodies: list[int]) -> list[int]:
    """Return the joints by which bodies move against the body before."""
    joints: list[int] = []
    for body in bodies:
        first = model.body_jntadr[body]
        joints += range(first, first + model.body_jntnum[body])
    return joints


def _kind(model: MjModel, joint: int) -> str:
    kind = int(model.jnt_type[joint])
    if kind not in _KINDS:
        body = model.body(model.jnt_bodyid[joint]).name
        raise ValueError(
            f"a joint of body {body!r} is free or a ball; only hinges and slides are supported "
            "on the path to `end_link`; use a `root_link` after it."
        )
    return _KINDS[kind]


def _limits(model: MjModel, joint: int) -> JointLimits:
    if not model.jnt_limited[joint]:
        return JointLimits()
    return JointLimits(*model.jnt_range[joint].tolist())


class _Coupling(NamedTuple):
    """What a joint follows: it is at ``factor * q + offset``, q is the position of the driver."""

    driver: int  # a joint; _NONE: the joint is fixed
    factor: float
    offset: float


class _Couplings:
    """The <equality> constraints of a model that hold one joint at a function of another."""

    def __init__(self, model: MjModel) -> None:
        self._model = model
        self._of_joint: dict[int, list[int]] = {}
        for constraint in _active(model, _OF_JOINTS):
            joint = int(model.eq_obj1id[constraint])
            self._of_joint.setdefault(joint, []).append(constraint)

    def of(self, joint: int) -> _Coupling:
        """Return what a joint follows at last; without a constraint itself."""
        followed = [joint]
        coupling = _Coupling(joint, 1.0, 0.0)
        while coupling.driver in self._of_joint:
            step = self._step(coupling.driver)
            if step.driver in followed:
                names = [self._model.joint(j).name for j in followed]
                raise ValueError(
                    f"<equality> must not couple joints in a circle, got {names[:9]}; remove one "
                    "of the constraints."
                )
            followed.append(step.driver)
            offset = coupling.offset + coupling.factor * step.offset
            coupling = _Coupling(step.driver, coupling.factor * step.factor, offset)
        return coupling

    def _step(self, joint: int) -> _Coupling:
        """Return what the constraint of a joint says: y - y0 = a + b (x - x0)."""
        model = self._model
        constraints = self._of_joint[joint]
        constraint = constraints[0]
        driver = int(model.eq_obj2id[constraint])
        start, slope, *higher = model.eq_data[constraint, :5].tolist()
        name = model.joint(joint).name
        if len(constraints) > 1 or (driver != _NONE and any(higher)):
            names = [model.equality(c).name or "without a name" for c in constraints]
            raise ValueError(
                f"joint {name!r} must follow one other joint, with a `polycoef` of two numbers, "
                f"a + b q, but <equality> ({', '.join(names)}) couples it otherwise; use an "
                "`end_link` before it, or replace the constraint by an affine one."
            )
        rest = float(model.qpos0[model.jnt_qposadr[joint]])
        if driver == _NONE:
            return _Coupling(_NONE, 0.0, rest + start)
        _kind(model, driver)
        driver_rest = float(model.qpos0[model.jnt_qposadr[driver]])
        return _Coupling(driver, slope, rest + start - slope * driver_rest)


def _active(model: MjModel, kind: int) -> Iterator[int]:
    """Yield the constraints of a kind that hold when the simulation starts."""
    for constraint in range(model.neq):
        if model.eq_active0[constraint] and model.eq_type[constraint] == kind:
            yield constraint


def _check_tendons(model: MjModel, drivers: dict[int, int]) -> None:
    """Raise if a driven fixed tendon moves several joints that nothing else drives."""
    kinds = model.actuator_trntype
    objects = model.actuator_trnid[:, 0]
    driven_tendons = {*objects[kinds == _DRIVES_A_TENDON].tolist()}
    driven_joints = {*objects[np.isin(kinds, _DRIVES_A_JOINT)].tolist()}
    for constraint in _active(model, _OF_TENDONS):
        driven_tendons.add(int(model.eq_obj1id[constraint]))
    for tendon in sorted(driven_tendons):
        first = model.tendon_adr[tendon]
        wraps = slice(first, first + model.tendon_num[tendon])
        if (model.wrap_type[wraps] != _FIXED_TENDON).any():
            continue  # a tendon along sites
        moving = set()
        for joint in model.wrap_objid[wraps].tolist():
            driver = drivers.get(joint, _NONE)
            if driver != _NONE and driver not in driven_joints:
                moving.add(driver)
        if len(moving) > 1:
            names = [model.joint(driver).name for driver in sorted(moving)]
            raise ValueError(
                f"fixed tendon {model.tendon(tendon).name!r} moves the joints {names} together, "
                "and how they share its length depends on forces. Couple them by <equality> "
                '<joint joint1="..." joint2="..." polycoef="0 1 0 0 0"/>, or use an `end_link` or '
                "a `root_link` between them."
            )


def _warn_of_loops(model: MjModel, carrying: list[int]) -> None:
    """Warn of bodies on the path that a constraint ties to another body."""
    is_body = 1  # mjOBJ_BODY
    for kind, tag in _CLOSES_A_LOOP.items():
        for constraint in _active(model, kind):
            tied = [model.eq_obj1id[constraint], model.eq_obj2id[constraint]]
            if model.eq_objtype[constraint] != is_body:
                tied = model.site_bodyid[tied].tolist()
            for body in sorted({*tied} & {*carrying}):
                warnings.warn(
                    f"body {model.body(body).name!r} is tied to another one by <equality> <{tag}>: "
                    "the arm ignores this loop, and its joints move independently.",
                    stacklevel=4,  # the caller of `from_mjcf`
                )


def _pose(position: NDArray, turn: NDArray) -> NDArray:
    pose = np.eye(4)
    pose[:3, :3] = np.reshape(turn, (3, 3))
    pose[:3, 3] = position
    return pose
