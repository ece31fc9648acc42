import math

import pytest
import torch

from hybridkin._core.units import METRES, UNITS, LogUnit, motion_message


def tips(span, n=5):
    return torch.linspace(0.0, span, n, dtype=torch.float64)[:, None] * torch.eye(3)[:1]


def test_units_of_length_and_angle():
    assert METRES == {"m": 1.0, "cm": 0.01, "mm": 0.001, "um": 1e-6, "in": 0.0254}
    assert UNITS["deg"] * 180 == pytest.approx(math.pi)
    assert UNITS["rad"] == UNITS["1"] == 1.0


@pytest.mark.parametrize(
    ("span", "moved", "noticed"),
    [
        (0.5, 0.001, False),  # two lengths of 0.25 m: a robot reaches that
        (0.51, 0.001, True),  # more, of a model that hardly moves
        (0.51, 0.05, False),  # not 20 times what the model moves
        (1.01, 0.05, True),
        (2.4, 0.4, False),
        (2.51, 0.4, True),  # ten lengths of the robot, whatever the model moves
    ],
)
def test_tips_that_lie_further_apart_than_the_model_moves(span, moved, noticed):
    message = motion_message("x", tips(span), tips(moved), 0.25)
    assert (message is not None) == noticed
    if noticed:
        assert message.startswith(f"`x` spans {span:.4g} m, but the robot is only 0.25 m long")


def test_texts_name_the_unit_of_q_where_it_is_that_of_the_log():
    text = "gain / radii[0] = 0.0019 per unit of q"
    assert LogUnit.of("counts").named_in(text) == "gain / radii[0] = 0.0019 per counts"
    for unit in ("mm", "deg", "m", "1"):  # the model has metres and radians, or no name is known
        assert LogUnit.of(unit).named_in(text) == text
