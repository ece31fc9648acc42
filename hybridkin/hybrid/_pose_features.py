"""Features of the shape of a chain of arcs: axes of its segments, and moments about them."""

from __future__ import annotations

from functools import partial

import torch
from torch import Tensor

from hybridkin._core.blocks import in_blocks
from hybridkin.chains._arcs import tip_and_columns
from hybridkin.chains.arc_chain import ArcChain
from hybridkin.hybrid._features import Features

_BLOCK = 2048  # rows, whose temporaries stay near in the cache


class PoseFeatures(Features):
    """The linear features, then axes of the segments and moments of loads about the segments.

    What bends a soft robot besides its actuators are mostly loads: its weight and what it carries.
    A load of direction g at the robot's end turns the frame after segment s with the moment d x g,
    d being the lever from that frame to the end. Seen in the frame itself, whose axes are a_i, it
    has the components a_i . (d x g) = g . (a_i x d), and the load the components g . a_i. So the
    features are, for S segments and with all vectors in the base frame,

    - the lever from the base to the end: 3 numbers, which stand for the moments at the base;
    - segment by segment the axes a_i of the frame after it, 9 numbers, and but for the last
      segment the moments a_i x d about that frame, 9 numbers; a frame includes the rigid offset.

    These are 18 S - 6 features. Levers are divided by the reach of the chain, so all are numbers
    without unit and of the order of one. They need no direction of gravity: the weights learn it.
    The pose of the base changes nothing here. Levers reach to the robot's end also where another
    point is steered.

    Parameters
    ----------
    center, scale : Tensor of shape (n,)
        Map of the training range to [-1, 1] [unit of q].
    chain : ArcChain
        The robot; its parameters and buffers are those of the features, too.
    """

    def __init__(self, center: Tensor, scale: Tensor, chain: ArcChain) -> None:
        super().__init__(center, scale)
        self.chain = chain

    def _bent(self, u: Tensor) -> tuple[Tensor, ...]:
        return in_blocks(self._rows_bent, u, _BLOCK)

    def _bent_readout(self, u: Tensor, weights: Tensor) -> tuple[Tensor, Tensor]:
        value, slope = in_blocks(partial(self._rows_readout, weights=weights), u, _BLOCK)
        return value, slope

    def _rows_bent(self, u: Tensor) -> tuple[Tensor]:
        vectors, lever = self._vectors(self._arcs_and_slope(u)[0])[:2]
        return (torch.cat([lever, *vectors]).mT,)

    def _rows_readout(self, u: Tensor, weights: Tensor) -> tuple[Tensor, Tensor]:
        # Virtual work: the weights are forces on vectors. Those of a frame turn as one with every
        # segment before them; every segment after them moves the end of their lever.
        arcs, slope = self._arcs_and_slope(u)
        vectors, lever, moves, spins = self._vectors(arcs)
        C = len(weights)
        at_base, *forces = weights.split([3, *(len(part) for part in vectors)], dim=1)
        value = at_base @ lever
        pulls = [at_base[:, :, None]]  # on the end, by the frames before a segment
        turns = []  # by the frames after a segment
        for force, part in zip(forces, vectors, strict=True):
            value = value + force @ part
            turning = _turning(force)
            turns.append((turning @ part).unflatten(0, (C, 3)))
            if len(turns) < len(vectors):
                pulls.append(pulls[-1] - (turning[:, 9:] @ part[:9]).unflatten(0, (C, 3)))
        work = []
        for k in reversed(range(len(turns))):
            if k + 1 < len(turns):
                turns[k] += turns[k + 1]
            own = pulls[k][:, 0, None] * moves[0, :, k]
            for axis in (1, 2):
                own.addcmul_(pulls[k][:, axis, None], moves[axis, :, k])
            for axis in (0, 1, 2):  # a length turns nothing
                own[:, 1:].addcmul_(turns[k][:, axis, None], spins[axis, 1:, k])
            work.append(own)
        by_arcs = torch.stack(work[::-1], 2).flatten(1, 2)  # (C, 3 S, N)
        scale = self.scale.to(u)
        if slope.ndim == 2:
            by_inputs = ((slope * scale).mT @ by_arcs).flatten(0, 1)
            return value.mT, by_inputs.mT.contiguous().unflatten(1, (C, -1))
        return value.mT, by_arcs.permute(2, 0, 1) @ slope.permute(2, 0, 1) * scale

    def _arcs_and_slope(self, u: Tensor) -> tuple[Tensor, Tensor]:
        return self.chain._arcs_and_slope(u * self.scale.to(u) + self.center.to(u))

    def _vectors(self, arcs: Tensor) -> tuple[list[Tensor], Tensor, Tensor, Tensor]:
        """Return the features of every frame and what moves them, from arcs (3 S, N).

        These are axes and moments (18, N) of every frame, the last without moments (9, N); the
        lever (3, N) from the base; and how the end moves and turns by the arcs, (3, 3, S, N) each.
        """
        length, bending = self.chain._split(arcs)
        S, offsets = len(length), self.chain.offsets.to(arcs)
        columns = tip_and_columns(length, bending, offsets, angular=True, rigid=True)[1]
        moves, spins, z = columns.split([3 * S, 3 * S, S], dim=1)
        # An arc of length l and bending b goes l c along c, the derivative by its length, and
        # turns the axes across it by -b c.
        along = moves[:, :S]
        x, y = torch.eye(3).to(arcs)[:2, :, None, None] - (bending[:, None] * along).cumsum(2)
        points = (length * along + offsets[:, None] * z).cumsum(1)
        reach = self.chain.reach
        assert isinstance(reach, Tensor)
        reach = reach.to(arcs)
        a, b, c = (points[:, -1:] - points) / reach
        axes = torch.stack([x, y, z])
        x, y, z = axes.unbind(1)
        moments = torch.stack([y * c - z * b, z * a - x * c, x * b - y * a], 1)
        vectors = torch.cat([axes, moments]).flatten(0, 1).unbind(1)
        frames = [*vectors[:-1], vectors[-1][:9]]
        moves, spins = (part.unflatten(1, (3, S)) for part in (moves / reach, spins))
        return frames, points[:, -1] / reach, moves, spins


def _turning(forces: Tensor) -> Tensor:
    """Return the map (3 C, 3 Y) of vectors y to the moments sum y x f of forces f (C, 3 Y)."""
    fx, fy, fz = forces.unflatten(1, (-1, 3)).unbind(2)
    zero = torch.zeros_like(fx)
    rows = [zero, fz, -fy, -fz, zero, fx, fy, -fx, zero]  # y x f, by the components of y
    return torch.stack(rows, -1).unflatten(-1, (3, 3)).permute(0, 2, 1, 3).reshape(3 * len(fx), -1)
