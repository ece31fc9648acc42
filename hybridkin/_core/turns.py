"""Locks for state that all threads of the process share, and threads of torch after a fork."""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager

import torch
from threadpoolctl import threadpool_limits


class _Turns:
    """Locks for the warning filters and for the number of BLAS threads.

    Checks of scikit-learn change the filters and restore them at the end. If such checks overlap
    in two threads, the filters can stay changed. The same holds for limits of BLAS threads.
    """

    def __init__(self) -> None:
        self.filters, self.limits = threading.RLock(), threading.RLock()


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


TURNS = _Turns()
THREADS = _Threads()
if hasattr(os, "register_at_fork"):  # a child lacks the threads that may hold a lock
    os.register_at_fork(after_in_child=TURNS.__init__)
    os.register_at_fork(after_in_child=THREADS.after_fork)


@contextmanager
def one_thread() -> Iterator[None]:
    """Limit BLAS to one thread inside a block or function; only one such block runs at a time."""
    with TURNS.limits, threadpool_limits(limits=1):
        yield
