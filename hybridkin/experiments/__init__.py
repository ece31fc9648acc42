"""The paper's tables and figures, fits and tests on measured logs, tracks, learners compared."""

from hybridkin.experiments._domain import middle_tip, path_limits
from hybridkin.experiments._measured_log import LogError, MeasuredLog, read_log
from hybridkin.experiments._opened import OpenedModel, open_model, trunk_model
from hybridkin.experiments.describing import describe_model
from hybridkin.experiments.evaluation import evaluate_log
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
from hybridkin.experiments.speed import measure_speed
from hybridkin.experiments.steering import (
    animate_track,
    read_path,
    track_path,
)

__all__ = [
    "LogError",
    "MeasuredLog",
    "OpenedModel",
    "animate_track",
    "compare_by_group",
    "compare_learners",
    "data_demand",
    "describe_model",
    "evaluate_log",
    "extrapolation",
    "fit_log",
    "held_out_motions",
    "hybrids_report",
    "learners_report",
    "learning_curves",
    "measure_speed",
    "middle_tip",
    "open_model",
    "path_limits",
    "read_log",
    "read_path",
    "run_paper",
    "table1",
    "time_learners",
    "track_path",
    "tracking",
    "trunk_model",
]
