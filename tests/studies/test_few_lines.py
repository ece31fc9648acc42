import numpy as np
import pytest
from few_lines import DOMAINS, LINES, examined, simulated_log, write


@pytest.mark.parametrize("seed", range(5))
def test_a_log_is_seeded_and_its_rows_are_lines_in_the_box(seed):
    log, again = simulated_log(seed, 60), simulated_log(seed, 60)
    np.testing.assert_array_equal(log.x, again.x)
    assert log.kind == LINES[seed]
    assert log.q.shape == (len(log.groups), 3 * log.chain.n_segments)
    assert log.q.min() > 0.158
    assert log.q.max() < 0.262
    for group in np.unique(log.groups):
        rows = log.q[log.groups == group]
        sizes = np.linalg.svd(rows - rows.mean(0), compute_uv=False)
        assert sizes[1] < 0.1 * sizes[0]  # noise


@pytest.mark.slow
def test_the_tested_distance_keeps_harmed_rows_out():
    """One segment, single actuators from the shortest: the log shows no two of them together."""
    entries = examined(6, ("kernel ridge",))
    (entry,) = entries
    alone, tested = (entry["box"][domain]["harmed"] for domain in DOMAINS)
    assert entry["segments"] == 1
    assert alone > 0.1
    assert tested < 0.2 * alone
    new = [entry["new lines"][domain]["inside"] for domain in DOMAINS]
    assert new[1] > 0.95 * new[0] > 0.8
    assert "| single actuators from the shortest | 1 |" in write(entries, 1.0).markdown()
