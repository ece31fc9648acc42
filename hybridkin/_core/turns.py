"""What belongs to the process and not to one thread: threads take turns at it."""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager

from threadpoolctl import threadpool_limits


class _Turns:
    """Locks: of the filters for warnings, and of the number of threads of BLAS.

    Checks of scikit-learn change the filters and put back those that they found. Where such checks
    overlap in two threads, the filters of the first stay changed. The same is true of limits.
    """

    def __init__(self) -> None:
        self.filters, self.limits = threading.RLock(), threading.RLock()


TURNS = _Turns()
if hasattr(os, "register_at_fork"):  # other threads, which may hold a lock, are not in the child
    os.register_at_fork(after_in_child=TURNS.__init__)


@contextmanager
def one_thread() -> Iterator[None]:
    """Limit BLAS to one thread, for one block or function at a time."""
    with TURNS.limits, threadpool_limits(limits=1):
        yield
