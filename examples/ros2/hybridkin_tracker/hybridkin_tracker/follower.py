"""What the node computes, without ROS: commands in the names and the unit of the log."""

from __future__ import annotations

import numpy as np

from hybridkin import InverseKinematics, open_model
from hybridkin.app import workflow


class Follower:
    """A robot that follows a target, one period after another.

    Parameters
    ----------
    model : str or Path
        Folder or file of `hybridkin fit`.
    period : float
        Period of the commands [s].
    dq_max : float, default=0.0
        Largest speed of an actuator, in the unit of the log per second; 0: no limit.
    tolerance : float, default=1e-3
        Distance at which a target counts as reached [m].
    """

    def __init__(self, model, period, dq_max=0.0, tolerance=1e-3):
        self.model = open_model(model)
        self.log = self.model.description_.log
        self.names = list(self.log.q)
        factors = np.abs(self.log.q_factor)
        fastest = dq_max * factors if dq_max > 0.0 else np.inf
        limits = workflow.path_limits(self.model, dq_max=fastest)
        self._low, self._high = limits.commands
        self._ik = InverseKinematics(
            self.model,
            q_min=self._low,
            q_max=self._high,
            dq_max=limits.dq_max,
            dt=period,
        )
        self._tolerance = tolerance
        self._tracker = None
        self._target = None
        self._measured = None

    def actuators_at(self, names, positions):
        """Start at measured actuators, in the unit of the log; later calls change nothing."""
        if self._tracker is not None:
            return
        values = dict(zip(names, positions, strict=True))
        missing = [name for name in self.names if name not in values]
        if missing:
            raise ValueError(f"joint states lack {missing}; the model needs {self.names}.")
        row = np.array([values[name] for name in self.names])
        q = np.clip(self.log.from_log(row), self._low, self._high)
        self._tracker = self._ik.tracker(q, tol=self._tolerance)

    def target_at(self, point):
        """Follow a point (3,) [m] from now on."""
        self._target = np.asarray(point, dtype=float)

    def measured_at(self, point):
        """Use a measured tip (3,) [m] in the next period."""
        self._measured = np.asarray(point, dtype=float)

    def step(self):
        """Return the next command in the unit of the log, or None before a start and a target."""
        if self._tracker is None or self._target is None:
            return None
        q = np.asarray(self._tracker.step(self._target, x_measured=self._measured))
        self._measured = None
        return self.log.to_log(q)

    @property
    def status(self):
        """Name of the status of the last step, and the error of the tip [m]."""
        if self._tracker is None:
            return "WAITING_FOR_JOINT_STATES", float("nan")
        return self._tracker.status.name, float(self._tracker.error)
