"""Networks for the chips' tests: layers by hand, the paper's network, and shapes of real networks."""

from __future__ import annotations

import itertools
import math
from pathlib import Path
from typing import Any

from switchmt_snn.export.chips.fit import check_fit, layer_shapes
from switchmt_snn.export.chips.shapes import LayerShape
from switchmt_snn.export.folded import fold_agent
from tests.export.export_cases import make_agent

GOLDEN = Path(__file__).parents[1] / "golden" / "chip_fits.json"
BUILT_IN = ("speck", "loihi-1", "loihi-2", "spinnaker2", "xylo-audio-2", "xylo-audio-3")


def conv(name: str, shape: tuple[int, int, int], units: int, kernel: int, stride: int = 1) -> LayerShape:
    """A convolution without padding."""
    sides = [(side - kernel) // stride + 1 for side in shape[1:]]
    return LayerShape(name, shape, (units, *sides), kernel, stride, units * shape[0] * kernel**2, True, "IF")


def linear(name: str, inputs: int | tuple[int, ...], units: int) -> LayerShape:
    """A dense layer on features or on an image."""
    image = inputs if isinstance(inputs, tuple) else None
    count = math.prod(inputs) if isinstance(inputs, tuple) else inputs
    return LayerShape(name, (count,), (units,), None, 1, units * count, True, "IF", image)


def chain(inputs: int | tuple[int, ...], *units: int) -> list[LayerShape]:
    """Dense layers one after another."""
    return [linear(f"linear{i}", n, m) for i, (n, m) in enumerate(itertools.pairwise((inputs, *units)))]


CONVOLUTIONS = [
    conv("conv1", (4, 84, 84), 32, 8, 4),
    conv("conv2", (32, 20, 20), 64, 4, 2),
    conv("conv3", (64, 9, 9), 64, 3),
]
ATARI = [
    *CONVOLUTIONS,
    linear("hidden/value", (64, 7, 7), 512),
    linear("hidden/advantage", (64, 7, 7), 512),
    linear("head", 1024, 18),
]


def golden_networks() -> dict[str, list[LayerShape]]:
    """Networks whose fits are stored in ``tests/golden/chip_fits.json``."""
    real = {
        "SwitchMT": {},
        "SwitchMT, 300 hidden units": {"hidden_units": 300},
        "mlp, 300 hidden units": {"trunk": "mlp", "hidden_units": 300},
        "DSQN": {"method": "DSQN"},
        "events, LIF": {"encoding": "events", "neuron": "LIF", "tasks": {"frame_stack": 4}},
    }
    return {
        "Atari": ATARI,
        "small": chain(16, 60, 40, 8),
        "too large for any core": chain(30_000, 9_000, 9_000),
        "odd strides and sides": [conv("conv1", (2, 60, 80), 8, 5, 3), linear("hidden", (8, 4, 7), 5)],
        **{name: list(layer_shapes(fold_agent(make_agent(**settings)))) for name, settings in real.items()},  # type: ignore[arg-type]
    }


def golden_fits() -> dict[str, dict[str, Any]]:
    """Every network on every built-in chip; a limit is ``[resource, needs, has, unit, fits]``."""

    def plain(value: Any) -> Any:
        if isinstance(value, dict):
            limit = {"resource", "needs", "has", "unit", "fits"}
            return list(value.values()) if set(value) == limit else {key: plain(item) for key, item in value.items()}
        return [plain(item) for item in value] if isinstance(value, (list, tuple)) else value

    return {
        f"{name} on {chip}": plain(check_fit(layers, chip).to_dict())
        for name, layers in golden_networks().items()
        for chip in BUILT_IN
    }
