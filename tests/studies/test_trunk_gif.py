from pathlib import Path

import numpy as np
import pytest
import trunk_gif
from PIL import Image

from hybridkin import trajectories

PICTURE = Path(trunk_gif.__file__).parents[2] / "docs" / "images" / "trunk.gif"


def test_the_moving_picture_is_small_and_short():
    assert PICTURE.stat().st_size < 1e6
    with Image.open(PICTURE) as image:
        assert image.size[0] == 700
        shown = []
        for k in range(image.n_frames):
            image.seek(k)
            shown.append(image.info["duration"])
    assert 4000 <= sum(shown) <= 8000


@pytest.mark.slow
def test_a_picture_shows_the_trunk_twice():
    pytest.importorskip("mujoco")
    path = trajectories.line((0.0, 0.0, 0.7), (0.1, 0.0, 0.7), duration=0.2, dt=0.1)
    pictures = trunk_gif.frames(path)
    assert len(pictures) == len(path)
    first, last = (np.array(picture, dtype=int) for picture in (pictures[0], pictures[-1]))
    for half in (slice(0, 350), slice(350, 700)):
        assert (np.abs(last - first)[60:340, half].max(axis=-1) > 100).sum() > 200
