"""Devices by name."""

from __future__ import annotations

import pytest
import torch

from switchmt_snn.errors import ConfigError
from switchmt_snn.machine.devices import select_device


@pytest.mark.parametrize("name", ["gpu", "", "cuda:7x"])
def test_an_unknown_device_is_refused_in_one_line(name: str) -> None:
    with pytest.raises(ConfigError, match="expected one that this machine has") as caught:
        select_device(name)
    assert repr(name) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_auto_takes_the_first_of_cuda_mps_and_cpu(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    for has_mps in (True, False):
        monkeypatch.setattr(torch.backends.mps, "is_available", lambda has_mps=has_mps: has_mps)
        assert select_device("auto") == torch.device("mps" if has_mps else "cpu")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    assert select_device("auto") == torch.device("cuda")
