"""What `hybridkin track` promises of commands, and what they do on the robot.

Robots drawn at random (`motor_robot`), with motors that take whole counts and have backlash::

    python examples/studies/motor_tracks.py --out results/motor_tracks

Three minutes of CPU time for each robot. Robot k has the seed k: its log (30 motions of 40 rows)
and the errors of its ruler, too. `hybridkin fit` and `hybridkin track` run with their default
settings on a circle or a figure eight near measured tips; a path that is refused is made smaller
as the message says. The commands are rounded to counts and sent
open loop to the simulated robot, which stands where its log ended. Promised are the errors that
`track` tells to expect, over all points and at those that are CONVERGED, and so inside the log;
true is the distance of the robot's tip from the target, of the same points. With --beyond the same
paths are made larger, by this factor, and tracked with --out-of-reach: parts leave the reach.

A *still* direction is one along which the commands of the log moved less than 2 % as far (rms) as
along the direction with the largest motion: tendons in balance have one in each segment.

Models and tracks stay in the folder ``robots``; another run with the same --out does not compute
them again (its CPU times are then small). Delete the folder after a change of the package.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import re
import resource
import shlex
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib.pyplot as plt
import numpy as np
import torch
from csv_tables import add_csv
from joblib import Parallel, delayed
from motor_robot import COMMANDS, MotorRobot, RecordedLog
from numpy.typing import NDArray
from scipy.spatial import KDTree

from hybridkin import (
    HybridForwardModel,
    cross_fit,
    datasets,
    native,
    open_model,
    robots,
    save_model,
    trajectories,
)
from hybridkin.app.workflow.errors import Promise
from hybridkin.app.workflow.report import Report

FIT = "fit"  # models that begin so are made by the command line
_STILL = 0.02  # of the rms of the direction with the largest motion
_NEAR = 0.025  # largest distance of a path from a measured tip, relative to their extent
# of the path, relative to the extent of the tips.
_SIZES = (
    0.5,
    0.4,
    0.3,
    0.25,
    0.2,
    0.15,
    0.1,
)
_CENTRES, _NORMALS = 40, 12  # that are tried
_DURATION, _DT = 20.0, 0.1  # of a path [s]
_NOISE = 5e-4  # of measured tips along each axis, as in the logs [m]
_FOLDS = 5


class Setup(NamedTuple):
    """A robot with its log, as files and as the truth behind them."""

    seed: int
    robot: MotorRobot
    log: RecordedLog
    folder: Path


class Directions(NamedTuple):
    """Directions of counts (n,), orthonormal columns, and how far the log moved along them."""

    mean: NDArray  # (n,)
    still: NDArray  # (n, k)
    moved: NDArray  # (n, n - k)
    still_rms: NDArray  # (k,) [counts]
    moved_rms: NDArray  # (n - k,) [counts]


def set_up(seed: int, folder: Path, tendons: int = 3, commands: str = "rounded") -> Setup:
    """Write the log and the description of a random robot and return them.

    Parameters
    ----------
    seed : int
        Seed of robot, log and ruler.
    folder : Path
        Folder for ``log.csv`` and ``robot.toml``.
    tendons : {3, 4}
        In each segment.
    commands : str
        As of `MotorRobot.write_log`.

    Returns
    -------
    Setup
        The robot and its log.
    """
    folder.mkdir(parents=True, exist_ok=True)
    robot = MotorRobot.random(seed, tendons_per_segment=tendons)
    log = robot.write_log(folder / "log.csv", seed, commands=commands)
    robot.write_description(folder / "robot.toml", seed)
    return Setup(seed, robot, log, folder)


def directions(counts: NDArray) -> Directions:
    """Return the directions that the counts (N, n) of a log move, and the still ones."""
    mean = counts.mean(axis=0)
    _, sizes, axes = np.linalg.svd(counts - mean, full_matrices=False)
    rms = sizes / np.sqrt(len(counts))
    still = rms < _STILL * rms.max()
    return Directions(mean, axes[still].T, axes[~still].T, rms[still], rms[~still])


def path_near_tips(tips: NDArray, seed: int, shape: str) -> NDArray:
    """Return the points (N, 3) of the largest circle or eight that is near measured tips (M, 3).

    Centres are measured tips; planes are drawn at random.
    """
    rng = np.random.default_rng(seed)
    extent = np.linalg.norm(np.ptp(tips, axis=0))
    tree = KDTree(tips)
    centres = tips[rng.choice(len(tips), _CENTRES, replace=False)]
    normals = rng.standard_normal((_NORMALS, 3))
    for size in extent * np.array(_SIZES):
        far, points = min(
            (_farthest(tree, path), path.tolist())
            for centre in centres
            for normal in normals
            for path in [_shape(shape, centre, size, normal)]
        )
        if far < _NEAR * extent:
            return np.array(points)
    raise ValueError(f"no {shape} lies near the tips of seed {seed}.")


def _shape(shape: str, centre: NDArray, size: float, normal: NDArray) -> NDArray:
    timing = {"duration": _DURATION, "dt": _DT, "normal": normal}
    if shape == "circle":
        radius = 0.5 * size
        return trajectories.spiral(centre, (radius, radius), turns=1.0, rise=0.0, **timing).x
    return trajectories.figure_eight(centre, (size, 0.5 * size), **timing).x


def _farthest(tree: KDTree, points: NDArray) -> float:
    return float(tree.query(points)[0].max())


def fit(setup: Setup, model: str) -> dict[str, Any]:
    """Fit a model, save it in its folder and return what it promises.

    Parameters
    ----------
    setup : Setup
        Robot and log.
    model : str
        A command such as "fit" or "fit --hysteresis auto", or the `error_model` of a hybrid.

    Returns
    -------
    dict
        "saved" (name), "held_out_mean" on held-out motions [m], "fit_cpu_s".
    """
    began = _cpu()
    if model.startswith(FIT):
        command = shlex.split(model)
        log, robot = setup.folder / "log.csv", setup.folder / "robot.toml"
        options = [
            "--robot",
            robot,
            "--out",
            _model_folder(setup, model),
            "--jobs",
            "1",
        ]
        record, error = _run([command[0], log, *options, *command[1:]])
        if error:
            raise RuntimeError(f"`{model}` of robot {setup.seed}: {error}")
        held_out = record["held_out"][record["saved"]]
        saved = f"{record['saved']}: {record['chosen']}"
    else:
        held_out = _fit_in_python(setup, model)
        saved = model
    return {
        "saved": saved,
        "held_out_mean": held_out["mean"],
        "fit_cpu_s": _cpu() - began,
    }


def _fit_in_python(setup: Setup, error_model: str) -> dict[str, float]:
    """Save a hybrid with its description and return its errors on held-out motions [m]."""
    robot = robots.read_description(setup.folder / "robot.toml")
    if robot.log is None:
        raise ValueError("the description lacks [log].")
    data = datasets.load_log(setup.folder / "log.csv", **robot.log.reading)
    hybrid = HybridForwardModel(robot.chain, error_model, calibrate=robot.calibrate, random_state=0)
    compared = cross_fit({"hybrid": hybrid}, data, _FOLDS)
    errors, far = compared.distances[0], compared.distances_from_others
    held_out = {"mean": float(errors.mean()), "p95": float(np.quantile(errors, 0.95))}
    folder = _model_folder(setup, error_model)
    folder.mkdir(exist_ok=True)
    training = {"saved": "hybrid", "held_out": {"hybrid": held_out}}
    training["promise"] = vars(Promise.of(errors, far))
    save_model(hybrid, folder / "model.safetensors", training=training)
    (folder / "robot.toml").write_bytes((setup.folder / "robot.toml").read_bytes())
    return held_out


def _model_folder(setup: Setup, model: str) -> Path:
    return setup.folder / f"model_{model.replace(' ', '_')}"


def _run(arguments: list[Any]) -> tuple[dict[str, Any], str]:
    """Return the JSON record of a command of hybridkin, or its error.

    A record that lies in the folder of the command is read instead.
    """
    kept = Path(arguments[arguments.index("--out") + 1]) / "report.json"
    if kept.is_file():
        return json.loads(kept.read_text(encoding="utf-8")), ""
    command = [
        sys.executable,
        "-m",
        "hybridkin",
        *map(str, arguments),
        "--json",
        "--quiet",
    ]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    done = subprocess.run(command, capture_output=True, text=True, env=environment, check=False)
    if done.returncode > 1:  # 1: points were not reached
        return {}, (done.stdout + done.stderr).strip()
    return json.loads(done.stdout), ""


def _cpu() -> float:
    """Return the CPU time of this process and of those that it waited for [s]."""
    usages = (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return sum(usage.ru_utime + usage.ru_stime for usage in usages)


def track(setup: Setup, model: str, number: int, larger: float = 1.0) -> dict[str, Any]:
    """Return what the commands of `hybridkin track` do on the robot.

    Parameters
    ----------
    setup : Setup
        Robot and log.
    model : str
        A model that `fit` has saved.
    number : int
        Of the path: even ones are circles, odd ones figures of eight.
    larger : float, default=1.0
        Factor of its size; with another one its points may be out of reach.

    Returns
    -------
    dict
        Errors [m], shares and counts of one path, see `COLUMNS`; "error" if it was refused.
    """
    began = _cpu()
    shape = "eight" if number % 2 else "circle"
    points = path_near_tips(setup.log.tips, 1000 * setup.seed + number, shape)
    entry: dict[str, Any] = {"path": f"{number} {shape}", "scale": larger}
    file = setup.folder / f"path_{number}.csv"
    table = np.column_stack([_DT * np.arange(len(points)), 1e3 * points])
    np.savetxt(file, table, "%.6f", ",", header="t,x,y,z", comments="")
    folder = _model_folder(setup, model)
    out = folder.with_name(f"{folder.name}_track_{number}")
    command = ["track", folder, file, "--unit", "mm", "--out", out]
    if larger != 1.0:
        command[-1] = out.with_name(f"{out.name}_{larger:g}")
        out = command[-1]
        command += ["--scale", larger, "--out-of-reach"]
    record, error = _run(command)
    advice = re.search(r"--scale (0\.\d+)", error)
    if advice is not None:
        entry["scale"] = float(advice.group(1))
        record, error = _run([*command, "--scale", advice.group(1)])
    if error:
        return {**entry, "error": error}
    sent = np.genfromtxt(out / "track.csv", delimiter=",", names=True, dtype=None, encoding="utf-8")
    on_path = sent["status"] != "LEAD_IN"
    n = setup.robot.n_tendons
    counts = np.stack([sent[f"q{i + 1}"] for i in range(n)], axis=1)
    # A model with backlash has what the actuators do beside the commands.
    motion = counts
    if "effective_q1" in sent.dtype.names:
        motion = np.stack([sent[f"effective_q{i + 1}"] for i in range(n)], axis=1)
    target = 1e-3 * np.stack([sent[f"target_{axis}"] for axis in "xyz"], axis=1)[on_path]
    tips = setup.robot.tips(counts, setup.log.pulls, round=True)[on_path]
    errors = np.linalg.norm(tips - target, axis=1)
    noise = _NOISE * np.random.default_rng(number).standard_normal(tips.shape)
    measured = np.linalg.norm(tips + noise - target, axis=1)
    inside = sent["status"][on_path] == "CONVERGED"
    expected_inside = record["expected_inside"]
    expected = record["expected"]
    entry |= {
        "missed": record["missed"] / record["n"],
        "missed_by": record["missed_by"],
        "expected_inside": expected_inside.get("mean", math.nan),
        "expected_mean": expected.get("mean", math.nan),
        "expected_p95": expected.get("p95", math.nan),
        "true_inside": float(errors[inside].mean()) if inside.any() else math.nan,
        "measured_inside": float(measured[inside].mean()) if inside.any() else math.nan,
        "true_mean": float(errors.mean()),
        "true_p95": float(np.quantile(errors, 0.95)),
        "true_max": float(errors.max()),
        "converged": float(np.mean(sent["status"][on_path] == "CONVERGED")),
        "in_domain": record["in_domain"],
        "size": float(np.linalg.norm(np.ptp(points, axis=0))),
    }
    entry |= along_still(setup, folder, motion[on_path])
    return {**entry, "track_cpu_s": _cpu() - began}


def along_still(setup: Setup, folder: Path, counts: NDArray) -> dict[str, float]:
    """Return how far commands (N, n) go along the still directions, and what happens there.

    Parameters
    ----------
    setup : Setup
        Robot and log.
    folder : Path
        Of the saved model.
    counts : ndarray of shape (N, n)
        Motion of the actuators along a path [counts].

    Returns
    -------
    dict
        "n_still"; rms over the log and the path ("log_rms", "path_rms", the largest of all
        directions) and "path_max" [counts]; the tip's motion for one count along the still and the
        moved directions (rms), for the saved model, its mechanical part and the robot [m]; the
        mean error of the model at the path's commands, and at the same commands without their part
        along still directions ("model_error", "model_error_projected") [m].
    """
    found = directions(setup.log.counts)
    model = open_model(folder)
    chain = model.mechanical_model_
    if chain is None:
        raise ValueError(f"{folder} has no mechanical model.")
    signs = -setup.robot.signs
    along = (counts - found.mean) @ found.still
    projected = counts - along @ found.still.T
    functions = {
        "model": lambda c: native.evaluate(model.module_, signs * c)[0],
        "mechanical": lambda c: chain(torch.from_numpy(signs * c)).detach().numpy(),
        "robot": lambda c: setup.robot.tips_of(setup.robot.pulls(c)),
    }
    entry = {
        "n_still": len(found.still_rms),
        "log_rms": float(found.still_rms.max(initial=0.0)),
        "moved_rms": float(found.moved_rms.min()),
        "path_rms": float(np.sqrt((along**2).mean(axis=0)).max(initial=0.0)),
        "path_max": float(np.abs(along).max(initial=0.0)),
    }
    rows = slice(None, None, 10)
    for name, function in functions.items():
        for kind, axes in {"still": found.still, "moved": found.moved}.items():
            entry[f"{name}_{kind}"] = _per_count(function, counts[rows], axes)
            entry[f"{name}_{kind}_in_log"] = _per_count(function, projected[rows], axes)
    for name, at in {"model_error": counts, "model_error_projected": projected}.items():
        distance = np.linalg.norm(functions["model"](at) - functions["robot"](at), axis=1)
        entry[name] = float(distance.mean())
    correction = functions["model"](counts) - functions["mechanical"](counts)
    in_log = functions["model"](projected) - functions["mechanical"](projected)
    entry["correction"] = float(np.linalg.norm(correction, axis=1).mean())
    entry["correction_projected"] = float(np.linalg.norm(in_log, axis=1).mean())
    return entry


def _per_count(function: Any, counts: NDArray, axes: NDArray) -> float:
    """Return the rms motion of the tip for one count along the axes, by central differences."""
    steps = [function(counts + axis) - function(counts - axis) for axis in axes.T]
    return float(np.sqrt(np.mean(np.sum((0.5 * np.array(steps)) ** 2, axis=-1)))) if steps else 0.0


def one_robot(
    seed: int,
    models: Sequence[str],
    n_paths: int,
    out: Path,
    tendons: int = 3,
    commands: str = "rounded",
    beyond: Sequence[float] = (),
) -> list[dict[str, Any]]:
    """Return the entries of all models and paths of a robot; a refusal is an entry, too."""
    torch.set_num_threads(1)
    setup = set_up(seed, out / "robots" / f"{seed}_{tendons}_{commands}", tendons, commands)
    entries = []
    for model in models:
        common: dict[str, Any] = {"robot": seed, "model": model, "commands": commands}
        try:
            common |= fit(setup, model)
        except (RuntimeError, ValueError) as error:
            entries.append({**common, "path": "-", "error": str(error)})
            continue
        for number in range(n_paths):
            for larger in (1.0, *beyond):
                try:
                    entry = track(setup, model, number, larger)
                except ValueError as error:
                    entry = {"path": str(number), "error": str(error)}
                entries.append({**common, **entry})
    return entries


COLUMNS = {  # heading: key, factor
    "held-out mean": ("held_out_mean", 1e3),
    "missed [%]": ("missed", 100),
    "missed by": ("missed_by", 1e3),
    "promised mean, inside": ("expected_inside", 1e3),
    "promised mean": ("expected_mean", 1e3),
    "promised 95 %": ("expected_p95", 1e3),
    "true mean, inside": ("true_inside", 1e3),
    "measured mean, inside": ("measured_inside", 1e3),
    "true mean": ("true_mean", 1e3),
    "true 95 %": ("true_p95", 1e3),
    "true max": ("true_max", 1e3),
    "scale": ("scale", 1),
    "CONVERGED [%]": ("converged", 100),
    "in domain [%]": ("in_domain", 100),
    "still directions": ("n_still", 1),
    "log along them, rms [counts]": ("log_rms", 1),
    "path along them, rms [counts]": ("path_rms", 1),
    "path along them, max [counts]": ("path_max", 1),
    "model there [um/count]": ("model_still", 1e6),
    "mechanics there [um/count]": ("mechanical_still", 1e6),
    "robot there [um/count]": ("robot_still", 1e6),
    "model's error at the commands": ("model_error", 1e3),
    "without their still part": ("model_error_projected", 1e3),
    "fit CPU [s]": ("fit_cpu_s", 1),
    "track CPU [s]": ("track_cpu_s", 1),
}
"""Columns of the table; errors in mm."""
_RATIOS = {
    "true / promised mean inside": ("true_inside", "expected_inside"),
    "measured / promised mean inside": ("measured_inside", "expected_inside"),
    "true / promised mean of all points": ("true_mean", "expected_mean"),
    "true / promised 95 % of all points": ("true_p95", "expected_p95"),
}


def tracks_report(entries: list[dict[str, Any]]) -> Report:
    """Return the report: a row for each path, the distribution of the ratios, and a picture.

    Parameters
    ----------
    entries : list of dict
        As of `one_robot`.

    Returns
    -------
    Report
        ``report.write(folder)`` writes it, with the figures in ``motor_tracks.csv``.
    """
    report = Report("Promised and true errors of commands on simulated motor robots", {})
    report.record.update(entries=entries)
    done = [entry for entry in entries if "error" not in entry]
    keys = ("robot", "model", "commands", "path")
    report.text("Errors in mm.")
    cells = [[*(str(e[key]) for key in keys), *map(_cell, _figures(e))] for e in done]
    report.table([*keys, *COLUMNS], cells)
    for model in dict.fromkeys(entry["model"] for entry in done):
        chosen = [entry for entry in done if entry["model"] == model]
        kinds = {
            "paths with all points reached": [e for e in chosen if e["missed"] == 0.0],
            "paths with missed points": [e for e in chosen if e["missed"] > 0.0],
        }
        for kind, some in kinds.items():
            for what, (true, promised) in _RATIOS.items():
                ratios = np.array([e[true] / e[promised] for e in some])
                ratios = ratios[np.isfinite(ratios)]  # no point of some paths is inside
                if not len(ratios):
                    continue
                low, median, high = np.quantile(ratios, [0.05, 0.5, 0.95])
                report.text(
                    f"{model}, {kind}: {what} over {len(ratios)} paths of "
                    f"{len({e['robot'] for e in some})} robots: median {median:.2f}, 5 % "
                    f"{low:.2f}, 95 % {high:.2f}, largest {ratios.max():.2f}."
                )
    for entry in entries:
        if "error" in entry:
            report.text(f"Refused: robot {entry['robot']}, {entry['model']}, {entry['error']}")
    if done:
        report.figure("motor_tracks", _picture(done), "Promised and true mean errors.")
    numbers = [[*(e[key] for key in keys), *_figures(e), e["saved"]] for e in done]
    add_csv(report, "motor_tracks.csv", [*keys, *COLUMNS, "saved"], numbers)
    return report


def _figures(entry: dict[str, Any]) -> list[float]:
    figures = []
    for key, factor in COLUMNS.values():
        figures.append(float("nan") if entry[key] is None else factor * float(entry[key]))
    return figures


def _cell(figure: float) -> str:
    return f"{figure:.3g}"


def _picture(entries: list[dict[str, Any]]) -> Any:
    """Return the figure of true errors against promised ones."""
    figure, ax = plt.subplots(figsize=(5.0, 5.0), layout="constrained")
    for marker, model in zip("osD^vP*X", dict.fromkeys(e["model"] for e in entries), strict=False):
        chosen = [entry for entry in entries if entry["model"] == model]
        promised = [1e3 * entry["expected_mean"] for entry in chosen]
        true = [1e3 * entry["true_mean"] for entry in chosen]
        ax.scatter(promised, true, marker=marker, alpha=0.7, label=model)
    ends = np.array([ax.get_xlim(), ax.get_ylim()])
    line = np.array([max(ends[:, 0].min(), 0.2), ends[:, 1].max()])
    ax.plot(line, line, color="0.4", linewidth=1.0, label="as promised")
    ax.plot(line, 1.5 * line, color="0.4", linewidth=1.0, linestyle=":", label="1.5 times")
    ax.set(xscale="log", yscale="log", xlabel="promised mean [mm]", ylabel="true mean [mm]")
    ax.set_title("Commands on simulated robots")
    ax.legend()
    return figure


def main(argv: Sequence[str] | None = None) -> None:
    """Run the study and write its report."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--out", type=Path, default=Path("results/motor_tracks"))
    parser.add_argument("--robots", type=int, default=20)
    parser.add_argument("--first", type=int, default=0, help="seed of the first robot")
    parser.add_argument("--paths", type=int, default=2, help="for each robot")
    parser.add_argument(
        "--models",
        nargs="+",
        default=[FIT],
        help='such as "fit --hysteresis auto" lwpr',
    )
    parser.add_argument("--tendons", type=int, default=3, help="in a segment; 4: two pairs")
    parser.add_argument("--commands", default=COMMANDS[0], choices=COMMANDS)
    parser.add_argument(
        "--beyond",
        nargs="*",
        type=float,
        default=[],
        help="also the same paths, so many times as large, such as 2",
    )
    parser.add_argument("--jobs", type=int, default=1, help="processes")
    given = parser.parse_args(argv)
    seeds = range(given.first, given.first + given.robots)
    rest = (
        given.models,
        given.paths,
        given.out,
        given.tendons,
        given.commands,
        given.beyond,
    )
    workers = Parallel(n_jobs=given.jobs, return_as="generator_unordered")
    entries = []
    began = time.monotonic()
    for some in workers(delayed(one_robot)(seed, *rest) for seed in seeds):
        entries += some
        entries.sort(key=lambda entry: entry["robot"])
        n_done = len({entry["robot"] for entry in entries})
        print(
            f"{n_done} of {len(seeds)} robots, {time.monotonic() - began:.0f} s",
            flush=True,
        )
        # What there is, if it is interrupted.
        written = tracks_report(entries).write(given.out)
    print(*written, sep="\n")


if __name__ == "__main__":
    main()
