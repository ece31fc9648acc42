import numpy as np
import pytest
from log_mistakes import MISTAKES, advised, examined, fits, random_case, study, write


def test_a_case_is_seeded_and_its_log_is_clean():
    case, again = random_case(4), random_case(4)
    np.testing.assert_array_equal(case.log.x, again.log.x)
    outcome = examined(case, fit=True)
    assert outcome.kinds == ()
    assert outcome.error < 0.05 * np.ptp(case.log.x)


def test_an_advised_order_mends_the_log():
    case = random_case(3)
    made = MISTAKES["two segments swapped"][0](case, np.random.default_rng(0))
    assert fits(made) > 3 * fits(case)
    mended = advised(made, examined(made).advice)
    assert fits(mended) < 1.1 * fits(case)
    assert advised(case, "look at these rows") is None


@pytest.mark.slow
def test_mistakes_are_named_and_none_is_silently_wrong():
    found = study(3)
    assert found["clean_alarms"] == found["silent"] == []
    assert len(found["mistakes"]) >= 20
    total = {
        key: sum(count.get(key, 0) for count in found["mistakes"].values())
        for key in ("n", "flagged", "named")
    }
    assert total["flagged"] >= 0.97 * total["n"]
    assert total["named"] >= 0.9 * total["n"]
    report = write(found, 1.0)
    assert "| camera pushed | 3 |" in report.markdown()
