"""The paper's tables and figures on a simulated trunk, and the simulated trunk itself.

``python examples/paper --out results`` writes the report; see `run_paper`.
"""

from paper.protocol import paper_protocol
from paper.report import run_paper
from paper.tables import PAPER_ELM, table1
from paper.tracks import tracking
from paper.trunk import NotSettledError, TrunkPlant
from paper.trunk_data import make_trunk

__all__ = [
    "PAPER_ELM",
    "NotSettledError",
    "TrunkPlant",
    "make_trunk",
    "paper_protocol",
    "run_paper",
    "table1",
    "tracking",
]
