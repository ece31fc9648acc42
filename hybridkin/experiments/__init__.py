"""The paper's tables and figures, and the same for a measured log."""

from hybridkin.experiments.measured import compare_by_group, fit_log
from hybridkin.experiments.paper import run_paper, table1, tracking

__all__ = ["compare_by_group", "fit_log", "run_paper", "table1", "tracking"]
