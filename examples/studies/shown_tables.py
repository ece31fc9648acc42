"""Write the short tables of docs/reference/results.md from the long ones of the studies.

    python examples/studies/shown_tables.py --out docs/data

The long ones, such as hybrids.csv, hold all models and sizes; a page shows the rows that decide.
"""

from __future__ import annotations

import argparse
import csv
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TypeAlias

DATA = Path(__file__).parents[2] / "docs" / "data"

Row: TypeAlias = dict[str, str]
Table: TypeAlias = list[list[str]]

CALIBRATED, STRUCTURAL = "mechanical, calibrated", "serial, structural"
TRUNKS = ("trunk 1", "trunk 2")
ARMLAB, FTDCR, ASL = "armlab_3cable", "ftdcr_v4", "asl_trunk_static"


def read(name: str) -> list[Row]:
    """Return the lines of a study's table, by the names of its columns."""
    with open(DATA / name, newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def chosen(rows: list[Row], /, **values: str) -> list[Row]:
    """Return the rows that have these values."""
    return [row for row in rows if all(row[name] == value for name, value in values.items())]


def only(rows: list[Row], /, **values: str) -> Row:
    """Return the one row that has these values."""
    (row,) = chosen(rows, **values)
    return row


def few_rows() -> Table:
    """Return errors by robot, model and number of training rows."""
    rows, sizes = read("hybrids.csv"), ("12", "25", "100", "400")
    table = [["robot", "model", *(f"{n} rows" for n in sizes)]]
    for robot in (*TRUNKS, ARMLAB, FTDCR, ASL):
        test = "without noise" if robot in TRUNKS else "measured"
        models = [CALIBRATED, STRUCTURAL, "auto"]
        if robot in TRUNKS:
            models.insert(1, "serial, pose")
        for model in models:
            of_model = chosen(rows, study="few rows", case=robot, test=test, model=model)
            errors = [only(of_model, rows=n) for n in sizes]
            table.append([robot, model, *(f"{e['mean_mm']} ± {e['std_mm']}" for e in errors)])
    return table


def outside_the_log() -> Table:
    """Return errors outside the range of the training rows, by model and robot."""
    rows = read("hybrids.csv")
    outside = "outside the training range"
    columns = {
        "trunk 1": {"study": outside, "case": "trunk 1, inner 60 %", "test": "without noise"},
        "trunk 2": {"study": outside, "case": "trunk 2, inner 60 %", "test": "without noise"},
        "armlab": {"study": outside, "case": "armlab_3cable, pulls up to 6 mm"},
        "ftdcr_v4, plain": {"study": outside, "case": "ftdcr_v4, plain chain"},
        "ftdcr_v4, elastic": {"study": outside, "case": "ftdcr_v4, elastic tendons"},
        ASL: {"study": "held-out motions", "case": ASL, "test": "5 folds"},
    }
    models = (CALIBRATED, "parallel, the paper's ELM", "auto", "serial, pose, no guard")
    table = [["model", *columns]]
    for model in models:
        errors = [only(rows, model=model, **values) for values in columns.values()]
        table.append([model, *(mean_and_largest(error) for error in errors)])
    return table


def held_out_motions() -> Table:
    """Return errors on held-out motions of the robot with nine tendons, by chain and model."""
    rows = chosen(read("hybrids.csv"), study="held-out motions")
    tests = ("5 folds", "a pair held out", "pairs from single segments")
    play = 'auto, hysteresis="auto"'
    shown = {play: 'auto, `hysteresis="auto"`'}
    models = {
        "plain chain": (CALIBRATED, "data alone, kernel ridge", "serial, quadratic", "auto", play),
        "elastic tendons": (CALIBRATED, "parallel, kernel ridge", "auto", play),
    }
    table = [["chain", "model", *tests]]
    for chain, of_chain in models.items():
        for model in of_chain:
            errors = [only(rows, case=chain, test=test, model=model) for test in tests]
            name = shown.get(model, model)
            table.append([chain, name, *(mean_and_largest(error) for error in errors)])
    return table


def mean_and_largest(row: Row) -> str:
    """Return the mean error of a row of hybrids.csv, with the largest one in brackets."""
    return f"{row['mean_mm']} ({float(row['max_mm']):.0f})"


def markers_tip() -> Table:
    """Return errors learned from the tip alone / from three markers."""
    rows, sizes = read("markers.csv"), ("25", "50", "100", "400")
    ends = "the same chain, other two ends"
    shown = {
        "trunk 1": ("auto", "serial quadratic", ends),
        ASL: ("calibrated chain", "serial pose", ends),
    }
    table = [["robot", "model", *(f"{n} rows" for n in sizes)]]
    for robot, models in shown.items():
        for model in models:
            errors = [only(rows, robot=robot, model=model, rows=n) for n in sizes]
            name = "calibrated chain, the other two ends" if model == ends else model
            cells = (f"{e['tip_alone_mm']} / {e['three_markers_mm']}" for e in errors)
            table.append([robot, name, *cells])
    return table


def paces_by_speed() -> Table:
    """Return the domain and the errors of creeping robots by speed, the seeds side by side."""
    rows = read("paces.csv")
    shares = {
        "in the domain": "in the domain [%]",
        "of these covered": "of these within the radius [%]",
        "covered of all rows": "of all rows [%]",
    }
    table = [["hysteresis", "speed", *shares.values(), "error [mm]"]]
    for kind, speed in dict.fromkeys((row["hysteresis"], row["speed"]) for row in rows):
        seeds = chosen(rows, hysteresis=kind, speed=speed)
        cells = [", ".join(f"{100 * float(row[name]):.0f}" for row in seeds) for name in shares]
        errors = ", ".join(row["mean error [mm]"] for row in seeds)
        table.append([kind, speed, *cells, errors])
    return table


def long_logs_by_motions() -> Table:
    """Return errors by the number of motions, those of the version before in brackets."""
    rows, sizes = read("long_logs.csv"), ("24", "240", "2400")
    table = [["hysteresis", *(f"{n} motions [mm]" for n in sizes)]]
    for kind in dict.fromkeys(row["hysteresis"] for row in rows):
        cells = []
        for n in sizes:
            of_size = chosen(rows, hysteresis=kind, motions=n)
            now = _errors(chosen(of_size, version="this"), 2)
            before = _errors(chosen(of_size, version="before"), 1)
            cells.append(f"{now} ({before or 'not run'})")
        table.append([kind, *cells])
    return table


def _errors(rows: list[Row], digits: int) -> str:
    name = "error on new motions without noise [mm]"
    return ", ".join(f"{float(row[name]):.{digits}f}" for row in rows)


def late_cameras_by_delay() -> Table:
    """Return tip errors by gain, delay in periods, and whether the delay is given."""
    rows = chosen(read("late_cameras.csv"), dropouts="0.0", outliers="0.0")
    delays = ("0.0", "1.0", "2.0", "3.5", "5.0", "10.0")
    table = [["gain x dt", "delay", "noise", *(f"{float(d):g} periods" for d in delays)]]
    noises = {"0.0": "none", "1.0": "1 mm"}
    for given, words in (("1", "given"), ("0", "not given")):
        for gain in ("default", "0.5", "1.0"):
            for noise, name in noises.items():
                cells = []
                for delay in delays:
                    of_delay = chosen(
                        rows, **{"gain x dt": gain, "delay [periods]": delay, "noise [mm]": noise}
                    )
                    # without a delay there is none to give
                    row = only(of_delay, given=given if float(delay) else "1")
                    cells.append(_three_digits(float(row["mean error [mm]"])))
                table.append([gain, words, name, *cells])
    return table


def _three_digits(error: float) -> str:
    return f"{error:.2f}" if error < 100.0 else f"{error:.0f}"


TABLES: tuple[Callable[[], Table], ...] = (
    few_rows,
    outside_the_log,
    held_out_motions,
    markers_tip,
    paces_by_speed,
    long_logs_by_motions,
    late_cameras_by_delay,
)


def tables() -> Iterator[tuple[str, Table]]:
    """Yield the file name and the rows of every short table, the header first."""
    for make in TABLES:
        yield f"{make.__name__}.csv", make()


def main() -> None:
    """Write all short tables."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--out", type=Path, default=DATA, help="folder")
    folder = parser.parse_args().out
    for name, table in tables():
        with open(folder / name, "w", newline="", encoding="utf-8") as file:
            csv.writer(file, lineterminator="\n").writerows(table)


if __name__ == "__main__":
    main()
