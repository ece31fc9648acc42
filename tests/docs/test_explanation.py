"""The code of the pages in docs/explanation runs as printed, and does what they say."""

import pytest
import torch
from page_blocks import DOCS, Reader, written_on

PAGES = written_on("explanation")
# What takes long on a page, and less of it.
SHORTER = {}


def nothing(reader):
    """Check no more than that the blocks run."""


def how_it_works(reader):
    assert "boom 1.045 m" in reader.printed
    assert "[ True  True  True  True  True]" in reader.printed
    crane = reader.space["chain"]
    q = torch.tensor([[0.1, 0.5, 0.2], [-0.3, 0.9, 0.3]], dtype=torch.float64)
    assert torch.autograd.gradcheck(crane, q.requires_grad_())


# What a page says of what its blocks print or write.
CHECKS = {"how_it_works": how_it_works}


@pytest.mark.slow
@pytest.mark.parametrize("page", PAGES)
def test_blocks_of_a_page_run(page, lab):
    reader = Reader(DOCS / "explanation" / f"{page}.md", SHORTER.get(page, ())).run()
    CHECKS.get(page, nothing)(reader)
