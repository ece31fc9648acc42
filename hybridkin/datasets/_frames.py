"""Data frames of any library as tables: pandas, polars, pyarrow, modin and their kin."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from hybridkin.datasets._tables import Table


def frame_table(frame: Any, source: str | Path) -> Table:
    """Return the columns of a data frame, which are converted when they are used."""
    columns = _FrameColumns(frame)
    return Table(source, [str(name) for name in columns.keys], columns)


class _FrameColumns(Sequence[Any]):
    """The columns of a data frame as arrays."""

    def __init__(self, frame: Any) -> None:
        names = getattr(frame, "column_names", None)  # of pyarrow, whose columns are data
        if names is None:
            names = getattr(frame, "columns", None)
        if names is None or not hasattr(frame, "__getitem__"):
            raise TypeError(
                "`df` must be a data frame, as of pandas, polars or pyarrow, got "
                f"{type(frame).__name__}; give arrays as Log(q, x), and collect a lazy frame first."
            )
        self.frame = frame
        self.keys = list(names)

    def __len__(self) -> int:
        """Return the number of columns."""
        return len(self.keys)

    def __getitem__(self, index: Any) -> Any:
        """Return a column as an array (N,)."""
        column = self.frame[self.keys[index]]
        if hasattr(column, "to_numpy"):
            return column.to_numpy()
        return np.asarray(column)
