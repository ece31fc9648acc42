"""Locks for state that all threads of the process share."""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager

from threadpoolctl import threadpool_limits


class _Turns:
    """Locks for the warning filters and for the number of BLAS threads.

    Checks of scikit-learn change the filters and restore them at the end. If such checks overlap
    in two threads, the filters can stay changed. The same holds for limits of BLAS threads.
    """

    def __init__(self) -> None:
        self.filters = threading.RLock()
        self.limits = threading.RLock()


TURNS = _Turns()
if hasattr(os, "register_at_fork"):  # a child lacks the threads that may hold a lock
    os.register_at_fork(after_in_child=TURNS.__init__)


@contextmanager
def one_thread() -> Iterator[None]:
    """Limit BLAS to one thread inside a block or function; only one such block runs at a time."""
    with TURNS.limits, threadpool_limits(limits=1):
        yield
