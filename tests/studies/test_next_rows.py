import numpy as np
import pytest
from hybrid_cases import Case
from next_rows import CHOSEN, FARTHEST, RANDOM, SOBOL, box_entries, next_report, worth

from hybridkin import datasets, robots


def entry(way, n, mean, model="pose", draw=0):
    known = {"case": "trunk", "draw": draw, "way": way, "model": model, "n": n}
    return {**known, "mean": mean, "max": 5.0 * mean}


TABLE = [entry(RANDOM, n, 0.1 / n, draw=k) for k in (0, 1) for n in (50, 100, 200)]
TABLE += [entry(CHOSEN, 50, 0.1 / 80), entry(CHOSEN, 100, 0.1 / 400)]


def test_rows_are_worth_the_random_ones_of_the_same_error():
    assert worth(TABLE, "trunk", 0.1 / 80) == pytest.approx(80.0)
    assert worth(TABLE, "trunk", 0.5 / 160, "max") == pytest.approx(160.0)
    assert np.isnan(worth(TABLE, "trunk", 0.1 / 400))


def test_report_has_all_ways_and_sizes(tmp_path):
    report = next_report(TABLE, [], [entry(CHOSEN, 5, 0.004, "quadratic")])
    text = report.markdown()
    assert "| way | 50 | 100 | 200 |" in text
    assert "| random | 2.00 ± 0.00 (10) | 1.00 ± 0.00 (5) | 0.50 ± 0.00 (2) |" in text
    assert "50 rows, chosen: worth 80 random ones by the mean, 80 by the largest" in text
    assert "Motions: trunk, quadratic" in text
    names = {p.name for p in report.write(tmp_path / "out")}
    assert names == {"report.md", "report.json", "next_rows.csv"}
    lines = (tmp_path / "out" / "next_rows.csv").read_text().splitlines()
    assert lines[0] == "study,case,model,rows,way,mean_mm,std_mm,max_mm"
    assert "range,trunk,pose,50,random,2.00,0.00,10.00" in lines
    assert "motions,trunk,quadratic,5,chosen,4.00,0.00,20.00" in lines


@pytest.mark.slow
def test_every_way_gets_its_entries():
    data = datasets.load_trunk()
    rows = np.flatnonzero(data.part == 3)
    q, x = data.q[rows], data.x[rows]
    tests = {"without noise": (data.q_target[rows[300:]], x[300:])}
    case = Case(
        "trunk",
        0,
        robots.bionic_handling_assistant(),
        (),
        "default",
        q[:300],
        x[:300],
        None,
        tests,
    )
    entries = box_entries(case, (25,), (), ())
    ways = [(e["way"], e["n"]) for e in entries]
    assert ways == [(way, 25) for way in (CHOSEN, FARTHEST, SOBOL, RANDOM, RANDOM)]
    assert all(0.0 < e["mean"] < e["max"] < 0.2 for e in entries)
    assert 0.0 < entries[0]["expected"] < 0.05
