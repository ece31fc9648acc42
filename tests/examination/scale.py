"""Time and memory against the number of rows, each case in a process of its own.

A process may map 6 GB, so that none can take the machine down: a case that needs more fails. The
memory is the peak of the resident set less what was resident when the call began, inputs included.
The full run draws docs/images/scale.png. The robot is a simulated trunk with nine actuators; the
seed of all draws is 0.
"""

from __future__ import annotations

import json
import os
import resource
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from _line import Line
from numpy.typing import NDArray
from sklearn.utils import gen_batches
from tqdm import tqdm

ADDRESSES = 6 * 2**30
PICTURE = Path(__file__).parents[2] / "docs" / "images" / "scale.png"
CHUNK = 10_000


class Claim(NamedTuple):
    """A call, the sizes it is made at, and what it may cost."""

    what: str
    sizes: tuple[int, ...]
    short: slice  # of the sizes
    bytes_per_row: float  # of memory beside the inputs, at the largest size
    slope: float = 1.3  # of log time over log n, between the two largest sizes
    refused: int = 0  # a size at which the call raises a ValueError that names the way out


FIXED, FIXED_SHORT = 100e6, 30e6  # bytes that do not grow with the rows; of few rows less
NOISE = 0.2  # of the slope in a short run
TO_1E6, TO_1E7 = ([10**k for k in range(3, end)] for end in (7, 8))
FIT, SMALL, MIDDLE = "HybridForwardModel.fit", slice(2), slice(1, 3)
CLAIMS = {
    "elm_stream": Claim("ELMRegressor.partial_fit, 10 000 rows a call", TO_1E7[2:], SMALL, 0.0),
    "elm_fit": Claim("ELMRegressor.fit", TO_1E7, MIDDLE, 150.0),
    "elm_predict": Claim("ELMRegressor.predict", TO_1E7, MIDDLE, 100.0),
    "hybrid_predict": Claim("HybridForwardModel.predict", TO_1E7, MIDDLE, 400.0),
    "hybrid_fit": Claim(f"{FIT}, ELM", TO_1E6, MIDDLE, 1500.0),
    "solve": Claim("InverseKinematics.solve", TO_1E6, SMALL, 1500.0),
    "calibrate": Claim("calibrate, radii and base", TO_1E6, SMALL, 4000.0),
    "check_log": Claim("check_log", TO_1E6, MIDDLE, 1500.0),
    "load_csv": Claim("load_log of a CSV file", TO_1E6, MIDDLE, 2000.0),
    "kernel": Claim(f'{FIT}, "kernel"', [500, 1000, 2000, 4000], SMALL, 1.5e5, 3.2, 100_000),
    "auto": Claim(f'{FIT}, "auto"', [1000, 10_000, 100_000], slice(0), 1.5e4),
}


def examine(full: bool) -> Iterator[Line]:
    found = {}
    for name, claim in tqdm(CLAIMS.items(), "scale"):
        sizes = claim.sizes if full else claim.sizes[claim.short]
        if sizes:
            found[name] = measured(name, [*sizes, *[claim.refused][: claim.refused]])
            steepest = claim.slope if full else claim.slope + NOISE
            yield line(claim, found[name], steepest, FIXED if full else FIXED_SHORT)
    if full:
        draw(found)


def measured(name: str, sizes: list[int]) -> list[dict[str, Any]]:
    """Return what a process of its own says of each size: n, seconds, bytes, error."""
    command = [sys.executable, __file__, name, *map(str, sizes)]
    ended = subprocess.run(command, stdout=subprocess.PIPE, text=True, timeout=7200)
    points = [json.loads(row) for row in ended.stdout.splitlines()]
    if len(points) < len(sizes):
        error = f"the process ended with {ended.returncode}"
        points.append({"n": sizes[len(points)], "error": error})
    return points


def line(claim: Claim, points: list[dict[str, Any]], steepest: float, fixed: float) -> Line:
    what = f"{claim.what}: time grows at most as n^{steepest:.1f}; memory beside the inputs at "
    what += f"most {fixed / 1e6:.0f} MB + {claim.bytes_per_row / 1e3:g} kB a row"
    what += f"; {claim.refused} rows are refused" * bool(claim.refused)
    errors = [f"{p['n']} rows: {p['error']}" for p in points if "error" in p]
    done = [p for p in points if "error" not in p]
    refused = [p["n"] for p in points if p.get("error", "").startswith("ValueError: `")]
    if len(errors) > len(refused) or refused != [claim.refused][: claim.refused]:
        return Line(what, "; ".join(errors), False)
    before, last = done[-2:]
    ratio = np.log(last["n"] / before["n"])
    slope, grown = (
        np.log(max(last[key], least) / max(before[key], least)) / ratio
        for key, least in (("seconds", 1e-3), ("bytes", 1e7))
    )
    figure = f"{last['n']:.0e} rows: {last['seconds']:.3g} s, {last['bytes'] / 1e6:.0f} MB; slope "
    figure += f"of time {slope:.2f}, of memory {grown:.2f}"
    bound = fixed + claim.bytes_per_row * last["n"]
    fits = slope <= steepest and last["bytes"] <= bound
    return Line(what, "; ".join([figure, *errors]), bool(fits))


def draw(found: dict[str, list[dict[str, Any]]]) -> None:
    """Draw time and memory against the number of rows."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(1, 2, figsize=(11.0, 4.6), layout="constrained")
    for k, (name, points) in enumerate(found.items()):
        done = [p for p in points if "error" not in p]
        color = "black" if k == 10 else f"C{k}"
        n, style = [p["n"] for p in done], {"marker": "os^vD<>ph*X"[k], "color": color}
        axes[0].loglog(n, [p["seconds"] for p in done], label=CLAIMS[name].what, **style)
        axes[1].loglog(n, [max(p["bytes"], 1e6) / 1e6 for p in done], **style)
    axes[0].set(xlabel="rows", ylabel="CPU time [s]", title="Time")
    axes[1].set(xlabel="rows", ylabel="peak memory beside the inputs [MB]", title="Memory")
    for ax in axes:
        ax.grid(alpha=0.3)
    figure.legend(loc="outside right upper", fontsize=8)
    figure.savefig(PICTURE, dpi=110)


def run(name: str, sizes: list[int]) -> None:
    """Measure one case in this process and print a line of JSON for each size, smallest first."""
    resource.setrlimit(resource.RLIMIT_AS, (ADDRESSES, ADDRESSES))
    warnings.simplefilter("ignore", UserWarning)
    for n in sizes:
        point: dict[str, Any] = {"n": n}
        try:
            call = CASES[name](n)
            resident, start = now_resident(), time.process_time()
            result = call()
            point["seconds"] = time.process_time() - start
            peak = 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
            point["bytes"] = max(peak - resident, 0)
            del result, call
        except (MemoryError, RuntimeError, ValueError) as error:
            point["error"] = f"{type(error).__name__}: {error}"
        print(json.dumps(point), flush=True)


def now_resident() -> int:
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE")


def rows(n: int, seed: int = 0) -> tuple[NDArray, NDArray]:
    """Return actuator lengths and tips of a simulated trunk that the chain describes roughly."""
    from hybridkin.native.library import evaluate

    rng, chain = np.random.default_rng(seed), trunk()
    q, x = np.empty((n, 9)), np.empty((n, 3))
    for at in gen_batches(n, 10 * CHUNK):  # temporaries would count as memory of the call
        some = q[at] = rng.uniform(0.18, 0.32, q[at].shape)
        x[at] = evaluate(chain, some)[0] + 0.01 * np.sin(12.0 * some[:, :3] + 7.0 * some[:, 3:6])
        x[at] += 1e-3 * rng.standard_normal(x[at].shape)
    return q, x


def trunk() -> Any:
    from hybridkin import robots

    return robots.bionic_handling_assistant()


def hybrid(error_model: Any = None, n: int = 1000, **settings: Any) -> Any:
    from hybridkin import HybridForwardModel

    return HybridForwardModel(trunk(), error_model, random_state=0, **settings).fit(*rows(n))


def elm_stream(n: int) -> Callable[[], Any]:
    from hybridkin import ELMRegressor

    bounds = np.outer([0.18, 0.32], np.ones(9))
    elm = ELMRegressor(input_scaling=bounds, random_state=0).partial_fit(*rows(CHUNK))

    def call() -> None:
        for k in range(1, n // CHUNK):
            elm.partial_fit(*rows(CHUNK, k))

    return call


def elm_fit(n: int) -> Callable[[], Any]:
    from hybridkin import ELMRegressor

    q, x = rows(n)
    return lambda: ELMRegressor(random_state=0).fit(q, x)


def elm_predict(n: int) -> Callable[[], Any]:
    from hybridkin import ELMRegressor

    elm, q = ELMRegressor(random_state=0).fit(*rows(1000)), rows(n)[0]
    return lambda: elm.predict(q)


def hybrid_predict(n: int) -> Callable[[], Any]:
    model, q = hybrid(), rows(n)[0]
    return lambda: model.predict(q)


def hybrid_fit(n: int, error_model: Any = None) -> Callable[[], Any]:
    from hybridkin import HybridForwardModel

    data, motions = rows(n), np.arange(n) // 50
    model = HybridForwardModel(trunk(), error_model, random_state=0)
    return lambda: model.fit(*data, groups=motions)


def solve(n: int) -> Callable[[], Any]:
    from hybridkin import InverseKinematics

    model = hybrid()
    ik, targets = (
        InverseKinematics(model.module_, q_min=0.18, q_max=0.32),
        model.predict(rows(n)[0]),
    )
    return lambda: ik.solve(targets)


def calibrate(n: int) -> Callable[[], Any]:
    import hybridkin

    q, x = rows(n)
    return lambda: hybridkin.calibrate(trunk(), q, x)


def check_log(n: int) -> Callable[[], Any]:
    from hybridkin import app, datasets

    q, x = rows(n)
    log = datasets.Log(q, x, groups=np.arange(n) // 50, time=0.01 * np.arange(n))
    return lambda: app.check_log(log, chain=trunk())


def load_csv(n: int) -> Callable[[], Any]:
    from hybridkin import datasets

    folder = tempfile.TemporaryDirectory()
    path = Path(folder.name) / "log.csv"
    names = [*(f"q{k}" for k in range(9)), "x", "y", "z"]
    with path.open("w", encoding="utf-8") as file:
        file.write(",".join(names) + "\n")
        for start in range(0, n, CHUNK):
            np.savetxt(file, np.hstack(rows(min(CHUNK, n - start), start)), "%.7f", ",")

    def call() -> Any:
        with folder:
            return datasets.load_log(path, q=names[:9], x=names[9:])

    return call


CASES: dict[str, Callable[[int], Callable[[], Any]]] = {
    **{f.__name__: f for f in (elm_stream, elm_fit, elm_predict, hybrid_predict, hybrid_fit)},
    **{f.__name__: f for f in (solve, calibrate, check_log, load_csv)},
    "kernel": lambda n: hybrid_fit(n, "kernel"),
    "auto": lambda n: hybrid_fit(n, "auto"),
}

if __name__ == "__main__":
    run(sys.argv[1], [*map(int, sys.argv[2:])])
