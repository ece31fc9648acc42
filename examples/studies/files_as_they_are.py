"""Log files as programs write them: what reading them says, and the error of the fitted model.

The table of the docs page "Results", section "Files" and ``docs/data/files.csv``::

    python examples/studies/files_as_they_are.py --csv docs/data/files.csv

Three minutes on one core. Simulated: the random robots of `log_mistakes` with seeds 0 to 4, logs of
12 motions of 16 rows in millimetres. Each log is written as a kind of file, and read twice: naming
only columns and units, and with the arguments that the message or the check asks for. The error is
the mean distance of the hybrid with linear features, radii and base calibrated, on 6 new motions.
"""

from __future__ import annotations

import argparse
import csv
import tempfile
import warnings
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from log_mistakes import Case, random_case
from numpy.typing import NDArray
from sklearn.linear_model import LinearRegression

from hybridkin import HybridForwardModel
from hybridkin.app import check_log
from hybridkin.datasets import Log, load_log
from hybridkin.hybrid.log_fit import fit_to_log

SEEDS = 5
LOST = 0.05  # part of the rows
RATE = 100  # frames per second
TIP = ("tip X", "tip Y", "tip Z")
HEADER = (
    "file",
    "arguments",
    "first reading",
    "error at once [mm]",
    "error with the arguments [mm]",
    "error of the plain file [mm]",
)

Table = list[list[str]]


def table_of(log: Log) -> Table:
    """Return frame, time, tip, actuators and motion as text, in millimetres."""
    rows = []
    for k, motion in enumerate(log.groups):
        numbers = [f"{value:.6f}" for value in 1e3 * np.hstack([log.x[k], log.q[k]])]
        rows.append([str(k), f"{k / RATE:.6f}", *numbers, f"m{motion}"])
    return rows


def lines(rows: Sequence[Sequence[str]], separator: str = ",") -> str:
    """Return rows as text."""
    return "".join(separator.join(row) + "\n" for row in rows)


def plain(log: Log) -> Table:
    """Return a table with a header."""
    return [["frame", "time", *TIP, *log.q_names, "motion"], *table_of(log)]


def motive(log: Log) -> str:
    """Return an export of OptiTrack Motive, with the actuators beside it."""
    n = len(log.q_names)
    extra = [""] * (n + 1)
    head = [
        ["Format Version", "1.23", "Take Name", "take", "Length Units", "Millimeters"],
        ["", "Type", *["Marker"] * 3, *extra],
        ["", "Name", *["tip"] * 3, *extra],
        ["", "ID", *["1F3A"] * 3, *extra],
        ["", "", *["Position"] * 3, *extra],
        ["Frame", "Time (Seconds)", "X", "Y", "Z", *log.q_names, "motion"],
    ]
    return lines(head[:1]) + "\n" + lines([*head[1:], *table_of(log)])


def vicon(log: Log) -> str:
    """Return an export of Vicon Nexus, with the actuators beside it."""
    extra = [""] * (len(log.q_names) + 1)
    rows = [[row[0], "0", *row[2:]] for row in table_of(log)]
    head = [
        ["Trajectories"],
        [str(RATE)],
        ["", "", "tip", "", "", *extra],
        ["Frame", "Sub Frame", "X", "Y", "Z", *log.q_names, "motion"],
        ["", "", "mm", "mm", "mm", *extra],
    ]
    return lines([*head, *rows])


def qualisys(log: Log) -> str:
    """Return an export of Qualisys Track Manager, with the actuators beside it."""
    head = [
        ["NO_OF_FRAMES", str(len(log.q))],
        ["NO_OF_MARKERS", "1"],
        ["FREQUENCY", str(RATE)],
        ["DATA_INCLUDED", "3D"],
        ["MARKER_NAMES", "tip"],
        ["Frame", "Time", *TIP, *log.q_names, "motion"],
    ]
    return lines([*head, *table_of(log)], "\t")


def unknown_block(log: Log) -> str:
    """Return a table below lines of another program."""
    return f"# robot 3, by Ann, May 2024\nrate: {RATE}\n\n" + lines(plain(log))


def decimal_commas(log: Log) -> str:
    """Return a table as spreadsheets of many countries write it."""
    return lines(plain(log), ";").replace(".", ",")


def with_index(log: Log) -> str:
    """Return a table whose rows begin with an index that the header lacks."""
    head, *rows = plain(log)
    return lines([head, *([str(k), *row] for k, row in enumerate(rows))])


def shifted_header(log: Log) -> str:
    """Return a table whose header names one column more than the rows have."""
    head, *rows = plain(log)
    return lines([["index", *head], *rows])


def with_lost_tips(number: float) -> Callable[[Log], str]:
    """Return a kind of file in which lost tips hold a number."""

    def text(log: Log) -> str:
        head, *rows = plain(log)
        rng = np.random.default_rng(len(log.q))
        for k in rng.choice(len(rows), size=int(LOST * len(rows)), replace=False):
            rows[k][2:5] = [f"{number:.3f}"] * 3
        return lines([head, *rows])

    return text


@dataclass(frozen=True)
class Kind:
    """A kind of file, and the arguments with which it is read in the end."""

    name: str
    text: Callable[[Log], str]
    arguments: Mapping[str, Any] = field(default_factory=dict)
    encoding: str = "utf-8"


KINDS = (
    Kind("plain CSV", lambda log: lines(plain(log))),
    Kind("Motive", motive),
    Kind("Vicon Nexus", vicon),
    Kind("Qualisys", qualisys),
    Kind("unknown lines above the header", unknown_block, {"header_line": 4}),
    Kind("decimal commas", decimal_commas, {"decimal": ","}),
    Kind("UTF-16, tabs", lambda log: lines(plain(log), "\t"), encoding="utf-16"),
    Kind(
        "Windows encoding",
        lambda log: lines(plain(log)).replace("frame", "Länge [°]", 1),
        encoding="cp1252",
    ),
    Kind("index without a name", with_index),
    Kind("header one name too long", shifted_header),
    Kind(
        "lost tips 9999.999",
        with_lost_tips(9999.999),
        {"missing": [9999.999], "drop_invalid": True},
    ),
    Kind(
        "lost tips 0 0 0",
        with_lost_tips(0.0),
        {"missing": [0.0], "drop_invalid": True},
    ),
)


def error_of(case: Case, log: Log) -> float:
    """Return the error of a model of a log on new motions [mm]."""
    names = ("radii", "base") if case.base_is_free else ("radii",)
    model = HybridForwardModel(case.chain, LinearRegression(), calibrate=names)
    fitted = fit_to_log(*model.prepared(log.q, log.x, groups=log.groups))
    with torch.no_grad():
        tips: NDArray = fitted.module(torch.from_numpy(case.test.q)).numpy()
    return float(1e3 * np.linalg.norm(tips - case.test.x, axis=1).mean())


def read(case: Case, path: Path, arguments: Mapping[str, Any]) -> tuple[str, float]:
    """Return what reading and check say of a file, and the error of a model (NaN: refused)."""
    columns = {"q": case.log.q_names, "x": TIP, "groups": "motion"}
    units = {"q_unit": "mm", "x_unit": "mm"}
    try:
        log = load_log(path, **columns, **units, **arguments)
    except ValueError as error:
        return f"refused: {_asked(str(error))}", np.nan
    report = check_log(log, chain=case.chain, base_is_free=case.base_is_free)
    kinds = sorted({finding.kind for finding in report.errors})
    said = f"error: {', '.join(kinds)}" if kinds else "nothing"
    return said, error_of(case, log)


def _asked(message: str) -> str:
    """Return what a message asks for."""
    for words in (
        "header_line=",
        "decimal=",
        "names ",
        "x_unit=",
        "delimiter",
        "UTF-8",
    ):
        if words in message:
            return {"names ": "counts of cells"}.get(words, words.rstrip("="))
    return "no way out named"


def figures(kind: Kind) -> list[str]:
    """Return the row of the table of a kind of file."""
    said = []
    errors = []
    for seed in range(SEEDS):
        case = random_case(seed)
        with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
            warnings.simplefilter("ignore")
            path = Path(folder) / "log.csv"
            path.write_bytes(kind.text(case.log).encode(kind.encoding))
            words, at_once = read(case, path, {})
            said.append(words)
            try:
                mended = read(case, path, kind.arguments)[1]
            except TypeError:  # an argument that this version lacks
                mended = np.nan
            errors.append([at_once, mended, error_of(case, case.log)])
    counts = Counter(said)
    words = "; ".join(f"{word} ({n} of {SEEDS})" for word, n in counts.items())
    arguments = ", ".join(f"{key}={value}" for key, value in kind.arguments.items())
    means = [_text(column) for column in np.transpose(errors)]
    return [kind.name, arguments, words, *means]


def _text(errors: NDArray) -> str:
    return "refused" if np.isnan(errors).any() else f"{errors.mean():.3g}"


def main() -> None:
    """Print the table, and write it as CSV."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--csv", type=Path, required=True)
    path = parser.parse_args().csv
    rows = []
    for kind in KINDS:
        rows.append(figures(kind))
        print(*rows[-1], sep=" | ", flush=True)
    with open(path, "w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(HEADER)
        writer.writerows(rows)


if __name__ == "__main__":
    main()
