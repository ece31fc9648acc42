"""A simulated log of a robot of two segments, and its description."""

import json

import numpy as np
import pytest
import torch

import hybridkin
from hybridkin.app.cli.main import main

COLUMNS = ["t1", "t2", "t3", "t4", "t5", "t6"]
HEADER = ",".join(["time", *COLUMNS, "x", "y", "z", "motion"])
FIT = ["--folds", "2", "--jobs", "1"]
ROBOT = """
name = "two segments"
calibrate = ["radii", "base"]
[[segment]]
radius = 0.0055
length = 0.1
repeat = 2
[log]
q = ["t1", "t2", "t3", "t4", "t5", "t6"]
x = ["x", "y", "z"]
q_unit = "mm"
x_unit = "mm"
q_sign = -1
groups = "motion"
time = "time"
[limits]
q_min = -0.006
q_max = 0.006
"""


def rows(n_motions=8, n=15):
    """Sweeps in mm and s that a chain misses a bit."""
    rng = np.random.default_rng(0)
    chain = hybridkin.ConstantCurvatureChain([0.005, 0.005], lengths=[0.1, 0.1])
    ring = 2.0944 * np.arange(3)
    q = []
    for _ in range(n_motions):
        way = rng.standard_normal((2, 2)) @ [np.cos(ring), np.sin(ring)]
        way *= 0.005 / np.abs(way).max()
        s = np.linspace(0, 1.5 * np.pi, n)[:, None]
        q.append(np.sin(s) * way.ravel() + 0.4 * np.sin(2 * s) * np.roll(way, 1, axis=1).ravel())
    q = np.concatenate(q)
    with torch.no_grad():
        x = chain(torch.from_numpy(q + 15.0 * q**2)).numpy()  # what pulls more gives way more
    x = x + 3e-4 * np.sin(200 * q[:, :3]) + 5e-5 * rng.standard_normal(x.shape)
    motion = np.repeat(np.arange(n_motions), n)
    return np.column_stack([0.1 * np.arange(len(q)), -1e3 * q, 1e3 * x, motion])


def write(path, table):
    np.savetxt(path, table, delimiter=",", header=HEADER, comments="", fmt="%.8g")
    return path


def run(capsys, *arguments):
    """Return exit code, standard output and standard error of a command."""
    code = main([str(argument) for argument in arguments])
    return code, *capsys.readouterr()


def document(capsys, *arguments):
    """Return exit code and the one JSON document that a command prints."""
    code, out, _ = run(capsys, *arguments, "--json")
    return code, json.loads(out, parse_constant=pytest.fail)
