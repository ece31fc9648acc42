"""The code of the pages in docs/how_to runs as printed, and does what they say."""

from pathlib import Path

import pytest
from page_blocks import DOCS, Reader, written_on

PAGES = written_on("how_to")
# What takes long on a page, and less of it.
SHORTER = {}


def nothing(reader):
    """Check no more than that the blocks run."""


def rigid_arms(reader):
    assert "q_max=1.5 to 2 of the model, dq_max=3 to 4 of the model" in reader.printed
    assert "<!-- measured in May -->" in Path("calibrated.urdf").read_text()


# What a page says of what its blocks print or write.
CHECKS = {"rigid_arms": rigid_arms}


@pytest.mark.slow
@pytest.mark.parametrize("page", PAGES)
def test_blocks_of_a_page_run(page, lab):
    reader = Reader(DOCS / "how_to" / f"{page}.md", SHORTER.get(page, ())).run()
    CHECKS.get(page, nothing)(reader)
