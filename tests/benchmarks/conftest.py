"""Races against peers: one thread, one core, CPU time, both sides in turn, the best of each.

``make bench`` runs them and prints one table. In a plain test run each body runs once on a few
rows: the answers are checked, nothing is timed, and no run ever asserts a time.
"""

import os
import time
from math import ceil
from typing import NamedTuple

import pytest
import torch
from threadpoolctl import threadpool_limits

from hybridkin import HybridForwardModel, datasets, robots
from hybridkin._core.model import reverse_jacobian

BATCHES = (1_000, 10_000, 100_000)
BATCH_OF_SMOKE = 8
SECONDS_PER_RACE = 4.0
SHORTEST_LAP = 0.02  # [s]; shorter calls are timed many at a time
N_JOINTS = 9


class Result(NamedTuple):
    what: str
    against: str
    rows: int
    ours: float  # seconds per row
    peer: float
    at_least: float | None
    at_most: float | None

    def cells(self):
        faster = self.peer / self.ours
        digits = 1 if faster >= 1.0 else 2
        ratio, goal, met = f"{faster:.{digits}f}x faster", "", True
        if self.at_least is not None:
            goal, met = f">= {self.at_least:g}", faster >= self.at_least
        elif self.at_most is not None:
            ratio, goal = f"{1 / faster:.2f}x the cost", f"<= {self.at_most:g}"
            met = 1 / faster <= self.at_most
        times = (f"{1e6 * seconds:.3f}" for seconds in (self.ours, self.peer))
        goal += "" if met else ", missed"
        return (self.what, self.against, f"{self.rows:,}", *times, ratio, goal)


HEAD = ("what", "peer", "rows", "ours [µs/row]", "peer [µs/row]", "ratio", "goal")
RESULTS = pytest.StashKey[list[Result]]()


def pytest_generate_tests(metafunc):
    if "batch" in metafunc.fixturenames:
        metafunc.parametrize("batch", BATCHES if _timed(metafunc.config) else [BATCH_OF_SMOKE])


def pytest_itemcollected(item):
    item.add_marker(pytest.mark.benchmark(timer=time.process_time))


def pytest_terminal_summary(terminalreporter, config):
    results = config.stash.get(RESULTS, [])
    if not results:
        return
    table = [HEAD, *(result.cells() for result in results)]
    widths = [max(map(len, column)) for column in zip(*table, strict=True)]
    terminalreporter.section("one thread, CPU time, best of each, both sides in turn")
    for line in table:
        cells = [
            cell.rjust(width) if 2 <= i <= 5 else cell.ljust(width)
            for i, (cell, width) in enumerate(zip(line, widths, strict=True))
        ]
        terminalreporter.write_line("  ".join(cells).rstrip())


def _timed(config):
    return config.getoption("benchmark_enable") or not config.getoption("benchmark_disable")


@pytest.fixture
def timed(pytestconfig):
    """Whether this is a timed run, at full size."""
    return _timed(pytestconfig)


@pytest.fixture(scope="module", autouse=True)
def one_thread():
    """One core as well where the system allows it: thread pools made by peers obey that alone."""
    threads = torch.get_num_threads()
    cores = os.sched_getaffinity(0) if hasattr(os, "sched_setaffinity") else None
    torch.set_num_threads(1)
    if cores:
        os.sched_setaffinity(0, {max(cores)})
    with threadpool_limits(1):
        yield
    if cores:
        os.sched_setaffinity(0, cores)
    torch.set_num_threads(threads)


@pytest.fixture
def race(benchmark, pytestconfig):
    """Time two functions in turn; ``race(what, against, ours, peer, rows=...)``."""

    def run(what, against, ours, peer, *, rows=1, peer_rows=None, at_least=None, at_most=None):
        if benchmark.disabled:
            peer()
            benchmark(ours)
            return
        ours_lap, ours_calls = _lap(ours)
        peer_lap, peer_calls = _lap(peer)
        peer_laps = []
        once = _seconds(ours_lap) + _seconds(peer_lap)
        benchmark.pedantic(
            ours_lap,
            setup=lambda: peer_laps.append(_seconds(peer_lap)),
            rounds=min(max(5, int(SECONDS_PER_RACE / once)), 50),
        )
        result = Result(
            what,
            against,
            rows,
            benchmark.stats.stats.min / (ours_calls * rows),
            min(peer_laps) / (peer_calls * (peer_rows or rows)),
            at_least,
            at_most,
        )
        benchmark.extra_info.update(result._asdict())
        pytestconfig.stash.setdefault(RESULTS, []).append(result)

    return run


def _lap(function):
    """Return a function long enough to be timed, and how many calls of `function` it makes."""
    function()  # compiles, fills caches
    calls = ceil(SHORTEST_LAP / max(_seconds(function), 1e-6))

    def lap():
        for _ in range(calls):
            function()

    return lap, calls


def _seconds(function):
    start = time.process_time()
    function()
    return time.process_time() - start


@pytest.fixture
def draw():
    """Draw rows of nine chamber lengths [m], uniform in the working box."""

    def rows(n):
        low, high = 0.19, 0.31  # chamber lengths [m]
        uniform = torch.rand(n, 9, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
        return low + (high - low) * uniform

    return rows


@pytest.fixture(scope="session")
def chain():
    return robots.bionic_handling_assistant()


@pytest.fixture(scope="session")
def trunk():
    return datasets.load_trunk()


@pytest.fixture(scope="session")
def hybrids(chain, trunk):
    """Fitted modules by guard: nine actuators, 100 hidden neurons."""

    def fit(guard):
        model = HybridForwardModel(chain, guard=guard, random_state=0)
        return model.fit(trunk.q, trunk.x).module_

    return {guard: fit(guard) for guard in (None, "leverage")}


@pytest.fixture(params=["vmap(jacrev)", "3 backward passes"])
def autodiff(request):
    """A name, what gives the Jacobian of any module by that way, and how much faster to be."""
    ways = {
        "vmap(jacrev)": (lambda module, q: torch.func.vmap(torch.func.jacrev(module))(q), 5),
        "3 backward passes": (lambda module, q: reverse_jacobian(module, q)[1], 2.5),
    }
    return request.param, *ways[request.param]


@pytest.fixture(scope="session")
def urdf():
    """Nine revolute joints about x, y and z in turn, 0.1 m apart; the last link is `link9`."""
    links = "".join(f'<link name="link{i}"/>' for i in range(N_JOINTS + 1))
    joints = "".join(
        f'<joint name="joint{i}" type="revolute">'
        f'<parent link="link{i - 1}"/><child link="link{i}"/><origin xyz="0 0 0.1"/>'
        f'<axis xyz="{("1 0 0", "0 1 0", "0 0 1")[i % 3]}"/>'
        '<limit lower="-3" upper="3" effort="1" velocity="1"/></joint>'
        for i in range(1, N_JOINTS + 1)
    )
    return f'<robot name="arm">{links}{joints}</robot>'


@pytest.fixture(scope="session")
def arm(urdf):
    """The nine-joint arm in pytorch_kinematics; its `jacobian` has six rows, linear ones first."""
    from pytorch_kinematics import build_serial_chain_from_urdf

    return build_serial_chain_from_urdf(urdf, f"link{N_JOINTS}").to(dtype=torch.float64)
