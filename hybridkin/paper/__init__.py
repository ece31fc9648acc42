"""The tables and figures of the paper, computed for the simulated trunk."""

from hybridkin.paper.report import run_paper
from hybridkin.paper.tables import PAPER_ELM, table1
from hybridkin.paper.tracks import tracking

__all__ = ["PAPER_ELM", "run_paper", "table1", "tracking"]
