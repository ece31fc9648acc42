"""The tables and figures of the paper, on the simulated trunk."""

from hybridkin.paper.paper import run_paper, table1, tracking

__all__ = ["run_paper", "table1", "tracking"]
