"""Pairs of actuators, mixed segments and rigid stages, against a product of matrices."""

import math

import numpy as np
import pytest
import torch
from torch.testing import assert_close

from hybridkin import (
    ConstantCurvatureChain,
    ElasticTendonChain,
)
from hybridkin.chains.chain import Chain

PI = math.pi
BASE = np.eye(4)
BASE[:3, :3] = [[0.0, -0.6, 0.8], [1.0, 0.0, 0.0], [0.0, 0.8, 0.6]]
BASE[:3, 3] = [0.1, -0.2, 0.3]


class Robot:
    """A chain and its own kinematics from free coordinates c, by sines and matrices.

    For each segment its kind, "rotation", "length" (an insertion) or the free ones of length,
    x- and y-bending "l", "x", "y" or bending in a plane "p"; and the angles of its actuators.
    """

    def __init__(self, routing, *segments, **options):
        rng = np.random.default_rng(1)
        S = len(segments)
        self.kinds, self.angles = zip(*segments, strict=True)
        self.radii = rng.uniform(0.03, 0.05, S)
        self.offsets, self.rest = rng.uniform(0.0, 0.05, S), 0.3 * rng.normal(size=(S, 2))
        self.stretch = [kind[0] in "rl" for kind in self.kinds]
        self.backbone = [None if own else 0.2 + 0.01 * k for k, own in enumerate(self.stretch)]
        self.routing = routing
        self.rotates = self.kinds[0] == "rotation"
        self.rest[[len(angles) == 1 for angles in self.angles]] = 0.0
        lengths = None if all(self.stretch) else self.backbone
        self.chain = ConstantCurvatureChain(
            self.radii,
            n_actuators=[len(angles) for angles in self.angles],
            angles=[list(angles) for angles in self.angles],
            lengths=lengths,
            routing=routing,
            offsets=self.offsets,
            rest_bends=self.rest,
            stage="rotation" if self.rotates else None,
            base=BASE,
            **options,
        )

    def free(self, rng, n=6):
        """Return random free coordinates (n, C)."""
        parts = []
        for kind in self.kinds:
            if kind == "rotation":
                parts.append(rng.uniform(-3.0, 3.0, n))
                continue
            for letter in kind.removesuffix("ength"):
                parts.append(rng.uniform(0.2, 0.3, n) if letter == "l" else rng.normal(size=n))
        return torch.from_numpy(np.stack(parts, 1))

    def arcs(self, c):
        """Return turn, lengths and bendings from rest of every segment at c (C,)."""
        c, found = [*c], []
        for k, kind in enumerate(self.kinds):
            turn, length = torch.zeros(()).double(), self.backbone[k]
            if kind == "rotation":
                turn, length = c.pop(0), torch.zeros(()).double()
            elif kind[0] == "l":
                length = c.pop(0)
            bend = torch.zeros(2).double()
            if kind.endswith("xy"):
                bend = torch.stack([c.pop(0), c.pop(0)])
            elif kind.endswith("p"):
                at = self.angles[k][0]
                bend = c.pop(0) * torch.tensor([math.cos(at), math.sin(at)], dtype=torch.float64)
            found.append((turn, length, bend))
        return found

    def actuators(self, c):
        """Return what the actuators read at c (C,)."""
        q, arcs = [], self.arcs(c)
        stages = [k for k, angles in enumerate(self.angles) if self.stretch[k] and len(angles) == 1]
        for k, angles in enumerate(self.angles):
            first = max([0, *(s + 1 for s in stages if s < k)]) if self.routing == "base" else k
            for at in angles:
                reading = arcs[k][0] if self.kinds[k] == "rotation" else 0.0
                for _, length, bend in arcs[first : k + 1]:
                    if self.stretch[k]:
                        reading = reading + length
                    arm = bend[0] * math.cos(at) + bend[1] * math.sin(at)
                    reading = reading - self.radii[k] * arm
                q.append(reading)
        return torch.stack(q)

    def frames(self, c):
        """Return the poses (S + 1, 4, 4) of the base and after every segment."""
        frame = torch.from_numpy(BASE)
        frames = [frame]
        for k, (turn, length, bend) in enumerate(self.arcs(c)):
            bend = bend + torch.from_numpy(self.rest[k])
            theta = bend.square().sum().sqrt() + 1e-300
            u, v = bend / theta
            s, d = torch.sin(theta), 1.0 - torch.cos(theta)
            if len(self.angles[k]) == 1 and self.stretch[k]:
                u, v, theta, s, d = u, v, theta, 0.0 * theta, 0.0 * theta
                place = torch.stack([0.0 * turn, 0.0 * turn, length + 0.0 * turn])
            else:
                place = torch.stack([u * d, v * d, s]) * length / theta
            about = [[1 - u * u * d, -u * v * d, u * s], [-u * v * d, 1 - v * v * d, v * s]]
            bent = torch.stack([torch.stack([p + 0.0 * d for p in row]) for row in about])
            bent = torch.cat([bent, torch.stack([-u * s, -v * s, 1.0 - d])[None]])
            place = place + self.offsets[k] * bent[:, 2]
            zero, one = torch.zeros_like(d), torch.ones_like(d)
            spin = [turn.cos(), -turn.sin(), zero, turn.sin(), turn.cos(), zero, zero, zero, one]
            bent = bent @ torch.stack(spin).reshape(3, 3)
            move = torch.cat([bent, place[:, None]], 1)
            frame = frame @ torch.cat([move, torch.tensor([[0.0, 0.0, 0.0, 1.0]]).double()])
            frames.append(frame)
        return torch.stack(frames)


def pair(at):
    return (at, at + PI)


RING = tuple(2 * PI / 3 * np.arange(3))
FLAT = (0.7, 0.7 + PI, 0.7 - PI, 0.7 + 2 * PI)
ROBOTS = {
    "tendon pairs": Robot("segment", ("p", pair(0.4)), ("p", pair(2.0))),
    "tendon pairs, through": Robot("base", ("p", pair(0.4)), ("p", pair(2.0)), ("p", pair(1.0))),
    "one tendon": Robot("base", ("p", (0.3,)), ("xy", RING)),
    "two tendons at a right angle": Robot("base", ("xy", (0.1, 0.1 + PI / 2)), ("p", FLAT)),
    "two pairs": Robot("base", ("xy", (0.0, PI / 2, PI, -PI / 2)), ("p", pair(0.2))),
    "chamber pairs": Robot("segment", ("lp", pair(0.4)), ("lxy", RING), ("lp", pair(2.0))),
    "chambers in a plane, through": Robot("base", ("lp", FLAT), ("lxy", RING)),
    "mixed": Robot("segment", ("lxy", RING), ("xy", RING), ("lp", pair(1.0)), ("p", pair(0.1))),
    "insertion": Robot("base", ("length", (0.0,)), ("xy", RING), ("p", pair(1.0))),
    "insertion of chambers": Robot("base", ("length", (0.0,)), ("lxy", RING), ("lp", pair(1.0))),
    "rotation": Robot("base", ("rotation", (0.0,)), ("p", pair(0.3)), ("xy", RING)),
    "rotation of chambers": Robot("base", ("rotation", (0.0,)), ("lxy", RING), ("lp", pair(0.3))),
    "rotation and insertion": Robot(
        "base", ("rotation", (0.0,)), ("length", (0.0,)), ("p", pair(0.3)), ("p", pair(1.1))
    ),
}
each_robot = pytest.mark.parametrize("robot", ROBOTS.values(), ids=ROBOTS)


@each_robot
def test_against_a_product_of_matrices(robot):
    free, chain = robot.free(np.random.default_rng(0)), robot.chain
    q = torch.stack([robot.actuators(c) for c in free])
    frames = torch.stack([robot.frames(c) for c in free])
    assert_close(chain(q), frames[:, -1, :3, 3], rtol=0, atol=1e-12)
    assert_close(chain.poses(q), frames, rtol=0, atol=1e-12)
    assert_close(chain.pose(q), frames[:, -1], rtol=0, atol=1e-12)
    points = chain.backbone(q, 5)
    assert_close(points[:, ::5], frames[..., :3, 3], rtol=0, atol=1e-12)
    # Jacobians along the free coordinates, and across them, where readings contradict each other.
    pose_jacobian = chain.pose_jacobian(q)
    for i, c in enumerate(free):
        slope = torch.func.jacfwd(robot.actuators)(c)
        moved = torch.func.jacfwd(lambda c: robot.frames(c)[-1])(c)
        spin = torch.einsum("ijc,kj->ikc", moved[:3, :3], frames[i, -1, :3, :3])
        spin = torch.stack([spin[2, 1], spin[0, 2], spin[1, 0]])
        expected = torch.cat([moved[:3, 3], spin])
        for J, right in ((chain.jacobian(q[i]), expected[:3]), (pose_jacobian[i], expected)):
            size = float(J.abs().max())
            assert_close(J @ slope / size, right / size, rtol=0, atol=1e-12)
            across = torch.eye(len(slope)).double() - slope @ torch.linalg.pinv(slope)
            assert_close(J @ across / size, torch.zeros_like(J), rtol=0, atol=1e-12)
    assert_close(
        chain.consistency(q), torch.zeros_like(q[:, : chain.n_segments]), rtol=0, atol=1e-15
    )


@each_robot
def test_geometry_jacobian_is_that_of_forward_mode(robot):
    rng, chain = torch.Generator().manual_seed(0), robot.chain
    q = torch.stack([robot.actuators(c) for c in robot.free(np.random.default_rng(0))])
    q = q + 0.01 * torch.randn(q.shape, generator=rng, dtype=q.dtype)  # some contradict
    tangents = {
        name: torch.randn(4, *value.shape, generator=rng, dtype=q.dtype)
        for name, value in chain.geometry().items()
    }
    found, right = chain.geometry_jacobian(q, tangents), Chain.geometry_jacobian(chain, q, tangents)
    close = {"rtol": 1e-12, "atol": 1e-12 * float(right.abs().max())}
    assert_close(found, right, **close)
    blocks = q.expand(500, *q.shape)  # of rows, in which many are computed
    assert_close(
        chain.geometry_jacobian(blocks, tangents), right.expand(500, *right.shape), **close
    )


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (
            lambda: ConstantCurvatureChain([0.01] * 2, lengths=[None, 0.1], routing="base"),
            "`routing` must be 'segment' if tendons would run through",
        ),
        (
            lambda: ConstantCurvatureChain(
                [0.01], n_actuators=2, lengths=[0.1], angles=[0.0, 3.14159265]
            ),
            "exactly planar ones: psi and psi",
        ),
        (
            lambda: ConstantCurvatureChain([0.01], angles=[1.0, 1.0, 1.0]),
            "`angles` must determine the bending",
        ),
        (
            lambda: ConstantCurvatureChain([0.01] * 2, stage="rotation"),
            "needs a first segment with one actuator",
        ),
        (
            lambda: ConstantCurvatureChain(
                [0.01] * 2, n_actuators=[1, 3], lengths=[0.1, 0.1], stage="rotation"
            ),
            "and without a length",
        ),
        (
            lambda: ConstantCurvatureChain([0.01] * 2, n_actuators=[1, 3], stage="turn"),
            "`stage` must be None or .* got 'turn'",
        ),
        (
            lambda: ConstantCurvatureChain([0.01] * 3, lengths=[None, 0.1]),
            r"`lengths` must have shape \(2,\)",
        ),
        (
            lambda: ElasticTendonChain([0.01] * 2, [None, 0.1], routing="segment"),
            "`lengths` must hold the backbone length of every segment",
        ),
        (
            lambda: ElasticTendonChain.from_chain(ROBOTS["mixed"].chain),
            "`chain` must have `lengths` in all segments",
        ),
    ],
)
def test_what_is_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_only_tendons_contradict_each_other():
    chain = ROBOTS["mixed"].chain
    q = torch.full((1, chain.n_actuators), 0.25, dtype=torch.float64)
    q[:, 3:6] = q[:, 8:] = 0.0
    assert chain.contradictions(q) == []
    q[:, 8:] = -0.01  # a common pull of a pair
    assert "segment 4, 10 mm rms" in chain.contradictions(q)[0]
