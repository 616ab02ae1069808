"""Encodings: how one observation becomes the network's input at every simulation step.

One class per encoding. The class states the facts that other parts of the package must know: whether it draws random
numbers, whether it gives spikes, how many channels and simulation steps it needs.

Shapes: T simulation steps, B batch, k frames per stack, c channels per frame, C channels of the input.
"""

from __future__ import annotations

import inspect
from contextlib import AbstractContextManager
from typing import Any, ClassVar

import torch
from torch import Tensor

from switchmt_snn.config import NetworkConfig
from switchmt_snn.config.plugins import is_plugin, user_code
from switchmt_snn.config.registry import Registry
from switchmt_snn.errors import ConfigError, shown


class Encoding:
    """Turns scaled observations ``[B, k*c, ...]`` into inputs ``[T, B, C, ...]``.

    A subclass defines ``makes_spikes`` and ``encode``, and the other facts where they differ from the defaults.

    Attributes:
        makes_spikes: whether every input is 0 or 1. Then a first layer accumulates weights, else it multiplies.
        is_random: whether ``encode`` draws random numbers. Default: no.
        constant_over_time: whether the input is the same at every step. It is then ``[1, B, C, ...]``, and the first
            layer is computed once. Default: no.
        needs_unit_range: whether observations must have values in [0, 1]. Default: no.
        timesteps: T.
        frame_stack: k.
    """

    makes_spikes: ClassVar[bool]
    is_random: ClassVar[bool] = False
    constant_over_time: ClassVar[bool] = False
    needs_unit_range: ClassVar[bool] = False

    def __init__(self, config: NetworkConfig, frame_stack: int) -> None:
        """Take what it needs of the settings in section ``network``."""
        self.timesteps = config.timesteps
        self.frame_stack = frame_stack

    @classmethod
    def channels(cls, observation_channels: int, frame_stack: int) -> int:
        """Channels C of the input for observations with ``observation_channels`` (k*c) channels. Default: the same."""
        return observation_channels

    @classmethod
    def steps(cls, frame_stack: int) -> int | None:
        """The number of simulation steps T that it needs for k frames per stack; None, the default, if any will do."""
        return None

    def encode(self, x: Tensor, generator: torch.Generator | None) -> Tensor:
        """Inputs ``[T, B, C, ...]`` (constant over time: ``[1, B, C, ...]``) of the dtype of ``x``.

        Args:
            x: scaled observations ``[B, k*c, ...]`` float.
            generator: source of random numbers; None takes torch's own.
        """
        raise NotImplementedError(f"{type(self).__name__} defines no encode, expected its rule")

    def __call__(self, x: Tensor, generator: torch.Generator | None = None) -> Tensor:
        """As ``encode``.

        Raises:
            ConfigError: the result has another shape or dtype than the class states.
        """
        inputs = self.encode(x, generator)
        steps = 1 if self.constant_over_time else self.timesteps
        shape = (steps, x.shape[0], self.channels(x.shape[1], self.frame_stack), *x.shape[2:])
        if not isinstance(inputs, Tensor):
            raise ConfigError(
                f"encoding {type(self).__name__} gave {shown(inputs)} from encode, expected a tensor of shape {shape}"
            )
        if inputs.shape != shape or inputs.dtype != x.dtype:
            raise ConfigError(
                f"encoding {type(self).__name__} gave {inputs.dtype} of shape {tuple(inputs.shape)}, expected "
                f"{x.dtype} of shape {shape} (steps, batch, channels, ...); see its channels and constant_over_time"
            )
        return inputs


def check_encoding(encoding: Any, name: str) -> type[Encoding]:
    """Return the class if it is a whole encoding.

    Raises:
        ConfigError: it is no subclass of ``Encoding``, lacks ``Encoding.makes_spikes`` or ``Encoding.encode``, or its
            ``channels`` or ``steps`` is no classmethod.
    """
    seen = f"network.encoding is {name!r}"
    if not (isinstance(encoding, type) and issubclass(encoding, Encoding)):
        raise ConfigError(
            f"{seen}, which is no encoding, expected a subclass of switchmt_snn.spiking.encodings.Encoding"
        )
    if encoding.encode is Encoding.encode:
        raise ConfigError(f"{seen}, which defines no encode, expected encode(self, x, generator) -> Tensor")
    for fact in ("makes_spikes", "is_random", "constant_over_time", "needs_unit_range"):
        value = getattr(encoding, fact, None)
        if not isinstance(value, bool):
            raise ConfigError(f"{seen}, whose {fact} is {value!r}, expected True or False")
    for method, taken in (("channels", "cls, observation_channels, frame_stack"), ("steps", "cls, frame_stack")):
        if not isinstance(inspect.getattr_static(encoding, method), classmethod):
            raise ConfigError(f"{seen}, whose {method} is no classmethod, expected @classmethod, def {method}({taken})")
    return encoding


ENCODINGS: Registry[type[Encoding]] = Registry(NetworkConfig, "network.encoding", check_encoding)
"""The encodings of this package, by the name that ``network.encoding`` takes."""

register_encoding, encoding_class = ENCODINGS.register, ENCODINGS.find


def make_encoding(config: NetworkConfig, frame_stack: int, in_unit_range: bool) -> Encoding:
    """The encoding of a resolved config.

    Args:
        config: names it.
        frame_stack: frames k per observation.
        in_unit_range: whether scaled observations have values in [0, 1].

    Raises:
        ConfigError: an unknown encoding, one that cannot express the observations in T steps, or one from outside the
            package whose ``steps`` or constructor fails.
    """
    cls = encoding_class(config.encoding)
    if cls.needs_unit_range and not in_unit_range:
        others = ", ".join(name for name, other in ENCODINGS.items() if not other.needs_unit_range)
        raise ConfigError(
            f"network.encoding is {config.encoding!r}, expected one of {others} for vector observations; "
            f"{config.encoding} needs values in [0, 1]"
        )
    with encoding_code(config.encoding, "steps", "steps(frame_stack) -> int, or None for any number of steps"):
        steps: Any = cls.steps(frame_stack)
    if not (steps is None or (isinstance(steps, int) and steps > 0)):
        raise ConfigError(
            f"network.encoding is {config.encoding!r}, whose steps gave {shown(steps)} for frame_stack {frame_stack}, "
            "expected a number of simulation steps, or None if any will do"
        )
    if steps is not None and config.timesteps != steps:
        raise ConfigError(
            f"network.timesteps is {config.timesteps!r}, expected {steps} for encoding {config.encoding} with "
            f"tasks.frame_stack {frame_stack}"
        )
    form = "__init__(self, config, frame_stack) with super().__init__(config, frame_stack)"
    with encoding_code(config.encoding, "its constructor", form):
        encoding = cls(config, frame_stack)
    if not {"timesteps", "frame_stack"} <= vars(encoding).keys():
        raise ConfigError(
            f"network.encoding is {config.encoding!r}, which does not call super().__init__(config, frame_stack), "
            "expected it as the first line of __init__(self, config, frame_stack)"
        )
    return encoding


def encoding_code(name: str, where: str, expected: str) -> AbstractContextManager[None]:
    """Around a call of the encoding that ``network.encoding`` names; see ``user_code``."""
    return user_code(f"network.encoding is {name!r}, which fails in {where}", expected, outside=is_plugin(name))


@register_encoding("direct")
class Direct(Encoding):
    """The observation itself at every step; given once."""

    makes_spikes = False
    constant_over_time = True

    def encode(self, x: Tensor, generator: torch.Generator | None) -> Tensor:
        """``[1, B, k*c, ...]``."""
        return x.unsqueeze(0)


@register_encoding("rate")
class Rate(Encoding):
    """A spike with the probability of the pixel value, drawn anew at each step (Bernoulli)."""

    makes_spikes = True
    is_random = True
    needs_unit_range = True

    def encode(self, x: Tensor, generator: torch.Generator | None) -> Tensor:
        """Spikes ``[T, B, k*c, ...]``."""
        shape = (self.timesteps, *x.shape)
        return (torch.rand(shape, generator=generator, device=x.device) < x).to(x.dtype)


@register_encoding("latency")
class Latency(Encoding):
    """One spike per pixel, the brighter the earlier: at ``round((1 - x) * (T - 1))``; none where x = 0."""

    makes_spikes = True
    needs_unit_range = True

    def encode(self, x: Tensor, generator: torch.Generator | None) -> Tensor:
        """Spikes ``[T, B, k*c, ...]``."""
        when = torch.round((1.0 - x) * (self.timesteps - 1))
        steps = torch.arange(self.timesteps, device=x.device).view(-1, *(1,) * x.dim())
        return ((when == steps) & (x > 0)).to(x.dtype)


@register_encoding("frames")
class Frames(Encoding):
    """The t-th stacked frame at step t, so T = k."""

    makes_spikes = False

    @classmethod
    def channels(cls, observation_channels: int, frame_stack: int) -> int:
        """c, those of one frame."""
        return observation_channels // frame_stack

    @classmethod
    def steps(cls, frame_stack: int) -> int | None:
        """One step per frame."""
        return frame_stack

    def encode(self, x: Tensor, generator: torch.Generator | None) -> Tensor:
        """``[T, B, c, ...]``."""
        return frames_over_time(x, self.frame_stack)


EVENT_MARGIN = 2.0**-20
"""Added to ``event_threshold``: scaled float32 pixels round, so a change of k / 255 lies up to 1.2e-7 from it."""


@register_encoding("events")
class Events(Encoding):
    """ON and OFF spikes where a frame is brighter or darker than the one before it by more than ``event_threshold``.

    The first frame is compared with darkness. T = k; ON and OFF are channels of their own. A change that equals the
    threshold is no event, however bright the pixels are: see ``EVENT_MARGIN``.
    """

    makes_spikes = True

    def __init__(self, config: NetworkConfig, frame_stack: int) -> None:
        super().__init__(config, frame_stack)
        self.threshold = config.event_threshold + EVENT_MARGIN

    @classmethod
    def channels(cls, observation_channels: int, frame_stack: int) -> int:
        """2c: the ON channels of one frame, then its OFF channels."""
        return 2 * observation_channels // frame_stack

    @classmethod
    def steps(cls, frame_stack: int) -> int | None:
        """One step per frame."""
        return frame_stack

    def encode(self, x: Tensor, generator: torch.Generator | None) -> Tensor:
        """Spikes ``[T, B, 2c, ...]``."""
        frames = frames_over_time(x, self.frame_stack)
        before = torch.cat([torch.zeros_like(frames[:1]), frames[:-1]])
        change = frames - before
        on, off = change > self.threshold, change < -self.threshold
        return torch.cat([on, off], dim=2).to(x.dtype)


def frames_over_time(x: Tensor, frame_stack: int) -> Tensor:
    """The frames of stacked observations ``[B, k*c, ...]`` as ``[k, B, c, ...]``."""
    frames: Tensor = x.unflatten(1, (frame_stack, -1)).movedim(1, 0)
    return frames
