"""Devices of unpickled models, on machines with fewer GPUs than the one that wrote them."""

import pickle

import pytest
import torch

from hybridkin._core import portable


@pytest.mark.parametrize("written", ["cpu", "cuda:7", "mps:0"])
def test_tensors_are_restored_on_a_device_that_exists(written):
    pickled = portable._Pickled(torch.arange(3.0))
    pickled.device = written
    assert torch.equal(pickle.loads(pickle.dumps(pickled)), torch.arange(3.0))
