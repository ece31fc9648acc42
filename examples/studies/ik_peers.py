"""Poses of three rigid arms, solved by hybridkin, pytorch_kinematics, mink and Pink.

Figures of the docs page "Theory", section "Further starts", and ``docs/data/ik_poses.csv``::

    python examples/studies/ik_peers.py --out results/ik_peers

Some minutes on one core, most of it for mink and Pink, which take one target at a time. Programs
that are not installed are left out.

Targets are poses at q drawn evenly within the limits, so that every one can be reached. A target
counts as solved where the returned q lies within the limits and its pose, computed here by
products of matrices, within 1 mm and 0.01 rad of the target. Every program starts cold: from the
middle of the limits, or from random configurations within them.
"""

from __future__ import annotations

import argparse
import math
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from importlib import import_module
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from hybridkin import InverseKinematics, RigidChain
from hybridkin.app.workflow.report import Report
from hybridkin.ik.tasks import PoseTask

TOL = (1e-3, 1e-2)  # [m], [rad]
_DT = 1.0  # [s], the period of mink and Pink: whole steps
_STEPS = 100  # of mink and Pink per start
_HALF, _TURN = 0.5 * math.pi, math.pi


class Arm(NamedTuple):
    """Revolute joints (position, roll-pitch-yaw, axis, lower and upper limit), and the tip."""

    joints: list[tuple[tuple, tuple, tuple, float, float]]
    tip: tuple[tuple, tuple]

    @property
    def limits(self) -> tuple[NDArray, NDArray]:
        """Smallest and largest q [rad]."""
        low, high = np.array([joint[3:] for joint in self.joints]).T
        return low, high

    def draw(self, n: int, rng: np.random.Generator) -> NDArray:
        """Return n configurations (n, n_joints), evenly within the limits."""
        return rng.uniform(*self.limits, (n, len(self.joints)))

    def poses(self, q: NDArray) -> NDArray:
        """Return the poses (N, 4, 4) of the tip at q (N, n_joints)."""
        poses = np.eye(4)
        for k, (xyz, rpy, axis, *_) in enumerate(self.joints):
            turn = np.tile(np.eye(4), (len(q), 1, 1))
            turn[:, :3, :3] = Rotation.from_rotvec(q[:, k, None] * np.array(axis)).as_matrix()
            poses = poses @ _pose(xyz, rpy) @ turn
        return poses @ _pose(*self.tip)

    def urdf(self) -> str:
        """Return the arm as URDF, from the link "base" to the link "tip"."""
        names = ["base", *(f"link_{k}" for k in range(1, len(self.joints) + 1)), "tip"]
        inertia = '<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/>'
        mass = f'<inertial><mass value="1"/>{inertia}'
        lines = [f'<link name="{name}">{mass}</inertial></link>' for name in names]
        rows = [*self.joints, (*self.tip, None, 0.0, 0.0)]
        for k, (xyz, rpy, axis, low, high) in enumerate(rows):
            kind, moves = "fixed", ""
            if axis is not None:
                kind = "revolute"
                moves = f'<axis xyz="{_text(axis)}"/><limit lower="{low!r}" upper="{high!r}" '
                moves += 'effort="100" velocity="3"/>'
            lines.append(
                f'<joint name="joint_{k + 1}" type="{kind}"><parent link="{names[k]}"/>'
                f'<child link="{names[k + 1]}"/><origin xyz="{_text(xyz)}" rpy="{_text(rpy)}"/>'
                f"{moves}</joint>"
            )
        return f'<robot name="arm">{"".join(lines)}</robot>'


def _text(numbers: Sequence[float]) -> str:
    return " ".join(map(repr, numbers))


def _pose(xyz: tuple, rpy: tuple) -> NDArray:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = Rotation.from_euler("xyz", rpy).as_matrix(), xyz
    return pose


_NONE, _X, _Y, _Z = (0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)

ARMS = {
    "widowx (wx250s), 6 joints": Arm(
        [
            ((0.0, 0.0, 0.072), _NONE, _Z, -_TURN, _TURN),
            ((0.0, 0.0, 0.03865), _NONE, _Y, -1.8849555921538759, 1.9896753472735358),
            ((0.04975, 0.0, 0.25), _NONE, _Y, -2.1467549799530254, 1.6057029118347832),
            ((0.175, 0.0, 0.0), _NONE, _X, -3.141582653589793, 3.141582653589793),
            ((0.075, 0.0, 0.0), _NONE, _Y, -1.7453292519943295, 2.1467549799530254),
            ((0.065, 0.0, 0.0), _NONE, _X, -3.141582653589793, 3.141582653589793),
        ],
        ((0.093575, 0.0, 0.0), _NONE),
    ),
    "iiwa 7, 7 joints": Arm(
        [
            ((0.0, 0.0, 0.1575), _NONE, _Z, -2.96705972839, 2.96705972839),
            (
                (0.0, 0.0, 0.2025),
                (_HALF, 0.0, _TURN),
                _Z,
                -2.09439510239,
                2.09439510239,
            ),
            (
                (0.0, 0.2045, 0.0),
                (_HALF, 0.0, _TURN),
                _Z,
                -2.96705972839,
                2.96705972839,
            ),
            ((0.0, 0.0, 0.2155), (_HALF, 0.0, 0.0), _Z, -2.09439510239, 2.09439510239),
            (
                (0.0, 0.1845, 0.0),
                (-_HALF, _TURN, 0.0),
                _Z,
                -2.96705972839,
                2.96705972839,
            ),
            ((0.0, 0.0, 0.2155), (_HALF, 0.0, 0.0), _Z, -2.09439510239, 2.09439510239),
            (
                (0.0, 0.081, 0.0),
                (-_HALF, _TURN, 0.0),
                _Z,
                -3.05432619099,
                3.05432619099,
            ),
        ],
        (_NONE, _NONE),
    ),
    "ur5, 6 joints": Arm(
        [
            ((0.0, 0.0, 0.089159), _NONE, _Z, -2.0 * _TURN, 2.0 * _TURN),
            ((0.0, 0.13585, 0.0), (0.0, _HALF, 0.0), _Y, -2.0 * _TURN, 2.0 * _TURN),
            ((0.0, -0.1197, 0.425), _NONE, _Y, -_TURN, _TURN),
            ((0.0, 0.0, 0.39225), (0.0, _HALF, 0.0), _Y, -2.0 * _TURN, 2.0 * _TURN),
            ((0.0, 0.093, 0.0), _NONE, _Z, -2.0 * _TURN, 2.0 * _TURN),
            ((0.0, 0.0, 0.09465), _NONE, _Y, -2.0 * _TURN, 2.0 * _TURN),
        ],
        ((0.0, 0.0823, 0.0), (-_HALF, 0.0, 0.0)),
    ),
}
"""Arms of the study, by name."""

Solve = Callable[[NDArray], NDArray]


def hybridkin_solver(arm: Arm, n_starts: int, seed: int) -> Solve:
    """Return the search of this package; it draws nothing, `seed` is not used."""
    low, high = arm.limits
    chain = RigidChain.from_urdf(arm.urdf(), "tip")
    ik = InverseKinematics(PoseTask(chain), q_min=low, q_max=high)
    return lambda poses: ik.solve(poses, tol=TOL, restarts=n_starts - 1).q


def pytorch_kinematics_solver(arm: Arm, n_starts: int, seed: int) -> Solve:
    """Return damped least squares of all starts at once, as in its README but with whole steps."""
    from pytorch_kinematics import (
        PseudoInverseIK,
        Transform3d,
        build_serial_chain_from_urdf,
    )

    chain = build_serial_chain_from_urdf(arm.urdf(), "tip").to(dtype=torch.float64)
    starts = torch.from_numpy(arm.draw(n_starts, np.random.default_rng(seed)))
    solver = PseudoInverseIK(
        chain,
        pos_tolerance=TOL[0],
        rot_tolerance=TOL[1],
        retry_configs=starts,
        max_iterations=30,
        early_stopping_any_converged=True,
        early_stopping_no_improvement="all",
    )

    def solve(poses: NDArray) -> NDArray:
        found = solver.solve(Transform3d(matrix=torch.from_numpy(poses)))
        low, high = map(torch.from_numpy, arm.limits)
        inside = ((found.solutions >= low) & (found.solutions <= high)).all(-1)
        best = (found.converged & inside).int().argmax(1)
        return found.solutions[torch.arange(len(best)), best].numpy()

    return solve


def mink_solver(arm: Arm, n_starts: int, seed: int) -> Solve:
    """Return mink's differential inverse kinematics with limits, run until it arrives."""
    import mink
    import mujoco

    spec = mujoco.MjSpec.from_string(arm.urdf().replace('="arm">', '="arm">' + _MUJOCO))
    model = spec.compile()
    configuration, limits = mink.Configuration(model), [mink.ConfigurationLimit(model)]
    task = mink.FrameTask("tip", "body", position_cost=1.0, orientation_cost=0.1, lm_damping=0.1)

    def follow(q: NDArray, pose: NDArray) -> NDArray:
        configuration.update(q)
        task.set_target(mink.SE3.from_matrix(pose))
        for _ in range(_STEPS):
            error = task.compute_error(configuration)
            if _arrived(error):
                break
            speed = mink.solve_ik(configuration, [task], _DT, "daqp", damping=1e-9, limits=limits)
            configuration.integrate_inplace(speed, _DT)
        return configuration.q.copy()

    return _one_by_one(arm, follow, n_starts, seed)


_MUJOCO = '<mujoco><compiler fusestatic="false" discardvisual="false"/></mujoco>'


def pink_solver(arm: Arm, n_starts: int, seed: int) -> Solve:
    """Return Pink's differential inverse kinematics with limits, run until it arrives."""
    import pink
    import pinocchio

    model = pinocchio.buildModelFromXML(arm.urdf())
    data = model.createData()
    task = pink.FrameTask("tip", position_cost=1.0, orientation_cost=0.1, lm_damping=0.1)
    limits = [pink.limits.ConfigurationLimit(model)]

    def follow(q: NDArray, pose: NDArray) -> NDArray:
        configuration = pink.Configuration(model, data, q)
        task.set_target(pinocchio.SE3(pose))
        for _ in range(_STEPS):
            if _arrived(task.compute_error(configuration)):
                break
            speed = pink.solve_ik(
                configuration,
                [task],
                _DT,
                solver="daqp",
                damping=1e-9,
                limits=limits,
                safety_break=False,
            )
            configuration.integrate_inplace(speed, _DT)
        return configuration.q.copy()

    return _one_by_one(arm, follow, n_starts, seed)


def _arrived(error: NDArray) -> bool:
    return bool(np.linalg.norm(error[:3]) <= TOL[0] and np.linalg.norm(error[3:]) <= TOL[1])


def _one_by_one(arm: Arm, follow: Callable, n_starts: int, seed: int) -> Solve:
    """Return the search from the middle of the limits, then from random starts, row by row."""
    low, high = arm.limits
    further = arm.draw(n_starts - 1, np.random.default_rng(seed))
    starts = np.vstack([0.5 * (low + high), further])

    def solve(poses: NDArray) -> NDArray:
        rows = []
        for pose in poses:
            for start in starts:
                q = np.clip(follow(start, pose), low, high)
                if solved(arm, q[None], pose[None])[0]:
                    break
            rows.append(q)
        return np.array(rows)

    return solve


def solved(arm: Arm, q: NDArray, poses: NDArray) -> NDArray:
    """Return where q (N, n) lies within the limits and reaches poses (N, 4, 4), bool (N,)."""
    low, high = arm.limits
    found = arm.poses(q)
    away = np.linalg.norm(found[:, :3, 3] - poses[:, :3, 3], axis=1)
    turned = Rotation.from_matrix(found[:, :3, :3] @ poses[:, :3, :3].swapaxes(1, 2)).magnitude()
    inside = ((q >= low) & (q <= high)).all(1)
    return inside & (away <= TOL[0] * (1.0 + 1e-9)) & (turned <= TOL[1] * (1.0 + 1e-9))


PROGRAMS: dict[str, tuple[Callable[..., Solve], tuple[str, ...]]] = {
    "hybridkin": (hybridkin_solver, ()),
    "pytorch_kinematics": (pytorch_kinematics_solver, ("pytorch_kinematics",)),
    "mink": (mink_solver, ("mink", "mujoco", "daqp")),
    "Pink": (pink_solver, ("pink", "pinocchio", "daqp")),
}
"""What makes the solver of every program, and the modules it needs."""


def ur5_branches(poses: NDArray) -> NDArray:
    """Return the number of solutions of the ur5, whole turns apart, for poses (N, 4, 4): 0 to 8.

    In closed form: two sides of the shoulder, on which the parallel axes point along a horizontal
    u; two ways round for the wrist, whose fifth axis is normal to u and to the sixth; and two
    elbows where upper arm and forearm span the way from shoulder to wrist.
    """
    joints = ARMS["ur5, 6 joints"].joints
    across, upper, forearm = (sum(joint[0][1] for joint in joints), 0.425, 0.39225)
    last, count = poses[:, :3, 2], np.zeros(len(poses), dtype=int)
    wrist = poses[:, :3, 3] - 0.0823 * last
    radius_sq = (wrist[:, :2] ** 2).sum(1)
    ahead = np.sqrt(np.maximum(radius_sq - across**2, 0.0))
    x, y = wrist[:, 0], wrist[:, 1]
    for side in (-1.0, 1.0):
        u = np.stack([across * x - side * ahead * y, across * y + side * ahead * x, 0.0 * x], 1)
        u /= radius_sq[:, None]
        fifth = np.cross(u, last)
        fifth /= np.linalg.norm(fifth, axis=1, keepdims=True)
        for sign in (-1.0, 1.0):
            way = wrist - sign * 0.09465 * fifth - across * u - np.array(joints[0][0])
            far = np.linalg.norm(way, axis=1)
            spanned = (far <= upper + forearm) & (far >= upper - forearm)
            count += 2 * (spanned & (radius_sq >= across**2))
    return count


def installed(program: str) -> bool:
    """Return whether the modules of a program can be imported."""
    try:
        for name in PROGRAMS[program][1]:
            import_module(name)
    except ImportError:
        return False
    return True


STARTS = {
    "hybridkin": (1, 10, 33),
    "pytorch_kinematics": (10, 33),
    "mink": (1, 10),
    "Pink": (1, 10),
}
"""Configurations that a search may start from, by program."""


def compared(
    n: int = 1000,
    *,
    random_state: int = 0,
    programs: Sequence[str] = tuple(PROGRAMS),
    starts: Mapping[str, Sequence[int]] = STARTS,
    progress: Callable[[str], None] | None = None,
) -> list[dict[str, Any]]:
    """Return the share of targets that every program solves, and its CPU time.

    Parameters
    ----------
    n : int, default=1000
        Targets per arm.
    random_state : int, default=0
        Seed of the targets; that of random starts is one more.
    programs : sequence of str, optional
        Of `PROGRAMS`. Those that are not installed are left out.
    starts : mapping of str to sequence of int, optional
        Configurations that a search may start from.
    progress : callable, optional
        Called with what comes next.

    Returns
    -------
    list of dict
        "arm", "program", "starts", "n", "share" of targets solved, "seconds" of CPU time per
        target: the least of three runs, one of mink and of Pink.
    """
    entries = []
    for name, arm in ARMS.items():
        poses = arm.poses(arm.draw(n, np.random.default_rng(random_state)))
        for program in filter(installed, programs):
            runs = 1 if program in ("mink", "Pink") else 3
            for count in starts[program]:
                if progress is not None:
                    progress(f"{name}: {program}, {count} starts")
                solve, seconds = PROGRAMS[program][0](arm, count, random_state + 1), []
                solve(poses[:2])
                for _ in range(runs):
                    began = time.process_time()
                    q = solve(poses)
                    seconds.append((time.process_time() - began) / len(poses))
                share = float(solved(arm, q, poses).mean())
                entry = dict(arm=name, program=program, starts=count, n=len(poses), share=share)
                entries.append({**entry, "seconds": min(seconds)})
    return entries


def branches(
    n: int = 500, restarts: Sequence[int] = (32, 64, 128), *, random_state: int = 0
) -> list[dict[str, Any]]:
    """Return how many of the ur5's solutions `n_solutions` finds, with numbers of further starts.

    Parameters
    ----------
    n : int, default=500
        Targets.
    restarts : sequence of int, default=(32, 64, 128)
        Further starts.
    random_state : int, default=0
        Seed of the targets.

    Returns
    -------
    list of dict
        "restarts", "n", "there" (solutions in closed form), "found" (at most as many per target),
        "all" (share of targets with all of them), "too_many" (targets with more, near singular
        poses), "seconds" of CPU time per target.
    """
    arm, entries = ARMS["ur5, 6 joints"], []
    low, high = arm.limits
    chain = RigidChain.from_urdf(arm.urdf(), "tip")
    ik = InverseKinematics(PoseTask(chain), q_min=low, q_max=high)
    poses = arm.poses(arm.draw(n, np.random.default_rng(random_state)))
    there = ur5_branches(poses)
    for count in restarts:
        began = time.process_time()
        solution = ik.solve(poses, tol=TOL, restarts=count, n_solutions=9)
        seconds = (time.process_time() - began) / n
        q, again = solution.q[solution.converged], np.repeat(poses[:, None], 9, axis=1)
        assert solved(arm, q, again[solution.converged]).all()
        found = solution.converged.sum(1)
        entry = dict(restarts=count, n=n, there=int(there.sum()), seconds=seconds)
        entry |= {
            "found": int(np.minimum(found, there).sum()),
            "all": float((found >= there).mean()),
        }
        entries.append({**entry, "too_many": int((found > there).sum())})
    return entries


def peers_report(entries: list[dict[str, Any]], found: list[dict[str, Any]]) -> Report:
    """Return the report of what `compared` and `branches` returned."""
    report = Report("Poses of rigid arms", {})
    report.record.update(entries=entries, branches=found, tol=TOL)
    report.text("Share of targets solved within tolerance and limits, CPU time per target.")
    header = ["arm", "program", "starts", "targets", "solved [%]", "CPU time [ms]"]
    report.table(
        header,
        [
            [
                *(str(e[key]) for key in ("arm", "program", "starts", "n")),
                f"{100.0 * e['share']:.1f}",
                f"{1e3 * e['seconds']:.3g}",
            ]
            for e in entries
        ],
    )
    report.text("Solutions of the ur5 that `n_solutions` finds.")
    header = [
        "restarts",
        "targets",
        "solutions",
        "found [%]",
        "all found [%]",
        "too many",
    ]
    report.table(
        [*header, "CPU time [ms]"],
        [
            [
                *(str(e[key]) for key in ("restarts", "n", "there")),
                f"{100.0 * e['found'] / e['there']:.1f}",
                f"{100.0 * e['all']:.1f}",
                str(e["too_many"]),
                f"{1e3 * e['seconds']:.3g}",
            ]
            for e in found
        ],
    )
    return report


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the study and write the report."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", required=True, help="folder of the report")
    parser.add_argument("--programs", nargs="+", choices=PROGRAMS, default=[*PROGRAMS])
    parser.add_argument("--targets", type=int, default=1000, help="per arm; default: 1000")
    parser.add_argument("--seed", type=int, default=0, help="of the draws; default: 0")
    given = parser.parse_args(arguments)
    torch.set_num_threads(1)
    entries = compared(
        given.targets,
        random_state=given.seed,
        programs=given.programs,
        progress=lambda what: print(what, file=sys.stderr),
    )
    found = branches(max(given.targets // 2, 1), random_state=given.seed)
    for path in peers_report(entries, found).write(given.out):
        print(path)


if __name__ == "__main__":
    main()
