"""What the C++ engine supports: a whitelist of settings, of module types, and of what the processor offers.

What is not named here is refused by its name, so that a new setting, neuron or layer never runs as an old one.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import MISSING, fields
from typing import Any

import torch
from torch import nn

from switchmt_snn.config import METHOD_TRAITS, NetworkConfig
from switchmt_snn.errors import ConfigError
from switchmt_snn.native import library as native_library
from switchmt_snn.spiking.dendrites import ActiveDendrites
from switchmt_snn.spiking.heads import TaskHeads
from switchmt_snn.spiking.network import Convolution, QNetwork, Stream, TrunkLayer
from switchmt_snn.spiking.neurons import LeakyLayer
from switchmt_snn.spiking.normalization import FixedBatchNorm, TaskBatchNorm

_ANY = object()
_SETTINGS: dict[str, object] = {
    "method": tuple(name for name, traits in METHOD_TRAITS.items() if traits.spiking),
    "trunk": ("nature", "nature_half", "minatar", "mlp"),
    "hidden_units": _ANY,
    "timesteps": _ANY,
    "encoding": _ANY,  # inputs are encoded by the network's own operations
    "event_threshold": _ANY,
    "readout": ("mean", "last_membrane", "max_membrane"),
    "readout_beta": _ANY,
    "quantiles": _ANY,
    "heads": ("shared", "per_task"),
    "neuron": ("IF", "LIF"),
    "beta": _ANY,
    "alpha": _ANY,  # IF and LIF do not use these three
    "adaptation_decay": _ANY,
    "adaptation_strength": _ANY,
    "learn_beta": (False,),
    "threshold": _ANY,
    "learn_threshold": (False,),
    "reset": ("zero", "subtract"),
    "surrogate": ("atan", "fast_sigmoid"),
    "surrogate_slope": _ANY,
    "dendrites": ("none", "shared", "per_neuron"),
    "dendritic_segments": _ANY,
    "dendritic_gating": ("max", "absolute_max"),
    "k_winners": (None,),
    "normalization": ("per_task", "shared"),
    "mlp_normalization": ("none", "batch"),
    "stream_normalization": ("none", "batch"),
    "stream_current_thresholds": _ANY,
    "normalization_momentum": _ANY,
    "neuron_engine": ("fused",),
}
"""Supported values of every network setting. A setting that is missing here must have its default value."""


def unsupported_setting(config: NetworkConfig) -> str | None:
    """The first setting that the C++ code does not support, as ``network.name=value``; None if there is none."""
    for field in fields(NetworkConfig):
        value = getattr(config, field.name)
        default = () if field.default is MISSING else (field.default,)
        supported: Any = _SETTINGS.get(field.name, default)
        if supported is not _ANY and value not in supported:
            why = " (no spikes)" if field.name == "method" else ""
            return f"network.{field.name}={value}{why}"
    return None


def unsupported_module(network: QNetwork) -> str | None:
    """The first module that the C++ code does not support, with its name; None if there is none."""
    for name, layer in network.trunk.items():
        if type(layer) is not TrunkLayer:
            return _named(f"trunk.{name}", layer)
        modules = {"synapses": layer.synapses, "normalization": layer.normalization, "neurons": layer.neurons}
        for part, module in modules.items():
            if not _TRUNK_PARTS[part](module):
                return _named(f"trunk.{name}.{part}", module)
        if _is_convolution(layer.synapses) and layer.normalization is None:
            return f"trunk.{name}: a convolution without BatchNorm"
    for name, stream in network.streams.items():
        if type(stream) is not Stream:
            return _named(f"streams.{name}", stream)
        modules = {part: getattr(stream, part) for part in _STREAM_PARTS}
        for part, module in modules.items():
            if not _STREAM_PARTS[part](module):
                return _named(f"streams.{name}.{part}", module)
    return None


def require(network: QNetwork) -> None:
    """Refuse a network that the C++ code does not support.

    Raises:
        ConfigError: it has an unsupported setting or module; the message names it.
    """
    require_setting(network.config)
    _refuse(unsupported_module(network))


def require_setting(config: NetworkConfig) -> None:
    """Refuse settings that the C++ code does not support.

    Raises:
        ConfigError: there is one; the message names it.
    """
    _refuse(unsupported_setting(config))


def _refuse(unsupported: str | None) -> None:
    if unsupported is not None:
        raise ConfigError(
            f"learning.engine is 'native', expected a network that it supports, but it has no code for {unsupported}; "
            "use learning.engine=eager"
        )


def problem() -> str | None:
    """One line on why the C++ sources cannot be compiled and loaded here; None if they can. Builds them if needed."""
    return native_library.problem()


def has_amx() -> bool:
    """Whether the processor multiplies bfloat16 matrices in a unit of its own, which PyTorch uses. By its peak it is
    faster than the C++ products; that was not measured.
    """
    return bool(getattr(torch.cpu, "_is_amx_tile_supported", lambda: False)())


def spikes_as_bits(dtype: torch.dtype) -> bool:
    """Whether spikes are kept as bits, for weights of a dtype; their products are then sums of the weights they choose.

    The processor needs AVX-512, and for bfloat16 no AMX.
    """
    return bool(native_library.library().snn_has_products()) and not (dtype == torch.bfloat16 and has_amx())


_Check = Callable[[nn.Module | None], bool]


def _is_convolution(module: nn.Module | None) -> bool:
    return (
        type(module) in (Convolution, nn.Conv2d)
        and isinstance(module, nn.Conv2d)
        and module.kernel_size[0] == module.kernel_size[1]
        and module.stride[0] == module.stride[1]
        and module.padding in ((0, 0), "valid")
        and module.dilation == (1, 1)
        and module.groups == 1
        and module.bias is not None
    )


def _is_linear(module: nn.Module | None) -> bool:
    if type(module) is nn.Sequential and len(module) == 2 and type(module[0]) is nn.Flatten:
        return module[0].start_dim == 1 and module[0].end_dim == -1 and _is_linear(module[1])
    return type(module) is nn.Linear and module.bias is not None


def _is_neurons(module: nn.Module | None) -> bool:
    return type(module) is LeakyLayer and module.fused


_TRUNK_PARTS: dict[str, _Check] = {
    "synapses": lambda module: _is_convolution(module) or _is_linear(module),
    "normalization": lambda module: module is None or type(module) is TaskBatchNorm,
    "neurons": _is_neurons,
}
_STREAM_PARTS: dict[str, _Check] = {
    "synapses": lambda module: type(module) is nn.Linear and module.bias is not None,
    "normalization": lambda module: module is None or type(module) is FixedBatchNorm,
    "dendrites": lambda module: module is None or type(module) is ActiveDendrites,
    "neurons": _is_neurons,
    "head": lambda module: type(module) is TaskHeads or (type(module) is nn.Linear and module.bias is not None),
}


def _named(name: str, module: nn.Module | None) -> str:
    return f"{name}: {' '.join(str(module).split())}"  # on one line
