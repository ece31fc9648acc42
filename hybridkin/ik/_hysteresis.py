"""Commands that lead what the actuators do, by the hysteresis of the model, in torch."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from hybridkin._core.actuation import Actuation
from hybridkin._core.kernel_numbers import IK_AT_REST_SHARE, IK_SHORTER
from hybridkin.ik._clear import Near
from hybridkin.ik._gram import apply_rows
from hybridkin.ik._rates import places_to_stop, stopping, way_to_stop
from hybridkin.ik._settings import StepSettings
from hybridkin.ik._step import StepRows
from hybridkin.ik.limits import Bounds


def lead_of(settings: StepSettings, command: Tensor, state: Any) -> Lead | Direct:
    """Return the commands (1, n) of one robot from now on; the arguments are those of `Lead`."""
    hysteresis = settings.task.hysteresis
    if hysteresis:
        return Lead(settings, hysteresis, command, state)
    return Direct(command)


class Direct:
    """Commands of one robot whose actuators do what they are commanded.

    Parameters
    ----------
    command : Tensor of shape (1, n)
        The present command.

    Attributes
    ----------
    command, effective : Tensor of shape (1, n)
        The present command, and what the actuators do.
    state : Tensor of shape (0, n)
        No state.
    """

    def __init__(self, command: Tensor) -> None:
        self.command = command
        self.state = command[:0]

    @property
    def effective(self) -> Tensor:
        """The command."""
        return self.command

    def step(
        self,
        control: Callable[..., StepRows],
        J: Tensor,
        seconds: float,
        last: Tensor,
        scene: Tensor,
    ) -> StepRows:
        """Send the next command, and return its step; see `Lead.step`."""
        step = control()
        self.command = self.command + step.dq
        return step


class Lead:
    """Commands of one robot with hysteresis; the torch counterpart of `ik_lead`.

    Parameters
    ----------
    settings : StepSettings
        The limits, which are those of commands.
    hysteresis : Actuation
        What is between commands and the motion of the actuators.
    command : Tensor of shape (1, n)
        The present command.
    state : array or Tensor of shape (R, n), optional
        State of the hysteresis before it. Default: without hysteresis.

    Attributes
    ----------
    command, effective : Tensor of shape (1, n)
        The present command, and what the actuators do.
    state : Tensor of shape (R, n)
        The present state.
    """

    def __init__(
        self,
        settings: StepSettings,
        hysteresis: Actuation,
        command: Tensor,
        state: Any,
    ) -> None:
        self._settings = settings
        self._hysteresis = hysteresis
        self.command = command
        self.effective, self.state = hysteresis.apply(command, state, 0.0)

    def step(
        self,
        control: Callable[..., StepRows],
        J: Tensor,
        seconds: float,
        last: Tensor,
        scene: Tensor,
    ) -> StepRows:
        """Send the next command, and return its step.

        First the step without limits of speed and acceleration. If its commands are beyond these,
        the step within what the actuators can do in this period. Where hysteresis stops one of
        them on its way, its command goes on, and can stop where the first step has it.

        Parameters
        ----------
        control : callable
            Returns the step of the actuators within bounds.
        J : Tensor of shape (1, m, n)
            The Jacobian of the task.
        seconds : float
            Time until the next command [s].
        last : Tensor of shape (1, n)
            The last step of the command, scaled to this period.
        scene : Tensor of shape (K, IK_OBSTACLE)
            Where the obstacles are.
        """
        settings = self._settings
        command = self.command
        limits = settings.step_bounds(command, seconds, last)
        tick = Bounds(command + limits.lower, command + limits.upper)
        step = control(self._reached(settings.box(command), seconds))
        wanted = self._commanded(step.dq, seconds)
        if settings.accelerates:
            tick = self._slowed(tick, wanted - command, step.dq, seconds)
        goal = wanted
        if ((wanted < tick.lower) | (wanted > tick.upper)).any():
            bounds = self._reached(tick, seconds)
            step = control(bounds)
            goal = self._commanded(step.dq, seconds)
            close = IK_AT_REST_SHARE * (wanted - command).abs()
            down = (step.dq <= bounds.lower + close) & (wanted < goal)
            up = (step.dq >= bounds.upper - close) & (wanted > goal)
            goal = torch.where(down | up, wanted, goal)
        known = torch.isfinite(step.sigma_min)[:, None]
        goal = tick.clip(torch.where(known, goal, command))
        if settings.clear and known.all():
            goal = self._kept_clear(goal, tick, seconds, scene)
        wished = self.effective + step.dq
        self.command = goal
        self.effective, self.state = self._hysteresis.apply(goal, self.state, seconds)
        promised = step.promised + apply_rows(J, self.effective - wished)
        held = tick.held(goal)
        return step._replace(dq=goal - command, saturated=held, promised=promised)

    def _slowed(self, tick: Bounds, way: Tensor, dq: Tensor, seconds: float) -> Bounds:
        """Return bounds of commands that can arrive after a way at the speed of steps dq."""
        change = self._settings.change(dq, seconds)
        most = stopping(way.abs() + dq.square() / (2.0 * change), change)
        end = tick.clip(self.command + way.sign() * most)
        limited = torch.isfinite(change)
        upper = torch.where(limited & (way > 0.0), end, tick.upper)
        lower = torch.where(limited & (way < 0.0), end, tick.lower)
        return Bounds(lower, upper)

    def _kept_clear(self, goal: Tensor, tick: Bounds, seconds: float, scene: Tensor) -> Tensor:
        """Return commands after which the body is clear, and can stop before obstacles.

        A command that crosses a backlash has a speed that its actuator does not have yet. So the
        commands are looked at, too, and shortened towards the hardest braking.
        """
        change = self._settings.change(goal, seconds).expand_as(goal)
        near = self._settings.clear.near(self.effective, change, scene)
        brake = tick.clip(self.command)
        wanted = goal
        part = 1.0
        for _ in range(IK_SHORTER):
            if not self._leads_into(near, goal, change, seconds):
                return goal
            part *= 0.5
            goal = brake + part * (wanted - brake)
        return brake if self._leads_into(near, goal, change, seconds) else goal

    def _leads_into(self, near: Near, goal: Tensor, change: Tensor, seconds: float) -> bool:
        """Return whether commands, or those while they stop, lead into an obstacle."""
        step = goal - self.command
        most = float((step.abs() / change).amax())
        for periods in (math.inf, 0.0, *places_to_stop()):
            if most < periods < math.inf:
                break
            command = goal + way_to_stop(step, change, periods)
            way = self._after(command, seconds) - self.effective
            if near.is_broken(near.taken(way)).any():
                return True
        return False

    def _reached(self, commands: Bounds, seconds: float) -> Bounds:
        """Return the bounds of a step of the actuators after commands in bounds (1, n).

        What they do is monotone in the command.
        """
        lower, upper = (self._after(end, seconds) for end in commands)
        lower = lower - self.effective
        return Bounds(lower, torch.maximum(lower, upper - self.effective))

    def _after(self, command: Tensor, seconds: float) -> Tensor:
        """Return what the actuators would do after a command; what is infinite has no limit."""
        finite = torch.isfinite(command)
        tried = torch.where(finite, command, self.command)
        effective, _ = self._hysteresis.apply(tried, self.state, seconds)
        return torch.where(finite, effective, command)

    def _commanded(self, dq: Tensor, seconds: float) -> Tensor:
        """Return the commands for a step of the actuators (1, n).

        One that would move far for almost nothing, such as through a backlash for rounding, is that
        of an actuator that stays, or stays itself.
        """
        goal = self.effective + dq
        command, _ = self._hysteresis.command(goal, self.state, seconds)
        if (dq.abs() < IK_AT_REST_SHARE * (command - self.command).abs()).any():
            still, _ = self._hysteresis.command(self.effective, self.state, seconds)
            nothing = dq.abs() < IK_AT_REST_SHARE * (command - still).abs()
            command = torch.where(nothing, still, command)
            goal = torch.where(nothing, self.effective, goal)
        moved = (goal - self._after(self.command, seconds)).abs()
        stays = moved < IK_AT_REST_SHARE * (command - self.command).abs()
        return torch.where(stays, self.command, command)
