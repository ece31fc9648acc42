"""Work on a GPU does not make the CPU wait for it, except where it must."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
import synchronising
from torch.utils import backend_registration

ROOT = Path(__file__).parents[1]
# How often a model may wait; all others do not at all.
FADES = {"FK and J": 1, "pose and J": 1}  # whether any row is so far outside that it fades
WAITS = {
    "hybrid, network": FADES,
    "hybrid, kernel ridge": FADES,
    "blend": {"FK and J": 2},
    "serial, quadratic": FADES,
    "adapted poses": FADES,
    # Rounds of the search for taut tendons, and a question for short arcs.
    "elastic tendons": {"FK": 6, "FK and J": 6, "in_domain": 5, "pose and J": 12},
    # Newton steps whose rows end at different times.
    "tendons by force": {"FK": 45, "FK and J": 45, "in_domain": 40, "pose and J": 90},
}
# Besides one wait for each round of the loops, and two for each round of Newton's method in a box.
STEP = {"step": 10, "tracker.step": 9}
SOLVE = 14


@pytest.fixture(scope="module")
def counts():
    script = ROOT / "tests" / "synchronising.py"
    paths = os.pathsep.join(map(str, (ROOT, ROOT / "tests")))
    finished = subprocess.run(
        [sys.executable, script, "--json"],
        env={**os.environ, "PYTHONPATH": paths},
        capture_output=True,
        text=True,
        check=False,
    )
    assert finished.returncode == 0, finished.stderr
    return json.loads(finished.stdout.splitlines()[-1])


def beside_rounds(model, waits, rounds):
    """Return the waits that no round of a loop, and no evaluation of the model, accounts for."""
    per_round = {"solve_rows": 2, "evaluate": WAITS.get(model, {}).get("FK and J", 0)}
    return waits - sum(n * per_round.get(name, 1) for name, n in rounds.items())


@pytest.mark.slow
@pytest.mark.skipif(
    not hasattr(backend_registration, "_setup_privateuseone_for_python_backend"),
    reason="needs a torch that can pretend a device",
)
def test_a_device_is_waited_for_only_where_it_must_be(counts):
    """Counted of a second call; `python tests/synchronising.py NAME` shows the lines."""
    for model in synchronising.EVALUATED:
        most = WAITS.get(model, {})
        for what in ("FK", "FK and J", "in_domain"):
            waits, _ = counts[f"{model}: {what}"]
            assert waits <= most.get(what, 0), f"{model}: {what}"
        if f"{model}: pose and J" in counts:
            waits, _ = counts[f"{model}: pose and J"]
            assert waits <= most.get("pose and J", 0), model
    for model in synchronising.SOLVED:
        for what, most in STEP.items():
            assert beside_rounds(model, *counts[f"{model}: {what}"]) <= most, f"{model}: {what}"
        assert beside_rounds(model, *counts[f"{model}: solve"]) <= SOLVE, model
        # The bound sees a question that is asked in each iteration.
        asking, rounds = counts[f"{model}: solve with a question"]
        assert rounds["_lower_once"] > 4
        assert beside_rounds(model, asking, rounds) > SOLVE, model
    # Rows and results are copied once, and of a fit its sums and its layer.
    assert counts["ELM: predict"][0] <= 2
    assert counts["ELM: partial_fit"][0] <= 40
    assert counts["ELM: fit"][0] <= 50
