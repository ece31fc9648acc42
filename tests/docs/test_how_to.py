"""The code of the pages in docs/how_to runs as printed, and does what they say."""

from pathlib import Path

import numpy as np
import pytest
from page_blocks import DOCS, Reader, written_on

PAGES = written_on("how_to")
# What takes long on a page, and less of it.
SHORTER = {}


def nothing(reader):
    """Check no more than that the blocks run."""


def describing(reader):
    assert "4 segments, 7 actuators" in reader.printed
    counts = np.genfromtxt("track/track.csv", delimiter=",", names=True)
    assert all((counts[f"m{k}"] % 1 == 0).all() for k in range(1, 7))
    text = Path("bellows.toml").read_text()
    assert "gain = 0.02\n" in text
    assert "zeros = -5.0\n" in text


def rigid_arms(reader):
    assert "q_max=1.5 to 2 of the model, dq_max=3 to 4 of the model" in reader.printed
    assert "<!-- measured in May -->" in Path("calibrated.urdf").read_text()


def troubleshooting(reader):
    assert "no errors and no warnings" in reader.printed
    assert "1 CONVERGED" in reader.printed


def view(reader):
    assert "http://127.0.0.1:" in reader.printed


# What a page says of what its blocks print or write.
CHECKS = {
    "describing": describing,
    "rigid_arms": rigid_arms,
    "troubleshooting": troubleshooting,
    "view": view,
}


@pytest.mark.slow
@pytest.mark.parametrize("page", PAGES)
def test_blocks_of_a_page_run(page, lab):
    reader = Reader(DOCS / "how_to" / f"{page}.md", SHORTER.get(page, ())).run()
    CHECKS.get(page, nothing)(reader)
