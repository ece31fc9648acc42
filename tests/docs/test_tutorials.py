"""The code of the pages in docs/tutorials runs as printed, and does what they say."""

import re
from pathlib import Path

import pytest
from page_blocks import DOCS, Reader, written_on

PAGES = written_on("tutorials")
# What takes long on a page, and less of it.
SHORTER = {}


def nothing(reader):
    """Check no more than that the blocks run."""


def your_robot(reader):
    errors = dict(re.findall(r"(\w+): mean ([\d.]+) mm", reader.printed))
    assert float(errors["hybrid"]) < 0.6 * float(errors["mechanical"])
    assert len(Path("commands.csv").read_text().splitlines()) == len(reader.space["path"].x)


def two_minutes(reader):
    assert "25 rows" in reader.printed
    assert Path("model/model.safetensors").is_file()


# What a page says of what its blocks print or write.
CHECKS = {"your_robot": your_robot, "two_minutes": two_minutes}


@pytest.mark.slow
@pytest.mark.parametrize("page", PAGES)
def test_blocks_of_a_page_run(page, lab):
    reader = Reader(DOCS / "tutorials" / f"{page}.md", SHORTER.get(page, ())).run()
    CHECKS.get(page, nothing)(reader)
