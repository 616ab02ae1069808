"""Encodings: one observation -> the network's input at every simulation step.

Shapes: T simulation steps, B batch, F feature shape of the stacked observation (channels first), k frames per stack,
c channels per frame.
"""

from __future__ import annotations

import torch
from torch import Tensor

from switchmt_snn.config import NetworkConfig
from switchmt_snn.errors import ConfigError


class Encoder:
    """Turns scaled observations ``[B, k*c, ...]`` into inputs ``[T, B, C, ...]``.

    - ``direct``: the observation itself at every step (returned as ``[1, B, ...]``: the caller computes the first
      layer once and repeats its output).
    - ``rate``: a spike with the probability of the pixel value, drawn anew at each step (Bernoulli, seeded generator).
    - ``latency``: one spike per pixel, the brighter the earlier: at ``round((1 - x) * (T - 1))``; none where x = 0.
    - ``frames``: the t-th stacked frame at step t; T must equal the stack.
    - ``events``: ON and OFF spikes where a frame is brighter or darker than the one before it by more than
      ``event_threshold`` (the first frame is compared with darkness); T must equal the stack, channels double.
    """

    def __init__(self, config: NetworkConfig, frame_stack: int, inputs_in_unit_range: bool) -> None:
        """Check that the encoding can express the observation.

        Raises:
            ConfigError: rate or latency over observations that are not in [0, 1].
        """
        if config.encoding in ("rate", "latency") and not inputs_in_unit_range:
            raise ConfigError(
                f"network.encoding is {config.encoding!r}, expected direct, frames or events for vector observations; "
                "rate and latency need values in [0, 1]"
            )
        if config.encoding in ("frames", "events") and config.timesteps != frame_stack:
            raise ConfigError(
                f"network.timesteps is {config.timesteps!r}, expected tasks.frame_stack ({frame_stack}) for "
                f"encoding={config.encoding}, one stacked frame per step"
            )
        self.encoding = config.encoding
        self.timesteps = config.timesteps
        self.frame_stack = frame_stack
        self.event_threshold = config.event_threshold

    @property
    def is_random(self) -> bool:
        """Whether encoding draws random numbers."""
        return self.encoding == "rate"

    def input_channels(self, observation_channels: int) -> int:
        """Channels of the first layer for observations with this many stacked channels."""
        if self.encoding == "frames":
            return observation_channels // self.frame_stack
        if self.encoding == "events":
            return 2 * observation_channels // self.frame_stack
        return observation_channels

    def __call__(self, x: Tensor, generator: torch.Generator | None = None) -> Tensor:
        """Encode a scaled observation ``[B, k*c, ...]`` float; see the class for the shapes returned."""
        if self.encoding == "direct":
            return x.unsqueeze(0)
        if self.encoding == "rate":
            shape = (self.timesteps, *x.shape)
            return (torch.rand(shape, generator=generator, device=x.device) < x).to(x.dtype)
        if self.encoding == "latency":
            when = torch.round((1.0 - x) * (self.timesteps - 1))
            steps = torch.arange(self.timesteps, device=x.device).view(-1, *(1,) * x.dim())
            return ((when == steps) & (x > 0)).to(x.dtype)
        frames: Tensor = x.unflatten(1, (self.frame_stack, -1)).movedim(1, 0)  # [T, B, c, ...]
        if self.encoding == "frames":
            return frames
        before = torch.cat([torch.zeros_like(frames[:1]), frames[:-1]])
        change = frames - before
        on, off = change > self.event_threshold, change < -self.event_threshold
        return torch.cat([on, off], dim=2).to(x.dtype)
