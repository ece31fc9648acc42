"""The code of the pages in docs/tutorials runs as printed, and does what they say."""

import re
from pathlib import Path

import pytest
from page_blocks import read, written_on

PAGES = written_on("tutorials")
# What takes long on a page, and less of it.
SHORTER = {}


def getting_started(reader):
    error, inside = re.search(r"([\d.]+) cm, (\d+) % within the radius", reader.printed).groups()
    assert abs(float(error) - 1.0) < 0.1
    assert abs(int(inside) - 76) < 5
    assert "(201, 9)" in reader.printed


def two_minutes(reader):
    assert "25 rows" in reader.printed
    assert "The promise is kept: the mean error is within" in reader.printed
    assert "76 of 76 points" in reader.printed
    for file in ("plan/next.csv", "model/model.safetensors", "track/commands.png", "more/next.csv"):
        assert Path(file).is_file()


def your_robot(reader):
    errors = dict(re.findall(r"(\w+): mean ([\d.]+) mm", reader.printed))
    assert float(errors["hybrid"]) < 0.6 * float(errors["mechanical"])
    assert "The promise is kept: the mean error is within" in reader.printed
    assert Path("track/track.png").is_file()
    for radius, ruler in zip(reader.space["result"].values["radii"], (0.008, 0.008), strict=True):
        assert abs(radius / ruler - 1.0) < 0.1
    assert len(Path("commands.csv").read_text().splitlines()) == len(reader.space["path"].x)


# What a page says of what its blocks print or write.
CHECKS = {
    "getting_started": getting_started,
    "two_minutes": two_minutes,
    "your_robot": your_robot,
}


@pytest.mark.slow
@pytest.mark.parametrize("page", PAGES)
def test_blocks_of_a_page_run(page, lab):
    read("tutorials", page, SHORTER, CHECKS)
