import os
from pathlib import Path

import pytest
import torch

torch.set_num_threads(1)


@pytest.fixture
def rng():
    return torch.Generator().manual_seed(0)


@pytest.fixture
def data_home():
    home = os.environ.get("HYBRIDKIN_DATA", "")
    if not home or not Path(home).is_dir():
        pytest.skip("needs the recordings of real robots: set HYBRIDKIN_DATA to their folder")
    return Path(home)
