"""Threads of torch in a forked child."""

from __future__ import annotations

import os

import torch


class _Threads:
    """The number of torch's threads in a forked child.

    The child has no OpenMP threads, and would wait for them forever. Before it first computes with
    hybridkin, torch is set to one thread, unless the child has chosen another number itself.
    """

    inherited: int | None = None  # number at the fork, until the first check in a child

    def after_fork(self) -> None:
        """Note the number of threads of a new child."""
        self.inherited = torch.get_num_threads()

    def check(self) -> None:
        """Set torch to one thread if this is a child that would wait."""
        if self.inherited is not None:
            if torch.get_num_threads() == self.inherited:
                torch.set_num_threads(1)
            self.inherited = None


THREADS = _Threads()
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=THREADS.after_fork)
