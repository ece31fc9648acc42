"""A log from a file of the motors and one of a camera."""

import csv

import numpy as np
from simulated_log import document, run

OPTIONS = ["--q", "a,b", "--x", "X,Y,Z", "--time", "t"]


def files(folder):
    """Write 20 s of both, the camera 5 s late, with a lost tip and commas as decimals."""
    t = np.arange(0.0, 20.0, 0.05)
    q = np.stack([np.sin(t), np.cos(0.7 * t) + 0.1 * t], axis=1)
    lines = ["t;a;b;m"]
    for at, (a, b) in zip(t, q, strict=True):
        lines.append(f"{at:.3f};{a:.9f};{b:.9f};{'first' if at < 8 else 'second'}")
    (folder / "motors.csv").write_text("\n".join(lines).replace(".", ","))
    lines = ["seen;X;Y;Z"]
    for at, (a, b) in zip(t, q, strict=True):
        lines.append(f"{at + 5:.3f};{a:.9f};{b:.9f};{a * b:.9f}")
    lines[7] = f"{t[6] + 5:.3f};9999.999;9999.999;9999.999"
    (folder / "camera.csv").write_text("\n".join(lines).replace(".", ","))
    return q


def test_the_log_has_the_columns_of_both_files(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    q = files(tmp_path)
    command = ["merge", "motors.csv", "camera.csv", *OPTIONS, "--camera-time", "seen"]
    command += ["--decimal", ",", "--missing", "9999.999", "--out", "log.csv"]
    code, record = document(capsys, *command, "--groups", "m")
    assert code == 0
    assert abs(record["lag"] - 5.0) < 5e-3
    with open("log.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [*rows[0]] == ["t", "a", "b", "X", "Y", "Z", "m"]
    assert len(rows) == record["rows"] == len(q) - record["left_out"]
    for row in rows:
        assert abs(float(row["a"]) - float(row["X"])) < 6e-3
        assert row["m"] == ("first" if float(row["t"]) < 8 else "second")
    code, _, error = run(capsys, *command)
    assert code == 2
    assert f"{tmp_path} has log.csv already, which `hybridkin merge` replaces only" in error
    assert run(capsys, *command, "--force", "--lag", "5")[0] == 0
    assert (tmp_path / "log.csv").read_text().splitlines()[0].endswith(",Z,run")


def test_names_of_both_files_must_differ(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    files(tmp_path)
    command = ["merge", "motors.csv", "motors.csv", "--q", "a,b", "--x", "a,b,t", "--time", "t"]
    code, _, error = run(capsys, *command, "--decimal", ",", "--out", "log.csv")
    assert code == 2
    assert "error" in error
    assert not (tmp_path / "log.csv").exists()
