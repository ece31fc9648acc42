"""The command line: `python -m hybridkin paper` and `python -m hybridkin fit`."""

from __future__ import annotations

import argparse
import re
import sys
import textwrap
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from tqdm import tqdm

from hybridkin import __version__, experiments
from hybridkin.simulation import NotSettledError

_USER_ERRORS = (ValueError, TypeError, OSError, ImportError, NotSettledError)

_PAPER = """\
Reproduce the paper on the simulated trunk: Table 1, error histogram, workspace, a figure eight and
a spiral tracked with the mechanical and with the hybrid model, and what the paper's samples tell
about the trunk's geometry. Needs the extra `sim` (MuJoCo)."""

_FIT = """\
Calibrate a robot to a measured log, compare mechanical, data-driven and hybrid models on motions
that they have not seen, and save the hybrid model with a report."""

_FIT_EXAMPLE = """\
example:
  hybridkin fit log.csv --robot robot.toml --groups motion --out model

The robot description names its geometry and the columns and units of its logs:

  [[segment]]
  radius = 0.0045       # of the tendon circle [m]
  length = 0.060        # [m]; leave out for extensible segments
  repeat = 3

  [log]
  q = ["t1", "t2", "t3", "t4", "t5", "t6", "t7", "t8", "t9"]
  x = ["tip_x", "tip_y", "tip_z"]
  q_unit = "mm"
  x_unit = "mm"
  q_sign = -1           # the log counts a pulled tendon as positive

All keys: python -c "import hybridkin; help(hybridkin.robots.read_description)"
"""


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit code: 0, or 2 for an error of input."""
    arguments = _parser().parse_args(argv)
    bars = _Bars()
    try:
        with warnings.catch_warnings():
            warnings.showwarning = bars.warn
            report, paths = arguments.run(arguments, bars)
    except _USER_ERRORS as error:
        bars.close()
        print(f"hybridkin: error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        bars.close()
        print("hybridkin: interrupted; nothing was written", file=sys.stderr)
        return 130
    bars.close()
    arguments.show(report)
    print("\nWrote")
    for path in paths:
        print(f"  {path}")
    return 0


class _Bars:
    """Progress bars on standard error, one for each kind of work."""

    def __init__(self) -> None:
        self._bar: Any = None
        self._seen: set[str] = set()

    def __call__(self, what: str, done: int, total: int) -> None:
        if self._bar is None or self._bar.desc != what:
            self.close()
            self._bar = tqdm(total=total, desc=what, file=sys.stderr)
        self._bar.update(done - self._bar.n)

    def warn(self, message: Any, *_: Any) -> None:
        text = str(message)
        kind = re.sub(r"[\d.]+", "", text)
        if kind not in self._seen:
            self._seen.add(kind)
            tqdm.write(f"hybridkin: warning: {text}", file=sys.stderr)

    def close(self) -> None:
        if self._bar is not None:
            self._bar.close()
        self._bar = None


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="hybridkin",
        description="Hybrid mechanical and data-driven kinematics of soft robots.",
    )
    parser.add_argument("--version", action="version", version=f"hybridkin {__version__}")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")

    paper = commands.add_parser(
        "paper", help="reproduce the paper on the simulated trunk", description=_PAPER
    )
    paper.add_argument("--out", type=Path, default=Path("results"), help="folder (results)")
    paper.add_argument("--splits", type=_count, default=20, help="random test sets (20)")
    paper.add_argument("--points", type=_count, default=151, help="time steps per path (151)")
    paper.set_defaults(run=_run_paper, show=_show_paper)

    fit = commands.add_parser(
        "fit",
        help="fit a hybrid model to a measured log",
        description=_FIT,
        epilog=_FIT_EXAMPLE,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    fit.add_argument("log", type=Path, metavar="LOG.csv", help="measured log with a header line")
    fit.add_argument("--robot", type=Path, required=True, metavar="ROBOT.toml")
    fit.add_argument("--out", type=Path, required=True, help="folder for model and report")
    fit.add_argument("--groups", metavar="COLUMN", help="column that names the motion of a row")
    fit.add_argument(
        "--exclude",
        action="append",
        default=[],
        metavar="PATTERN",
        help="motions to leave out, such as '*tendon*'; may be repeated",
    )
    fit.add_argument(
        "--loss",
        default="linear",
        choices=("linear", "soft_l1", "huber", "cauchy", "arctan"),
        help="loss of the calibration; all but linear bound outliers (linear)",
    )
    fit.add_argument("--drop-invalid", action="store_true", help="leave out rows with gaps or NaN")
    fit.set_defaults(run=_run_fit, show=_show_fit)
    for command in (paper, fit):
        command.add_argument("--seeds", type=_count, default=5, help="random networks (5)")
        command.add_argument("--jobs", type=int, default=-1, help="processes; -1: all cores (-1)")
    return parser


def _run_paper(arguments: argparse.Namespace, bars: _Bars) -> Any:
    return experiments.run_paper(
        arguments.out,
        n_splits=arguments.splits,
        n_seeds=arguments.seeds,
        n_points=arguments.points,
        n_jobs=arguments.jobs,
        progress=bars,
    )


def _run_fit(arguments: argparse.Namespace, bars: _Bars) -> Any:
    return experiments.fit_log(
        arguments.log,
        arguments.robot,
        arguments.out,
        groups=arguments.groups,
        exclude=arguments.exclude,
        loss=arguments.loss,
        n_seeds=arguments.seeds,
        drop_invalid=arguments.drop_invalid,
        n_jobs=arguments.jobs,
        progress=bars,
    )


def _show_paper(report: Any) -> None:
    print("\nTest error on the simulated trunk, mean ± std (max) [cm]")
    for entry in report.record["table1"]:
        test = {key: 100 * value for key, value in entry["test"].items()}
        name = f"{entry['model']}, {entry['learner']}".removesuffix(", -")
        print(f"  {name:34s} {test['mean']:6.2f} ± {test['std']:.2f} ({test['max']:.1f})")
    print("Tracking error on the simulated trunk, both paths, mean [cm]")
    for name, stats in report.record["tracking"]["both"].items():
        print(f"  {name:34s} {100 * stats['mean']:6.2f}")
    _show_identifiability(report.record["identifiability"])


def _show_identifiability(found: dict[str, Any]) -> None:
    print(
        f"What {found['n_single']} rows of one segment and {found['n_random']} random rows of the "
        "simulated trunk tell about its geometry"
    )
    print("  parameter                 calibrated  std. error   prior narrowed")
    for entry in found["asked"]["entries"]:
        name = f"{entry['name']} [{entry['unit']}]"
        print(
            f"  {name:24s} {entry['value']:11.2f} {entry['std_error']:11.2f} "
            f"{entry['narrowing']:10.3g} x  {'told' if entry['told'] else 'not told'}"
        )
    print("  They leave open:")
    for sentence in found["asked"]["unidentified"]:
        print(textwrap.fill(sentence, 96, initial_indent="  - ", subsequent_indent="    "))


def _show_fit(report: Any) -> None:
    print("\nTip error on motions held out [mm]          mean    95 %     max")
    for name, stats in report.record["held_out"].items():
        columns = " ".join(f"{1000 * stats[key]:7.2f}" for key in ("mean", "p95", "max"))
        print(f"  {name:36s} {columns}")


def _count(text: str) -> int:
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f"must be at least 1, got {value}")
    return value


if __name__ == "__main__":
    sys.exit(main())
