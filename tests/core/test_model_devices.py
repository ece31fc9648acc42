"""Devices of unpickled models, on machines with fewer GPUs than the one that wrote them."""

import pytest
import torch

from hybridkin._core import model


@pytest.mark.parametrize(
    ("written", "count", "restored"),
    [
        ("cpu", 2, "cpu"),
        ("cuda:0", 0, "cpu"),
        ("cuda:7", 0, "cpu"),
        ("cuda:7", 1, "cuda:0"),
        ("cuda:1", 2, "cuda:1"),
        ("cuda", 1, "cuda"),
        ("mps:0", 1, "cpu"),
    ],
)
def test_tensors_are_restored_on_a_device_that_exists(monkeypatch, written, count, restored):
    monkeypatch.setattr(torch.cuda, "device_count", lambda: count)
    used = []

    def tensor(array, device):
        used.append(str(device))
        return array

    closed = model._closed(torch.arange(3.0))._replace(device=written)
    monkeypatch.setattr(torch, "tensor", tensor)
    assert model._opened({"q": closed})["q"].tolist() == [0.0, 1.0, 2.0]
    assert used == [restored]
