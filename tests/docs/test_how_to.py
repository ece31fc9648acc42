"""The code of the pages in docs/how_to runs as printed, and does what they say."""

import re
from pathlib import Path

import pytest
from page_blocks import DOCS, Reader, written_on

PAGES = written_on("how_to")
# What takes long on a page, and less of it.
SHORTER = {
    "scikit_learn": [("GroupKFold(4)", "GroupKFold(2)"), ("[1e-3, 0.1]", "[1e-3]")],
}


def nothing(reader):
    """Check no more than that the blocks run."""


def rigid_arms(reader):
    assert "q_max=1.5 to 2 of the model, dq_max=3 to 4 of the model" in reader.printed
    assert "<!-- measured in May -->" in Path("calibrated.urdf").read_text()


def autograd(reader):
    said = reader.printed.splitlines()
    assert said[0] == said[4] == "tensor(True)", said
    assert said[1] == "1.79 mm tensor(True)"
    network, true_lengths = (float(line.split()[-2]) for line in said[2:4])
    assert network < true_lengths + 0.02
    before, after = (int(number) for number in re.findall(r"\d+", said[5])[:2])
    assert before > 3 * after


def scikit_learn(reader):
    rows, motions, *_, own = re.findall(r"^([\d.]+) mm", reader.printed, re.MULTILINE)
    assert float(motions) < 0.8 * float(rows)
    assert float(own) < 0.8 * float(motions)
    assert "'error_model': 'elm'" in reader.printed
    assert "\n0.0\n" in reader.printed


# What a page says of what its blocks print or write.
CHECKS = {"autograd": autograd, "scikit_learn": scikit_learn, "rigid_arms": rigid_arms}


@pytest.mark.slow
@pytest.mark.parametrize("page", PAGES)
def test_blocks_of_a_page_run(page, lab):
    reader = Reader(DOCS / "how_to" / f"{page}.md", SHORTER.get(page, ())).run()
    CHECKS.get(page, nothing)(reader)
