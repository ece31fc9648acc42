"""Reading of tables from files: text, npz and parquet."""

from __future__ import annotations

from pathlib import Path

from hybridkin._core.text_rows import TextForm
from hybridkin.datasets._frames import frame_table
from hybridkin.datasets._npz import arrays_of, check_expansion
from hybridkin.datasets._tables import Table
from hybridkin.datasets._text_files import text_table

_MOST_COLUMNS = 10_000  # of an array

LOG_SUFFIXES = (".csv", ".tsv", ".txt", ".npz", ".parquet", ".pq")


def read_table(path: Path, form: TextForm) -> Table:
    """Return the table in a file; `form` is that of a text file."""
    if not path.is_file():
        raise FileNotFoundError(f"`path` must be a log file, there is none at {str(path)!r}.")
    if path.suffix.lower() == ".npz":
        return _read_npz(path)
    if path.suffix.lower() in (".parquet", ".pq"):
        return _read_parquet(path)
    return text_table(path, form)


def _read_npz(path: Path) -> Table:
    """Return the arrays (N,) of a file; columns of arrays (N, k) are named ``name[i]``."""
    arrays = arrays_of(path)
    columns = {name: array for name, array in arrays.items() if array.ndim == 1}
    for name, array in arrays.items():
        if array.ndim == 2 and array.shape[1] > _MOST_COLUMNS:
            raise ValueError(
                f"{name!r} of {str(path)!r} must have at most {_MOST_COLUMNS} columns, got "
                f"{array.shape[1]}; transpose it if rows and columns are swapped."
            )
        if array.ndim == 2:
            columns |= {f"{name}[{i}]": column for i, column in enumerate(array.T)}
    return Table(path, [*columns], [*columns.values()])


def _read_parquet(path: Path) -> Table:
    try:
        import pandas as pd

        _check_rows(path)
        frame = pd.read_parquet(path)
    except ImportError as error:
        raise ImportError(
            f"Reading {str(path)!r} needs pandas and pyarrow (pip install pandas pyarrow); or "
            "save the log as CSV or npz."
        ) from error
    except Exception as error:  # pyarrow and pandas have many kinds of them
        raise ValueError(f"{str(path)!r} is not a parquet file: {error!s:.200}.") from error
    return frame_table(frame, path)


def _check_rows(path: Path) -> None:
    """Raise if a parquet file has too many rows for its size, e.g. one value repeated."""
    try:
        from pyarrow.parquet import read_metadata
    except ImportError:  # fastparquet reads it
        return
    metadata = read_metadata(path)
    check_expansion(path, 8 * metadata.num_rows * metadata.num_columns)
