"""The paper's tables and figures, the same for a measured log, and the learners compared."""

from hybridkin.experiments.hybrids import (
    data_demand,
    extrapolation,
    held_out_motions,
    hybrids_report,
    learning_curves,
)
from hybridkin.experiments.learners import compare_learners, learners_report, time_learners
from hybridkin.experiments.measured import compare_by_group, fit_log
from hybridkin.experiments.paper import run_paper, table1, tracking

__all__ = [
    "compare_by_group",
    "compare_learners",
    "data_demand",
    "extrapolation",
    "fit_log",
    "held_out_motions",
    "hybrids_report",
    "learners_report",
    "learning_curves",
    "run_paper",
    "table1",
    "time_learners",
    "tracking",
]
