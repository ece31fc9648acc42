"""Sliders: three digits, whatever the range, and ends that are the limits."""

import numpy as np
import pytest

from hybridkin.app.viewer.sliders import Scale


@pytest.mark.parametrize("seed", range(5))
def test_ends_and_values_have_three_digits_and_a_hundred_steps(seed):
    rng = np.random.default_rng(seed)
    for _ in range(200):
        largest = 10.0 ** rng.uniform(-6.0, 6.0)
        low = -largest * rng.uniform(0.0, 1.0) * rng.integers(2)
        scale = Scale(low, largest)
        assert (scale.high - scale.low) / scale.step > 99.0
        for value in rng.uniform(low, largest, 20).tolist():
            shown = scale.shown(value)
            assert abs(shown - value) <= 0.5001 * scale.step
            assert float(f"{shown:.3g}") == pytest.approx(shown, rel=1e-12)
        assert scale.meant(scale.low) == low
        assert scale.meant(scale.high) == largest
        for value, label in scale.marks:
            assert float(label) == pytest.approx(value)
            assert len(label.strip("-").replace(".", "").lstrip("0")) <= max(3, len(f"{value:.0f}"))


def test_a_narrow_range_far_from_zero_has_more_digits():
    scale = Scale(99.0, 99.5)
    assert scale.step == pytest.approx(0.001)
    assert [label for _, label in scale.marks] == ["99.000", "99.500"]


def test_an_actuator_that_cannot_move_has_a_slider():
    scale = Scale(0.2, 0.2)
    assert scale.high > scale.low
    assert scale.shown(0.2) == 0.2
