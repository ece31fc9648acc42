import os
from pathlib import Path

import pytest
import torch
from hypothesis import HealthCheck, settings

from hybridkin import ForwardModel
from hybridkin.native import available, backend

torch.set_num_threads(int(os.environ.get("OMP_NUM_THREADS", "1")))
# The suite takes the same few examples each time; the examination as many as it says, by its seed.
_SLOW = [HealthCheck.too_slow, HealthCheck.data_too_large, HealthCheck.filter_too_much]
settings.register_profile("suite", max_examples=10, derandomize=True, database=None, deadline=None)
# Other examples, by the seed that `make portable` gives.
settings.register_profile("portable", max_examples=10, database=None, deadline=None)
settings.register_profile(
    "examination",
    max_examples=int(os.environ.get("EXAMPLES", "500")),
    database=None,
    deadline=None,
    print_blob=True,
    suppress_health_check=_SLOW,
)
settings.load_profile("suite")
collect_ignore = ["examination"]  # `make examine` runs it
# What `make everything` cannot install; CONTRIBUTING.md has the table of what tests need.
_ABSENT = ("needs the recordings of real robots", "needs another processor", "needs a GPU")


def pytest_collection_modifyitems(items):
    if not available():
        skip = pytest.mark.skip(f"needs the compiled core; {backend(ForwardModel())}")
        for item in items:
            if item.get_closest_marker("needs_core"):
                item.add_marker(skip)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport():
    return _failed_if_skipped((yield))


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report():
    return _failed_if_skipped((yield))


def _failed_if_skipped(report):
    """Return the report; with HYBRIDKIN_MUST_RUN a skip is a failure, except what is absent."""
    if report.skipped and os.environ.get("HYBRIDKIN_MUST_RUN"):
        _, _, reason = report.longrepr
        if not reason.removeprefix("Skipped: ").startswith(_ABSENT):
            report.outcome, report.longrepr = "failed", f"{reason}, and everything must run"
    return report


@pytest.fixture
def rng():
    return torch.Generator().manual_seed(0)


@pytest.fixture
def data_home():
    home = os.environ.get("HYBRIDKIN_DATA", "")
    if not home or not Path(home).is_dir():
        pytest.skip("needs the recordings of real robots: set HYBRIDKIN_DATA to their folder")
    return Path(home)
