"""What the studies use of `examples/paper`: the simulated trunk, its data, the paper's network."""

import sys
from pathlib import Path

sys.path.append(str(Path(__file__).parents[1]))  # where the package `paper` lies

from paper import PAPER_ELM, TrunkPlant, make_trunk, paper_protocol
from paper.tables import table1

__all__ = ["PAPER_ELM", "TrunkPlant", "make_trunk", "paper_protocol", "table1"]
