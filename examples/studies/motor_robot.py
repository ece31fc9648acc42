"""A simulated tendon robot with motors, spools and backlash, as a user has it on the table.

Two segments of five circular arcs each, mounted horizontally, so that the weight bends them down.
Every segment has a ring of tendons; those of the second segment run through the first. The robot
takes the shape of least energy: bending and compression of the backbone, stretch of the tendons,
which can only pull, and weight. It shares no code with the chains of the library. Commands are
motor counts; each motor has backlash. All is simulated.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation
from torch import Tensor

N_ARCS = 5  # in a segment
COMMANDS = ("rounded", "exact", "dithered", "noisy")
_GRAVITY = 9.81  # [m/s^2]
_N_TERMS = 9  # of the series below: exact to rounding for arcs of up to 1 rad
_MAX_NEWTON, _MAX_HALVINGS = 60, 12
_FORCE_TOL = 1e-9  # of the gradient of the energy [N m], [N]
_STEP = 1e-6  # of differences [rad], [m]
_DITHER = 2  # largest number of counts
_READING_NOISE = 1.0  # of noisy logs [counts]
_CO_CONTRACTION = 1e-3  # largest common pull in logs that are not balanced [m]


class RecordedLog(NamedTuple):
    """What was sent and measured, and where the backlash of the motors is at the end.

    Attributes
    ----------
    counts : ndarray of shape (N, n)
        Counts as the log has them.
    tips : ndarray of shape (N, 3)
        Measured tips, with noise [m].
    true_tips : ndarray of shape (N, 3)
        The same without noise [m].
    groups : ndarray of shape (N,)
        Motion of every row.
    pulls : ndarray of shape (n,)
        Pulls of the tendons in the last row, behind the backlash [m].
    """

    counts: NDArray
    tips: NDArray
    true_tips: NDArray
    groups: NDArray
    pulls: NDArray


@dataclass(frozen=True, eq=False)
class MotorRobot:
    """A two-segment robot; n tendons, all of the first segment before those of the second.

    Attributes
    ----------
    lengths, radii : ndarray of shape (2,)
        Length of the segments and radius of their tendon circles [m].
    angles : ndarray of shape (n,)
        Angle of every tendon about the backbone [rad].
    bending_stiffness : ndarray of shape (2,)
        EI of the segments [N m^2].
    axial_stiffness : ndarray of shape (2,)
        Force for the compression of a whole segment [N/m].
    tendon_stiffness, pretension : ndarray of shape (n,)
        Stiffness [N/m] and stretch at rest [m].
    masses : ndarray of shape (2,)
        Mass of the segments [kg].
    tip_mass, tool : float
        Mass [kg] and rigid length [m] at the tip.
    gravity : ndarray of shape (3,)
        In the frame of the base, whose z axis is the straight robot [m/s^2].
    camera : ndarray of shape (4, 4)
        Frame of the base in the frame of the camera.
    counts_per_metre, signs, zeros : ndarray of shape (n,)
        Counts of a motor for one metre of tendon, 1 if more counts pull or -1, counts at rest.
    backlash : float
        Total width [m].
    """

    lengths: NDArray
    radii: NDArray
    angles: NDArray
    bending_stiffness: NDArray
    axial_stiffness: NDArray
    tendon_stiffness: NDArray
    pretension: NDArray
    masses: NDArray
    tip_mass: float
    tool: float
    gravity: NDArray
    camera: NDArray
    counts_per_metre: NDArray
    signs: NDArray
    zeros: NDArray
    backlash: float = 3e-4

    @classmethod
    def random(
        cls, seed: int, *, tendons_per_segment: int = 3, backlash: float = 3e-4
    ) -> MotorRobot:
        """Return a robot drawn at random.

        Parameters
        ----------
        seed : int
            Seed of all draws.
        tendons_per_segment : {3, 4}, default=3
            Four are two antagonistic pairs.
        backlash : float, default=3e-4
            Total width of the backlash of every motor, in metres of tendon [m].

        Returns
        -------
        MotorRobot
            The robot.
        """
        rng = np.random.default_rng(seed)
        n = 2 * tendons_per_segment
        radius = rng.uniform(0.007, 0.011)
        turns = rng.uniform(0.0, 2 * np.pi / tendons_per_segment, 2)
        ring = 2 * np.pi / tendons_per_segment * np.arange(tendons_per_segment)
        roll = Rotation.from_euler("z", rng.uniform(-180, 180), degrees=True)
        tilt = Rotation.from_euler("xyz", rng.normal(0.0, 3.0, 3), degrees=True)
        # The camera has z upwards; the robot points along its x axis.
        base = tilt * Rotation.from_euler("y", 90, degrees=True) * roll
        camera = np.eye(4)
        camera[:3, :3] = base.as_matrix()
        camera[:3, 3] = rng.uniform(-0.1, 0.1, 3)
        common_zero = rng.integers(1500, 2500) if rng.random() < 0.5 else 0
        mixed_signs = rng.random() < 0.25
        signs = rng.choice([-1.0, 1.0], n) if mixed_signs else np.full(n, rng.choice([-1.0, 1.0]))
        per_metre = 1e3 * np.exp(rng.uniform(np.log(25), np.log(150)))
        return cls(
            lengths=rng.uniform(0.07, 0.11, 2),
            radii=radius * np.array([1.0, rng.uniform(0.8, 1.0)]),
            angles=np.concatenate([turn + ring for turn in turns]),
            bending_stiffness=np.exp(rng.uniform(np.log(0.02), np.log(0.05)))
            * np.array([1.0, rng.uniform(0.6, 1.0)]),
            axial_stiffness=np.full(2, np.exp(rng.uniform(np.log(4e4), np.log(4e5)))),
            tendon_stiffness=rng.uniform(4e3, 1.2e4) * rng.uniform(0.9, 1.1, n),
            pretension=rng.uniform(1e-4, 4e-4) * rng.uniform(0.7, 1.3, n),
            masses=rng.uniform(0.015, 0.035, 2),
            tip_mass=rng.uniform(0.0, 0.015),
            tool=rng.uniform(0.005, 0.015),
            gravity=base.inv().apply([0.0, 0.0, -_GRAVITY]),
            camera=camera,
            counts_per_metre=per_metre * rng.uniform(0.995, 1.005, n),
            signs=signs,
            zeros=common_zero + (rng.integers(-40, 41, n) if common_zero else np.zeros(n)),
            backlash=backlash,
        )

    @property
    def n_tendons(self) -> int:
        """Number of tendons, and of motors."""
        return len(self.angles)

    @property
    def segment(self) -> NDArray:
        """Segment at which every tendon ends, (n,)."""
        return np.repeat([0, 1], self.n_tendons // 2)

    @property
    def paths(self) -> NDArray:
        """Matrix (n, 22) from a shape to the changes of length of the tendons' paths.

        A shape holds the bending vectors of the ten arcs [rad], then the stretch of both segments
        [m]. A tendon on the inner side of a bend has the shorter path.
        """
        matrix = np.zeros((self.n_tendons, 4 * N_ARCS + 2))
        for i, (angle, last) in enumerate(zip(self.angles, self.segment, strict=True)):
            arm = -self.radii[last] * np.array([np.cos(angle), np.sin(angle)])
            n_passed = (last + 1) * N_ARCS
            matrix[i, : 2 * n_passed] = np.tile(arm, n_passed)
            matrix[i, 4 * N_ARCS : 4 * N_ARCS + last + 1] = 1.0
        return matrix

    @property
    def stiffness(self) -> NDArray:
        """Stiffness of the backbone for every entry of a shape, (22,)."""
        arcs = np.repeat(self.bending_stiffness / (self.lengths / N_ARCS), 2 * N_ARCS)
        return np.concatenate([arcs, self.axial_stiffness])

    def stretches(self, shapes: NDArray, pulls: NDArray) -> NDArray:
        """Return the stretch of every tendon (N, n) [m], negative where it is slack."""
        return shapes @ self.paths.T + pulls + self.pretension

    def pulls(self, counts: ArrayLike) -> NDArray:
        """Return the pulls that counts (N, n) command, without backlash [m]."""
        return self.signs * (np.asarray(counts, dtype=float) - self.zeros) / self.counts_per_metre

    def counts(self, pulls: ArrayLike) -> NDArray:
        """Return the counts (N, n), not rounded, of pulls [m]."""
        return self.zeros + self.signs * self.counts_per_metre * np.asarray(pulls)

    def behind_backlash(self, pulls: NDArray, start: NDArray | None = None) -> NDArray:
        """Return the pulls (N, n) that reach the tendons; `start` (n,) are those before [m]."""
        actual = np.empty_like(pulls)
        last = pulls[0] if start is None else start
        for i, pull in enumerate(pulls):
            last = np.clip(last, pull - 0.5 * self.backlash, pull + 0.5 * self.backlash)
            actual[i] = last
        return actual

    def tips(
        self, counts: ArrayLike, start: NDArray | None = None, *, round: bool = False
    ) -> NDArray:
        """Return the true tips along a sequence of commands.

        Parameters
        ----------
        counts : array-like of shape (N, n)
            Commands in order of time [counts].
        start : ndarray of shape (n,), optional
            Pulls behind the backlash before the first command [m]. Default: the first command has
            been held, and the motors stand in the middle of their backlash.
        round : bool, default=False
            Whether the motors take whole counts only.

        Returns
        -------
        ndarray of shape (N, 3)
            Tips in the frame of the camera, without noise [m].
        """
        sent = np.round(counts) if round else counts
        return self.tips_of(self.behind_backlash(self.pulls(sent), start))

    def tips_of(self, pulls: NDArray) -> NDArray:
        """Return the tips (N, 3) of pulls (N, n) behind the backlash [m]."""
        shapes = torch.from_numpy(self.shapes(pulls))
        return self.in_camera(self._tip_and_masses(shapes)[0].numpy())

    def in_camera(self, points: NDArray) -> NDArray:
        """Return points (..., 3) of the base in the frame of the camera [m]."""
        return points @ self.camera[:3, :3].T + self.camera[:3, 3]

    def shapes(self, pulls: NDArray) -> NDArray:
        """Return the shapes (N, 22) of least energy, by Newton's method on all rows at once."""
        distinct, where = np.unique(pulls, axis=0, return_inverse=True)
        pull = torch.from_numpy(distinct)
        shapes = pull.new_zeros(len(distinct), 4 * N_ARCS + 2)
        todo = torch.arange(len(distinct))
        for _ in range(_MAX_NEWTON):
            shape, own = shapes[todo], pull[todo]
            gradient = self._gradient(shape, own)
            is_open = gradient.abs().amax(1) > _FORCE_TOL
            if not is_open.any():
                return shapes.numpy()[where.ravel()]
            todo, shape, own = todo[is_open], shape[is_open], own[is_open]
            step = -torch.linalg.solve(self._hessian(shape, own), gradient[is_open])
            shapes[todo] = self._descended(shape, step, own)
        raise ValueError(f"{len(todo)} of {len(distinct)} shapes have no balance of forces.")

    def energy(self, shapes: Tensor, pulls: Tensor) -> Tensor:
        """Return the energy (N,) of shapes (N, 22) at pulls (N, n) [J]."""
        stiffness, paths, tendon, pretension = self._tensors()
        stretch = (shapes @ paths.T + pulls + pretension).clamp(min=0.0)
        return (
            0.5 * (stiffness * shapes**2).sum(-1)
            + 0.5 * (tendon * stretch**2).sum(-1)
            + self._weight(shapes)
        )

    def _gradient(self, shapes: Tensor, pulls: Tensor) -> Tensor:
        """Return the gradient (N, 22) of the energy."""
        stiffness, paths, tendon, pretension = self._tensors()
        stretch = shapes @ paths.T + pulls + pretension
        tension = tendon * stretch.clamp(min=0.0)
        return stiffness * shapes + tension @ paths + self._weight_gradient(shapes)

    def _hessian(self, shapes: Tensor, pulls: Tensor) -> Tensor:
        """Return the Hessian (N, 22, 22) of the energy, of the weight by differences."""
        stiffness, paths, tendon, pretension = self._tensors()
        taut = tendon * (shapes @ paths.T + pulls + pretension > 0.0)
        ahead = shapes[:, None] + _STEP * torch.eye(shapes.shape[1], dtype=shapes.dtype)
        rise = self._weight_gradient(ahead) - self._weight_gradient(shapes)[:, None]
        return torch.diag(stiffness) + (paths.T * taut[:, None]) @ paths + rise / _STEP

    def _weight_gradient(self, shapes: Tensor) -> Tensor:
        """Return the gradient (..., 22) of the energy of the weight."""
        with torch.enable_grad():
            shapes = shapes.clone().requires_grad_()
            return torch.autograd.grad(self._weight(shapes).sum(), shapes)[0]

    def _descended(self, shapes: Tensor, step: Tensor, pulls: Tensor) -> Tensor:
        """Return the shapes after the step, which is halved where the energy would rise."""
        before = self.energy(shapes, pulls)
        size = torch.ones_like(before)
        for _ in range(_MAX_HALVINGS):
            higher = self.energy(shapes + size[:, None] * step, pulls) > before + 1e-15
            if not higher.any():
                break
            size = torch.where(higher, 0.5 * size, size)
        return shapes + size[:, None] * step

    def _tensors(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        arrays = self.stiffness, self.paths, self.tendon_stiffness, self.pretension
        stiffness, paths, tendon, pretension = (torch.from_numpy(array) for array in arrays)
        return stiffness, paths, tendon, pretension

    def _weight(self, shapes: Tensor) -> Tensor:
        """Return the energy of the weight (...) of shapes (..., 22) [J]."""
        tip, points = self._tip_and_masses(shapes)
        gravity = torch.from_numpy(self.gravity)
        energy = -self.tip_mass * (tip @ gravity)
        for k, point in enumerate(points):
            energy = energy - self.masses[k // N_ARCS] / N_ARCS * (point @ gravity)
        return energy

    def _tip_and_masses(self, shapes: Tensor) -> tuple[Tensor, list[Tensor]]:
        """Return the tip (..., 3) and the middles of the arcs' chords in the base's frame [m]."""
        position = shapes.new_zeros((*shapes.shape[:-1], 3))
        rotation = torch.eye(3, dtype=shapes.dtype).expand(*shapes.shape[:-1], 3, 3)
        points = []
        for k in range(2 * N_ARCS):
            segment = k // N_ARCS
            stretch = shapes[..., 4 * N_ARCS + segment]
            length = (float(self.lengths[segment]) + stretch) / N_ARCS
            turn, chord = _arc(shapes[..., 2 * k : 2 * k + 2], length)
            ahead = position + (rotation @ chord[..., None])[..., 0]
            points.append(0.5 * (position + ahead))
            position, rotation = ahead, rotation @ turn
        return position + self.tool * rotation[..., 2], points

    def write_log(
        self,
        path: str | Path,
        seed: int,
        *,
        motions: int = 30,
        rows: int = 40,
        balanced: bool = True,
        commands: str = "rounded",
        noise: float = 5e-4,
        bend: float = 1.1,
    ) -> RecordedLog:
        """Write a log of smooth motions from the straight robot and back, and return it.

        Parameters
        ----------
        path : path-like
            CSV file with the columns motion, q1 to qn [counts], x, y and z [mm].
        seed : int
            Seed of motions and noise.
        motions, rows : int, default=30 and 40
            Number of motions, and of rows in each.
        balanced : bool, default=True
            Whether the pulls of a segment add up to zero, up to rounding.
        commands : {"rounded", "exact", "dithered", "noisy"}, default="rounded"
            "exact": motors that take fractions of a count. "dithered": up to 2 counts are added at
            random. "noisy": the log has counts that were read with a noise of one count.
        noise : float, default=5e-4
            Standard deviation of every coordinate of the camera [m].
        bend : float, default=1.1
            Largest bend of a segment that is commanded [rad].

        Returns
        -------
        RecordedLog
            The rows of the log.
        """
        if commands not in COMMANDS:
            raise ValueError(f"`commands` must be one of {COMMANDS}, got {commands!r}.")
        rng = np.random.default_rng([seed, 1])
        sent = self.counts(self._motion_pulls(rng, motions, rows, bend, balanced))
        if commands == "dithered":
            sent = sent + rng.integers(-_DITHER, _DITHER + 1, sent.shape)
        if commands != "exact":
            sent = np.round(sent)
        pulls = self.behind_backlash(self.pulls(sent))
        true_tips = self.tips_of(pulls)
        tips = true_tips + noise * rng.standard_normal(true_tips.shape)
        logged = sent
        if commands == "noisy":
            logged = np.round(sent + _READING_NOISE * rng.standard_normal(sent.shape))
        groups = np.repeat(np.arange(motions), rows)
        names = ["motion", *(f"q{i + 1}" for i in range(self.n_tendons)), "x", "y", "z"]
        table = np.column_stack([groups, logged, 1e3 * tips])
        counts_format = "%.4f" if commands == "exact" else "%d"
        formats = ["%d", *[counts_format] * self.n_tendons, *["%.3f"] * 3]
        np.savetxt(path, table, formats, ",", header=",".join(names), comments="")
        return RecordedLog(logged, tips, true_tips, groups, pulls[-1])

    def _motion_pulls(
        self,
        rng: np.random.Generator,
        motions: int,
        rows: int,
        bend: float,
        balanced: bool,
    ) -> NDArray:
        """Return the pulls (N, n) of motions through three random bends of both segments [m]."""
        along = np.linspace(0.0, 1.0, rows)
        knots = np.linspace(0.0, 1.0, 5)
        parts = []
        for _ in range(motions):
            direction = rng.uniform(0.0, 2 * np.pi, (3, 2))
            size = bend * np.sqrt(rng.random((3, 2)))
            goals = size[..., None] * np.stack([np.cos(direction), np.sin(direction)], axis=-1)
            goals = np.concatenate([np.zeros((1, 2, 2)), goals, np.zeros((1, 2, 2))])
            bends = np.cumsum(CubicSpline(knots, goals)(along), axis=1)[:, self.segment]
            around = np.stack([np.cos(self.angles), np.sin(self.angles)], axis=1)
            pulls = self.radii[self.segment] * (bends * around).sum(-1)
            if not balanced:
                common = _CO_CONTRACTION * rng.random((3, 2))
                common = np.concatenate([np.zeros((1, 2)), common, np.zeros((1, 2))])
                pulls = pulls + CubicSpline(knots, common)(along)[:, self.segment]
            parts.append(pulls)
        return np.concatenate(parts)

    def write_description(self, path: str | Path, seed: int) -> None:
        """Write the robot.toml of a user with a ruler.

        Radii are 3 % off, lengths 1.5 %, angles 2 degrees, counts for a millimetre 2 % (standard
        deviations). Signs and counts at rest are right. Base, stiffness, weight and backlash are
        not known.

        Parameters
        ----------
        path : path-like
            File to write.
        seed : int
            Seed of the errors of the ruler.
        """
        rng = np.random.default_rng([seed, 2])
        n = self.n_tendons // 2
        radii = self.radii * (1.0 + 0.03 * rng.standard_normal(2))
        lengths = self.lengths * (1.0 + 0.015 * rng.standard_normal(2))
        first = np.rad2deg(self.angles[[0, n]]) + 2.0 * rng.standard_normal(2)
        gain = (1.0 + 0.02 * rng.standard_normal()) / self.counts_per_metre.mean()
        # Shortening is negative: q_sign makes a pull negative, and zeros get it, too.
        signs = -self.signs
        zeros = signs * self.zeros
        lines = [
            'name = "simulated motor robot"',
            'routing = "base"',
            'calibrate = "auto"',
        ]
        for k in range(2):
            lines += [
                "[[segment]]",
                f"radius = {radii[k]:.4f}",
                f"length = {lengths[k]:.3f}",
                f"actuators = {n}",
                f"angle_deg = {first[k]:.0f}.0",
                f"offset = {round(self.tool, 3) if k else 0.0}",
                f"gain = {gain:.3g}",
                f"zeros = {zeros[k * n : (k + 1) * n].astype(int).tolist()}",
            ]
        names = [f"q{i + 1}" for i in range(self.n_tendons)]
        lines += [
            "[log]",
            f"q = {names}".replace("'", '"'),
            'x = ["x", "y", "z"]',
            'q_unit = "counts"',
            'x_unit = "mm"',
            f"q_sign = {signs.astype(int).tolist()}",
            'groups = "motion"',
        ]
        Path(path).write_text("\n".join(lines) + "\n", encoding="utf-8")


def _arc(bending: Tensor, length: Tensor) -> tuple[Tensor, Tensor]:
    """Return rotation (..., 3, 3) and chord (..., 3) of arcs by bending vectors (..., 2)."""
    square = (bending**2).sum(-1)
    sine_term = torch.ones_like(square)  # sin(t) / t
    cosine_term = 0.5 * sine_term  # (1 - cos(t)) / t^2
    power = torch.ones_like(square)
    odd = 1.0
    for k in range(1, _N_TERMS):
        power = -square * power
        odd *= 2 * k * (2 * k + 1)
        sine_term = sine_term + power / odd
        cosine_term = cosine_term + power / (odd * (2 * k + 2))
    bx, by = bending.unbind(-1)
    rows = [
        1.0 - cosine_term * bx * bx,
        -cosine_term * bx * by,
        sine_term * bx,
        -cosine_term * bx * by,
        1.0 - cosine_term * by * by,
        sine_term * by,
        -sine_term * bx,
        -sine_term * by,
        1.0 - cosine_term * square,
    ]
    rotation = torch.stack(rows, -1).unflatten(-1, (3, 3))
    chord = torch.stack([cosine_term * bx, cosine_term * by, sine_term], -1)
    return rotation, length[..., None] * chord
