"""Whether an encoding from outside the package does what its class states."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from switchmt_snn.config import NetworkConfig
from switchmt_snn.errors import ConfigError, shown
from switchmt_snn.spiking.apart import apart
from switchmt_snn.spiking.encodings import Encoding, encoding_code, make_encoding


def try_encoding(config: NetworkConfig, shape: tuple[int, ...], frame_stack: int, in_unit_range: bool) -> None:
    """Encode made-up observations, so that a mistake in a class from outside shows before training.

    Checked: the constructor, ``steps`` and ``channels``; shape and dtype of the inputs; that they are finite, and 0 or
    1 if the class makes spikes; that ``encode`` leaves its argument as it is; that the inputs follow from the
    observations and the generator alone, which exact resume needs; and that those of one observation do not depend on
    the others of its batch, because training encodes 32 at a time and an agent one.

    Args:
        config: names the encoding.
        shape: of one stacked observation.
        frame_stack: frames k in it.
        in_unit_range: whether scaled observations have values in [0, 1].

    Raises:
        ConfigError: naming the class, what was seen, and what was expected.
    """
    with apart():
        encoding = make_encoding(config, frame_stack, in_unit_range)
        tried = _Tried(encoding, config.encoding)
        observations = torch.rand((3, *shape))
        if not in_unit_range:
            observations = 8.0 * observations - 4.0
        observations[0].round_()  # whole numbers, too: pixels are 0 and 1 in many tasks
        tried.check(observations[:2].clone(), observations[2])


class _Tried:
    """An encoding, and the name that a config has for it."""

    def __init__(self, encoding: Encoding, name: str) -> None:
        self._encoding, self._name = encoding, name

    def check(self, observations: Tensor, other: Tensor) -> None:
        """Encode observations ``[2, k*c, ...]``, the same again, and each of them beside another ``[k*c, ...]``."""
        self._require_channels(observations.shape[1])
        inputs = self._encoded(observations)
        if not bool(inputs.isfinite().all()):
            worst = inputs[~inputs.isfinite()][0].item()
            low, high = observations.min(), observations.max()
            self._refuse(f"gives {worst:g} for observations from {low:g} to {high:g}", "finite numbers")
        if self._encoding.makes_spikes and not bool(((inputs == 0) | (inputs == 1)).all()):
            self._refuse(
                f"gives values from {inputs.min():g} to {inputs.max():g}",
                "0 and 1 only, as its makes_spikes = True says",
            )
        self._encoded(observations[:1].flip(-1))
        if not torch.equal(inputs, self._encoded(observations)):
            self._refuse(
                "gives other inputs when it encodes the same observations again",
                "an encoding that keeps no state between calls and draws from nothing but its generator",
            )
        if self._encoding.is_random:
            if not torch.equal(inputs, self._encoded(observations, global_seed=1)):
                self._refuse(
                    "draws random numbers that are not its generator's",
                    "torch.rand(..., generator=generator); else a resumed run is not exact",
                )
        elif not torch.equal(inputs, self._encoded(observations, seed=1, global_seed=1)):
            self._refuse("draws random numbers", "is_random = True, and all of them from its generator")
        for row in range(2):
            mixed = observations.clone()
            mixed[1 - row] = other
            if not torch.equal(self._encoded(mixed)[:, row], inputs[:, row]):
                self._refuse(
                    "gives an observation other inputs when another one is beside it in the batch",
                    "inputs that follow from each observation alone; x.mean(), for example, is over the batch, too; "
                    "x.flatten(1).mean(1) is not",
                )

    def _require_channels(self, observation_channels: int) -> None:
        expected = "channels(observation_channels, frame_stack) -> int"
        stack = self._encoding.frame_stack
        with encoding_code(self._name, "channels", expected):
            channels: Any = self._encoding.channels(observation_channels, stack)
        if not (isinstance(channels, int) and channels > 0):
            self._refuse(
                f"gives {shown(channels)} from channels({observation_channels}, {stack})", "a number of channels"
            )

    def _encoded(self, observations: Tensor, seed: int = 0, global_seed: int = 0) -> Tensor:
        """Inputs for observations that no call may change."""
        before = observations.clone()
        version = observations._version
        expected = f"inputs for observations of shape {tuple(observations.shape)}"
        with apart(global_seed), encoding_code(self._name, "encode", expected):
            inputs = self._encoding(observations, torch.Generator().manual_seed(seed))
        if observations._version != version or not torch.equal(observations, before):
            self._refuse("changes its argument x in place in encode", "a new tensor, x = x * 2 in place of x *= 2")
        return inputs.clone()

    def _refuse(self, seen: str, expected: str) -> None:
        raise ConfigError(
            f"network.encoding is {self._name!r}, which {seen}, expected {expected}; see docs/extending.md, Encoding"
        )
