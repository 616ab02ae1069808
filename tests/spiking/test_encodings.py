"""Encodings: cases by hand, facts of every registered class, and classes from outside the package."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from switchmt_snn.config import NetworkConfig
from switchmt_snn.config.network import ENCODING_NAMES
from switchmt_snn.errors import ConfigError
from switchmt_snn.spiking.encoding_check import try_encoding
from switchmt_snn.spiking.encodings import ENCODINGS, Encoding, make_encoding, register_encoding


def encoder(encoding: str, timesteps: int, stack: int = 1) -> Encoding:
    return make_encoding(NetworkConfig(encoding=encoding, timesteps=timesteps), stack, in_unit_range=True)


def test_direct_is_the_observation_once() -> None:
    x = torch.rand(2, 3, 4, 4)
    assert torch.equal(encoder("direct", 5)(x), x[None])


def test_latency_fires_once_earlier_for_brighter() -> None:
    x = torch.tensor([[1.0, 0.5, 0.1, 0.0]])
    spikes = encoder("latency", 3)(x)[:, 0]
    # (1 - x) * 2 = 0, 1, 1.8 -> steps 0, 1, 2; a black pixel never fires
    assert spikes.tolist() == [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]]


def test_rate_is_seeded_and_has_the_right_mean() -> None:
    x = torch.tensor([[0.0, 0.25, 1.0]]).repeat(4000, 1)
    one = encoder("rate", 4)(x, torch.Generator().manual_seed(3))
    two = encoder("rate", 4)(x, torch.Generator().manual_seed(3))
    assert torch.equal(one, two)
    means = one.mean(dim=(0, 1))
    assert means[0] == 0
    assert means[2] == 1
    assert abs(float(means[1]) - 0.25) < 0.015  # 16,000 draws: 4 standard errors are 0.0137


def test_frames_gives_one_frame_per_step() -> None:
    x = torch.arange(2 * 4 * 2).view(2, 4, 2).float()
    out = encoder("frames", 4, stack=4)(x)
    assert out.shape == (4, 2, 1, 2)
    assert torch.equal(out[2, :, 0], x[:, 2])


def test_events_are_on_and_off_changes() -> None:
    frames = torch.tensor([0.5, 0.5, 0.9, 0.1]).view(1, 4, 1, 1)
    out = encoder("events", 4, stack=4)(frames)
    assert out.shape == (4, 1, 2, 1, 1)
    assert out[:, 0, 0, 0, 0].tolist() == [1, 0, 1, 0]  # brighter: first frame against darkness, then 0.5 -> 0.9
    assert out[:, 0, 1, 0, 0].tolist() == [0, 0, 0, 1]  # darker: 0.9 -> 0.1


@pytest.mark.parametrize("step", [1, 5, 51, 100])
def test_whether_a_change_of_bytes_is_an_event_does_not_depend_on_brightness(step: int) -> None:
    """A threshold of k / 255, which no float holds: changes by k are none, by k + 1 are some, at every brightness."""
    dark = torch.arange(255 - step, dtype=torch.float32)  # 0 ... 254 - k
    for change, expected in ((step, 0.0), (step + 1, 1.0)):
        frames = torch.stack([dark, dark + change, dark], dim=1).view(-1, 3, 1, 1) * (1.0 / 255.0)
        events = make_encoding(
            NetworkConfig(encoding="events", timesteps=3, event_threshold=step / 255), 3, in_unit_range=True
        )
        on, off = events(frames)[1, :, 0], events(frames)[2, :, 1]
        assert (on == expected).all()
        assert (off == expected).all()


def test_vectors_cannot_be_rate_encoded() -> None:
    with pytest.raises(ConfigError, match=r"expected one of direct, frames, events .*; rate needs values in \[0, 1\]"):
        make_encoding(NetworkConfig(encoding="rate"), 1, in_unit_range=False)


def test_the_config_names_every_encoding_and_no_other() -> None:
    assert set(ENCODINGS) == set(ENCODING_NAMES)


@pytest.mark.slow
@settings(max_examples=60, deadline=None)
@given(
    name=st.sampled_from(sorted(ENCODINGS)),
    stack=st.integers(1, 4),
    steps=st.integers(1, 6),
    channels=st.integers(1, 3),
    seed=st.integers(0, 1000),
)
def test_every_encoding_has_its_facts(name: str, stack: int, steps: int, channels: int, seed: int) -> None:
    cls = ENCODINGS[name]
    timesteps = cls.steps(stack) or steps
    encoding = make_encoding(NetworkConfig(encoding=name, timesteps=timesteps), stack, in_unit_range=True)
    x = torch.rand(2, stack * channels, 3, generator=torch.Generator().manual_seed(seed))
    one, again, other = (encoding(x, torch.Generator().manual_seed(n)) for n in (1, 1, 2))
    assert one.shape == (1 if cls.constant_over_time else timesteps, 2, cls.channels(stack * channels, stack), 3)
    assert torch.equal(one, again)
    if not cls.is_random:
        assert torch.equal(one, other)
    if cls.makes_spikes:
        assert ((one == 0) | (one == 1)).all()
    each = torch.cat([encoding(x[b : b + 1]) for b in range(2)], dim=1)
    assert cls.is_random or torch.equal(each, one), "an observation's input depends on the batch"


def test_the_random_encoding_draws() -> None:
    drawn = [encoder("rate", 4)(torch.full((1, 64), 0.5), torch.Generator().manual_seed(n)) for n in (1, 2)]
    assert not torch.equal(*drawn)


@pytest.mark.parametrize("name", ["frames", "events"])
def test_an_encoding_by_frames_needs_one_step_per_frame(name: str) -> None:
    complaint = f"network.timesteps is 3, expected 4 for encoding {name} with tasks.frame_stack 4"
    with pytest.raises(ConfigError, match=complaint):
        encoder(name, 3, stack=4)


class Inverted(Encoding):
    """1 - x at every step."""

    makes_spikes = False
    constant_over_time = True

    def encode(self, x: Tensor, generator: torch.Generator | None) -> Tensor:
        return (1 - x).unsqueeze(0)


class NoFact(Encoding):
    def encode(self, x: Tensor, generator: torch.Generator | None) -> Tensor:
        return x.unsqueeze(0)


class NoRule(Encoding):
    makes_spikes = True


class OtherShape(Inverted):
    constant_over_time = False


class OtherType(Inverted):
    def encode(self, x: Tensor, generator: torch.Generator | None) -> Tensor:
        return (x > 0).unsqueeze(0)


class NoEncoding:
    makes_spikes = True


def test_an_encoding_from_outside_encodes() -> None:
    x = torch.rand(2, 3)
    assert torch.equal(encoder(f"{__name__}:Inverted", 5)(x), 1 - x[None])


@pytest.mark.parametrize(
    ("cls", "complaint"),
    [
        (NoEncoding, "is no encoding, expected a subclass of"),
        (NoRule, "defines no encode, expected"),
        (NoFact, "whose makes_spikes is None, expected True or False"),
    ],
)
def test_a_class_that_is_no_whole_encoding_is_refused_in_one_line(cls: type, complaint: str) -> None:
    with pytest.raises(ConfigError, match=complaint) as caught:
        encoder(f"{__name__}:{cls.__name__}", 2)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("cls", [OtherShape, OtherType])
def test_inputs_of_another_shape_or_type_than_stated_are_refused(cls: type) -> None:
    with pytest.raises(ConfigError, match=rf"encoding {cls.__name__} gave torch\.\w+ of shape \(1, 2, 3\), expected"):
        encoder(f"{__name__}:{cls.__name__}", 2)(torch.rand(2, 3))


def test_a_registered_name_is_one_that_the_config_takes_and_that_is_free() -> None:
    with pytest.raises(ConfigError, match="'inverted' is not a value"):
        register_encoding("inverted")(Inverted)
    with pytest.raises(ConfigError, match="'rate' is Rate, expected a name that is free"):
        register_encoding("rate")(Inverted)


class GivesNothing(Inverted):
    def encode(self, x: Tensor, generator: torch.Generator | None) -> Tensor:
        return None  # type: ignore[return-value]


class FailsToEncode(Inverted):
    def encode(self, x: Tensor, generator: torch.Generator | None) -> Tensor:
        return x * self.gain  # type: ignore[attr-defined]


class HalfSpikes(Inverted):
    makes_spikes = True

    def encode(self, x: Tensor, generator: torch.Generator | None) -> Tensor:
        return 0.5 * super().encode(x, generator)


class ChangesItsArgument(Inverted):
    def encode(self, x: Tensor, generator: torch.Generator | None) -> Tensor:
        return x.mul_(2).unsqueeze(0)


class Counts(Inverted):
    calls = 0

    def encode(self, x: Tensor, generator: torch.Generator | None) -> Tensor:
        self.calls += 1
        return x.unsqueeze(0) + self.calls


class RemembersTheLast(Inverted):
    """Differs only if other observations came in between."""

    last = 0.0

    def encode(self, x: Tensor, generator: torch.Generator | None) -> Tensor:
        before, self.last = self.last or x.mean(), x.mean()
        return x.unsqueeze(0) - before


class DrawsWithoutSayingSo(Inverted):
    def encode(self, x: Tensor, generator: torch.Generator | None) -> Tensor:
        return torch.rand(x.shape, generator=generator).unsqueeze(0)


class DrawsFromTorch(Inverted):
    def encode(self, x: Tensor, generator: torch.Generator | None) -> Tensor:
        return torch.rand(x.shape).unsqueeze(0)


class RandomFromTorch(DrawsFromTorch):
    is_random = True


class RandomFromItsGenerator(DrawsWithoutSayingSo):
    is_random = True


class Logarithm(Inverted):
    def encode(self, x: Tensor, generator: torch.Generator | None) -> Tensor:
        return x.log().unsqueeze(0)


class SubtractsTheMeanOfTheBatch(Inverted):
    def encode(self, x: Tensor, generator: torch.Generator | None) -> Tensor:
        return (x - x.mean()).unsqueeze(0)


class EncodesTheFirstOnly(Inverted):
    def encode(self, x: Tensor, generator: torch.Generator | None) -> Tensor:
        return x[:1].expand_as(x).unsqueeze(0)


class EncodesTheBatchInReverse(Inverted):
    is_random = True

    def encode(self, x: Tensor, generator: torch.Generator | None) -> Tensor:
        return x.flip(0).unsqueeze(0) * torch.rand(x.shape, generator=generator)


class SubtractsTheMeanOfEach(Inverted):
    def encode(self, x: Tensor, generator: torch.Generator | None) -> Tensor:
        return (x - x.flatten(1).mean(1).view(-1, 1, 1, 1)).unsqueeze(0)


class GivesNumpy(Inverted):
    def encode(self, x: Tensor, generator: torch.Generator | None) -> Tensor:
        return x.unsqueeze(0).numpy()  # type: ignore[return-value]


class StepsOfAnInstance(Inverted):
    def steps(self, frame_stack: int) -> int | None:  # type: ignore[override]
        return frame_stack


class ChannelsOfAnInstance(Inverted):
    def channels(self, observation_channels: int, frame_stack: int) -> int:  # type: ignore[override]
        return observation_channels


class StepsAsText(Inverted):
    @classmethod
    def steps(cls, frame_stack: int) -> int | None:
        return "3"  # type: ignore[return-value]


class FailsInChannels(Inverted):
    @classmethod
    def channels(cls, observation_channels: int) -> int:  # type: ignore[override]
        return observation_channels


class OwnConstructor(Inverted):
    def __init__(self, gain: float) -> None:
        self.gain = gain


class ForgetsItsParent(Inverted):
    def __init__(self, config: NetworkConfig, frame_stack: int) -> None:
        self.gain = 1.0


@pytest.mark.parametrize(
    ("encoding", "complaint"),
    [
        (Inverted, None),
        (GivesNothing, "gave None from encode, expected a tensor of shape"),
        (FailsToEncode, r"fails in encode \(AttributeError: .*'gain' at test_encodings.py, line"),
        (HalfSpikes, "expected 0 and 1 only, as its makes_spikes = True says"),
        (ChangesItsArgument, "changes its argument x in place in encode, expected a new tensor"),
        (Counts, "gives other inputs when it encodes the same .* again, expected .* no state"),
        (
            RemembersTheLast,
            "gives other inputs when it encodes the same .* again, expected .* no state",
        ),
        (DrawsWithoutSayingSo, "draws random numbers, expected is_random = True"),
        (DrawsFromTorch, "draws random numbers, expected is_random = True"),
        (RandomFromTorch, r"draws random numbers that are not its generator's, expected .*generator=generator"),
        (RandomFromItsGenerator, None),
        (Logarithm, "gives -inf for observations from 0 to 1, expected finite numbers"),
        (
            SubtractsTheMeanOfTheBatch,
            "gives an observation other inputs when another one is beside it in the batch, exp",
        ),
        (EncodesTheFirstOnly, "gives an observation other inputs when another one is beside it in the batch, exp"),
        (EncodesTheBatchInReverse, "gives an observation other inputs when another one is beside it in the batch, exp"),
        (SubtractsTheMeanOfEach, None),
        (GivesNumpy, r"gave a float32 ndarray of shape \(1, 2, 4, 5, 5\) from encode, expected a tensor of shape"),
        (StepsOfAnInstance, r"whose steps is no classmethod, expected @classmethod, def steps\(cls, frame_stack\)"),
        (ChannelsOfAnInstance, "whose channels is no classmethod, expected @classmethod, def channels"),
        (StepsAsText, "whose steps gave '3' for frame_stack 2, expected a number of simulation steps, or None"),
        (FailsInChannels, r"fails in channels \(TypeError: .*, expected channels\(observation_channels, frame_stack\)"),
        (OwnConstructor, r"fails in its constructor \(TypeError: .*, expected __init__\(self, config, frame_stack\)"),
        (ForgetsItsParent, r"does not call super\(\).__init__\(config, frame_stack\), expected it as the first line"),
    ],
)
def test_an_encoding_from_outside_is_tried_before_training(encoding: type, complaint: str | None) -> None:
    config = NetworkConfig(encoding=f"{__name__}:{encoding.__name__}", timesteps=3)  # type: ignore[arg-type]
    torch.manual_seed(5)
    before = torch.get_rng_state()
    if complaint is None:
        try_encoding(config, (4, 5, 5), 2, True)
    else:
        with pytest.raises(ConfigError, match=complaint) as caught:
            try_encoding(config, (4, 5, 5), 2, True)
        assert "\n" not in str(caught.value)
    assert torch.equal(before, torch.get_rng_state())
