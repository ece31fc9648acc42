"""Readers under atheris, which looks for files that reach new lines of them.

    python tests/examination/_fuzz_readers.py FOLDER -max_total_time=60 -seed=20

The first byte of an input chooses the reader, the rest is the file. FOLDER gets whole files.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

import atheris

HERE = Path(__file__).parent
sys.path[:0] = [str(HERE), str(HERE.parent / "saving"), str(HERE.parents[1] / "examples")]
with atheris.instrument_imports(include=["hybridkin"]):
    from _readers import READERS, outcome

KINDS = ("csv", "points", "toml", "urdf", "model", "npz", "recording")


def examined(data: bytes) -> None:
    """Read a file; raise where it is neither refused nor used."""
    if data:
        kind = KINDS[data[0] % len(KINDS)]
        path = Path(FOLDER) / READERS[kind].name
        path.write_bytes(data[1:])
        said = outcome(kind, 0, path)
        if said not in ("refused", "read"):
            raise AssertionError(f"{kind}: {said}")


if __name__ == "__main__":
    FOLDER = tempfile.mkdtemp(dir=sys.argv[1])
    for k, kind in enumerate(KINDS):
        (Path(sys.argv[1]) / kind).write_bytes(bytes([k]) + READERS[kind].whole[0])
    atheris.Setup(sys.argv, examined)
    atheris.Fuzz()
