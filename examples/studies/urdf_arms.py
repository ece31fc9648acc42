"""Leaf links of the URDFs of example-robot-data, read by `RigidChain` and by pinocchio.

The numbers of the docs page "Results", section "Rigid arms"::

    pip install pin example-robot-data
    python examples/studies/urdf_arms.py --out results/urdf_arms

A minute. Every leaf link of every URDF that pinocchio reads is the end of an arm. Poses and
Jacobians are compared at configurations drawn within one radian or metre. pinocchio gives joints
that mimic others their own coordinate; it is set as in the URDF.
"""

from __future__ import annotations

import argparse
import sys
import warnings
import xml.etree.ElementTree as ElementTree
from collections.abc import Sequence
from importlib import import_module
from importlib.metadata import PackageNotFoundError, files
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from hybridkin import RigidChain
from hybridkin.app.workflow.report import Report

FREE = ("x", "y", "z", "yaw", "pitch", "roll")  # what a floating joint is


def package_files() -> list[Path]:
    """Return the URDFs of the package example-robot-data."""
    found = files("example-robot-data") or []
    return sorted(Path(str(file.locate())) for file in found if file.suffix == ".urdf")


def joint_positions(path: Path, q: dict[str, float]) -> dict[str, tuple[float, dict[str, float]]]:
    """Return the position of every joint of one axis, and its derivatives by the actuators."""
    joints = {joint.get("name", ""): joint for joint in ElementTree.parse(path).iterfind("joint")}

    def position(name: str) -> tuple[float, dict[str, float]]:
        mimic = joints[name].find("mimic") if name in joints else None
        if mimic is None:
            return q.get(name, 0.0), {name: 1.0}
        factor = float(mimic.get("multiplier", 1.0))
        at, slopes = position(mimic.get("joint", ""))
        slopes = {of: factor * slope for of, slope in slopes.items()}
        return factor * at + float(mimic.get("offset", 0.0)), slopes

    return {name: position(name) for name in joints}


def reference(pin: Any, model: Any, path: Path, leaf: str, q: dict[str, float]) -> tuple:
    """Return pinocchio's pose of a link and its Jacobian, a column (6,) for every actuator."""
    configuration, columns = (
        pin.neutral(model),
        {name: np.zeros((model.nv, 1)) for name in q},
    )
    for name, (at, slopes) in joint_positions(path, q).items():
        if not model.existJointName(name):
            continue
        joint = model.joints[model.getJointId(name)]
        if joint.nv == 1:
            here = [at] if joint.nq == 1 else [np.cos(at), np.sin(at)]
            for of, slope in slopes.items():
                if of in columns:
                    columns[of][joint.idx_v] = slope
        else:
            own = [q.get(f"{name}_{part}", 0.0) for part in FREE]
            turn = Rotation.from_euler("ZYX", own[3:])
            here = [*own[:3], *turn.as_quat()]
            axes = np.column_stack(
                [
                    [0, 0, 1],
                    Rotation.from_euler("Z", own[3]).apply([0, 1, 0]),
                    turn.apply([1, 0, 0]),
                ]
            )
            speeds = np.kron(np.eye(2), turn.as_matrix().T) @ np.block(
                [[np.eye(3), np.zeros((3, 3))], [np.zeros((3, 3)), axes]]
            )
            for part, speed in zip(FREE, speeds.T, strict=True):
                if f"{name}_{part}" in columns:
                    columns[f"{name}_{part}"][joint.idx_v : joint.idx_v + 6, 0] = speed
        configuration[joint.idx_q : joint.idx_q + joint.nq] = here
    data, frame = model.createData(), model.getFrameId(leaf, pin.FrameType.BODY)
    world = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
    J = pin.computeFrameJacobian(model, data, configuration, frame, world)
    pin.framesForwardKinematics(model, data, configuration)
    return data.oMf[frame].homogeneous, np.hstack(
        [np.zeros((6, 0)), *(J @ columns[name] for name in q)]
    )


def leaf_links(pin: Any, model: Any) -> list[str]:
    """Return the links of a model from which no joint leads on."""
    parents = {frame.parentFrame for frame in model.frames}
    bodies = [k for k, frame in enumerate(model.frames) if frame.type == pin.FrameType.BODY]
    return [model.frames[k].name for k in bodies if k not in parents]


def study(paths: Sequence[Path], n: int = 10, random_state: int = 0) -> list[dict[str, Any]]:
    """Return what became of the leaf links of URDFs.

    Parameters
    ----------
    paths : sequence of Path
        The files.
    n : int, default=10
        Configurations of every leaf link.
    random_state : int, default=0
        Seed of the draws.

    Returns
    -------
    list of dict
        One entry for every file that pinocchio reads: "file", "leaves", "read", "refused" (leaf
        links with the message) and the largest differences "pose" [m] or [-] and "jacobian".
    """
    pin, rng, entries = (
        import_module("pinocchio"),
        np.random.default_rng(random_state),
        [],
    )
    for path in paths:
        try:
            model = pin.buildModelFromUrdf(str(path))
        except (ValueError, RuntimeError):
            continue
        leaves = leaf_links(pin, model)
        entry = {"file": path.name, "leaves": len(leaves), "refused": [], "read": 0}
        entry |= {"pose": 0.0, "jacobian": 0.0}
        for leaf in leaves:
            try:
                with warnings.catch_warnings():
                    warnings.simplefilter("ignore")
                    arm = RigidChain.from_urdf(path, leaf)
            except ValueError as error:
                entry["refused"].append(f"{leaf}: {error}")
                continue
            entry["read"] += 1
            rows = rng.uniform(-1.0, 1.0, (n, arm.n_actuators))
            found = [part.numpy() for part in arm.pose_and_jacobian(torch.from_numpy(rows))]
            for row, *own in zip(rows, *found, strict=True):
                q = dict(zip(arm.names, row, strict=True))
                expected: list[NDArray] = [*reference(pin, model, path, leaf, q)]
                for key, a, b in zip(("pose", "jacobian"), own, expected, strict=True):
                    entry[key] = max(entry[key], float(np.abs(a - b).max(initial=0.0)))
        entries.append(entry)
    return entries


def urdf_report(entries: list[dict[str, Any]]) -> Report:
    """Return the report of what `study` returned."""
    report = Report("Leaf links of URDFs", {})
    report.record["files"] = entries
    total = {key: sum(entry[key] for entry in entries) for key in ("leaves", "read")}
    largest = {key: max(entry[key] for entry in entries) for key in ("pose", "jacobian")}
    report.text(
        f"Of {total['leaves']} leaf links in {len(entries)} files that pinocchio reads, "
        f"{total['read']} are read. Largest difference of a pose: {largest['pose']:.2g}, of a "
        f"Jacobian: {largest['jacobian']:.2g}."
    )
    rows = [
        [
            e["file"],
            str(e["leaves"]),
            str(e["read"]),
            f"{e['pose']:.1g}",
            f"{e['jacobian']:.1g}",
        ]
        for e in entries
    ]
    report.table(["file", "leaf links", "read", "poses", "Jacobians"], rows)
    for entry in entries:
        report.text(*(f"{entry['file']}: {message}" for message in entry["refused"]))
    return report


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the study and write the report."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", required=True, help="folder of the report")
    parser.add_argument("--rows", type=int, default=10, help="of every leaf link; default: 10")
    parser.add_argument("--seed", type=int, default=0, help="of the draws; default: 0")
    given = parser.parse_args(arguments)
    try:
        import_module("pinocchio")
        paths = package_files()
    except (ImportError, PackageNotFoundError) as error:
        sys.exit(f"this study needs `pip install pin example-robot-data` ({error})")
    for path in urdf_report(study(paths, given.rows, given.seed)).write(given.out):
        print(path)


if __name__ == "__main__":
    main()
