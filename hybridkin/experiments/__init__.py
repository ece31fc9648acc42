"""The paper's tables and figures, the same for a measured log, and the learners compared."""

from hybridkin.experiments.learners import compare_learners, learners_report, time_learners
from hybridkin.experiments.measured import compare_by_group, fit_log
from hybridkin.experiments.paper import run_paper, table1, tracking

__all__ = [
    "compare_by_group",
    "compare_learners",
    "fit_log",
    "learners_report",
    "run_paper",
    "table1",
    "time_learners",
    "tracking",
]
