"""Streams: what a fit to a log of any length takes, which is read from parquet chunk by chunk.

The table of the docs page "Benchmarks", section "Streams"::

    python examples/studies/streams.py --out results/streams

A simulated trunk moves at random; its tip sags, and is measured with 5 mm of noise in each
direction. The log is a parquet file in float32. A process of its own calibrates the chain on 2000
rows, streams all row groups but the last one through `ELMRegressor.partial_fit`, and makes a hybrid
with the frozen network. Its error is that on 20,000 new rows without noise. Logs of 1e6, 1e7 and
1e8 rows with 100 and 300 neurons take twelve minutes of one core and 5 GB on disk, which are freed.
"""

from __future__ import annotations

import argparse
import csv
import json
import resource
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import torch
from numpy.typing import NDArray
from sklearn.frozen import FrozenEstimator

from hybridkin import ELMRegressor, HybridForwardModel, robots

NOISE = 0.005  # [m]
LIMITS = np.array([[0.2] * 9, [0.25] * 9])  # of the chambers [m]
ROWS = 100_000  # of a row group, and of a chunk
Q = [f"q{i}" for i in range(9)]
X = ["x", "y", "z"]
NETWORK = {
    "alpha": 1e-3,
    "activation": "tanh",
    "weight_scale": 0.3,
    "input_scaling": LIMITS,
    "fit_intercept": True,
    "direct_link": True,
}
SIZES = (10**6, 10**7, 10**8)
HIDDEN = (100, 300)
HEADER = ["neurons", "rows", "seed", "CPU [s]", "rows per second", "memory beside imports [MB]"]
HEADER += ["error of the chain [mm]", "error of the hybrid [mm]"]


def tips(q: NDArray) -> NDArray:
    """Return the tips (N, 3) of the robot without noise [m]: those of a chain, which sags."""
    with torch.no_grad():
        x = robots.bionic_handling_assistant()(torch.from_numpy(q.astype(np.float64))).numpy()
    reach = np.linalg.norm(x[:, :2], axis=1, keepdims=True)
    return x + reach * np.hstack([0.06 * x[:, :2], -0.1 * reach])


def drawn(seed: tuple[int, int, int], n_rows: int) -> NDArray:
    """Return commands (N, 9) at random [m]."""
    low, high = LIMITS.astype(np.float32)
    unit = np.random.default_rng(seed).random((n_rows, 9), dtype=np.float32)
    return low + (high - low) * unit


def write_log(path: Path, n_rows: int, seed: int) -> None:
    """Write a log, row group after row group."""
    schema = pa.schema([(name, pa.float32()) for name in Q + X])
    options = {"use_dictionary": False, "compression": "none"}
    with pq.ParquetWriter(path, schema, **options) as writer:
        for number in range(n_rows // ROWS):
            q = drawn((0, number, seed), ROWS)
            rng = np.random.default_rng((1, number, seed))
            x = tips(q) + NOISE * rng.standard_normal((ROWS, 3), dtype=np.float32)
            columns = [*q.T.copy(), *x.T.astype(np.float32)]
            writer.write_table(pa.Table.from_arrays(columns, schema=schema))


def chunks(log: pq.ParquetFile, row_groups: range, n_rows: int) -> Iterator[tuple]:
    """Yield commands (C, 9) and tips (C, 3) of at most n_rows rows [m]."""
    for batch in log.iter_batches(n_rows, row_groups, Q + X, use_threads=False):
        q = np.column_stack([batch[name].to_numpy() for name in Q])
        x = np.column_stack([batch[name].to_numpy() for name in X])
        yield q, x


def streamed(path: Path, n_hidden: int, seed: int) -> HybridForwardModel:
    """Return the hybrid of a log; the rows of its last row group only give the guard."""
    log = pq.ParquetFile(path, pre_buffer=False)  # else pyarrow reads all of the file at once
    last = log.num_row_groups - 1
    spread = range(0, last, max(1, last // 20))
    some = [next(chunks(log, range(group, group + 1), 2000 // len(spread))) for group in spread]
    q, x = map(np.concatenate, zip(*some, strict=True))
    chain = HybridForwardModel(robots.bionic_handling_assistant(), "drop", calibrate="default")
    chain.fit(q, x)
    network = ELMRegressor(n_hidden, random_state=seed, **NETWORK)
    for q, x in chunks(log, range(last), ROWS):
        network.partial_fit(q, x - chain.predict(q))
    hybrid = HybridForwardModel(chain.mechanical_model_, FrozenEstimator(network))
    q, x = next(chunks(log, range(last, last + 1), 10_000))
    return hybrid.fit(q, x)


def error(model: HybridForwardModel, seed: int, mechanical: bool) -> float:
    """Return the root mean square error on new rows without noise [m]."""
    q = drawn((2, 0, seed), 20_000)
    predicted = model.predict_mechanical(q) if mechanical else model.predict(q)
    return float(np.sqrt(np.mean(np.sum((predicted - tips(q)) ** 2, axis=1))))


def measure(path: Path, n_hidden: int, seed: int) -> None:
    """Write time, memory and errors of the fit to a log as JSON, in a process with one fit."""
    imports = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    before = time.process_time()
    model = streamed(path, n_hidden, seed)
    seconds = time.process_time() - before
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    measured = {"seconds": seconds, "memory": (peak - imports) / 1e3}
    errors = {"chain": error(model, seed, True), "hybrid": error(model, seed, False)}
    json.dump(measured | errors, sys.stdout)


def row_of_table(path: Path, n_rows: int, n_hidden: int, seed: int) -> list[str]:
    """Return a row of the table for a log, from a process of its own."""
    command = [sys.executable, __file__, "--measure", str(path), str(n_hidden), str(seed)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    found = json.loads(done.stdout)
    return [
        str(n_hidden),
        str(n_rows),
        str(seed),
        f"{found['seconds']:.1f}",
        f"{n_rows / found['seconds']:.0f}",
        f"{found['memory']:.0f}",
        f"{1e3 * found['chain']:.3f}",
        f"{1e3 * found['hybrid']:.4f}",
    ]


def main() -> None:
    """Write streams.csv into the folder of the arguments."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("results/streams"))
    parser.add_argument("--sizes", type=int, nargs="*", default=SIZES)
    parser.add_argument("--seed", type=int, default=0, help="of the log and of the network")
    parser.add_argument("--measure", nargs=3, metavar=("LOG", "NEURONS", "SEED"))
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    if arguments.measure:
        path, n_hidden, seed = arguments.measure
        measure(Path(path), int(n_hidden), int(seed))
        return
    arguments.out.mkdir(parents=True, exist_ok=True)
    with (arguments.out / "streams.csv").open("w", newline="") as file:
        table = csv.writer(file)
        table.writerow(HEADER)
        for n_rows in arguments.sizes:
            path = arguments.out / f"{n_rows}.parquet"
            try:
                write_log(path, n_rows, arguments.seed)
                for n_hidden in HIDDEN:
                    row = row_of_table(path, n_rows, n_hidden, arguments.seed)
                    table.writerow(row)
                    file.flush()
            finally:
                path.unlink(missing_ok=True)


if __name__ == "__main__":
    main()
