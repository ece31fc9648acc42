"""The code of the pages in docs/reference runs as printed, and does what they say."""

import pytest
from page_blocks import DOCS, Reader, written_on

PAGES = written_on("reference")
# What takes long on a page, and less of it.
SHORTER = {}


def nothing(reader):
    """Check no more than that the blocks run."""


# What a page says of what its blocks print or write.
CHECKS = {}


@pytest.mark.slow
@pytest.mark.parametrize("page", PAGES)
def test_blocks_of_a_page_run(page, lab):
    reader = Reader(DOCS / "reference" / f"{page}.md", SHORTER.get(page, ())).run()
    CHECKS.get(page, nothing)(reader)
