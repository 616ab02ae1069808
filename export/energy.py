"""Energy from counts and sourced constants: several profiles of the same chip, never one number.

A target is a YAML file in ``export/targets/`` or of one's own. What a target has no price for is not guessed: its count
is reported as not included.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

import yaml

from switchmt_snn.errors import ConfigError, did_you_mean
from switchmt_snn.export.profile import LayerProfile, TaskProfile

UNITS_PJ = {"fJ": 1e-3, "pJ": 1.0, "nJ": 1e3}
EVIDENCE = ("measured", "simulated", "estimated", "reported")
"""``reported``: a number in a survey, without how it was found."""
DECISIONS_PER_S = 15.0
"""An Atari agent decides at every fourth of 60 frames per second."""

_TEXTS = ("name", "title", "chip", "process", "source", "includes", "leaves_out")
_OPERATIONS = ("ac", "ac_conv", "mac", "neuron_update", "spike")
_MEMORY = ("access_bits", "energy_by_kilobytes", "weight_bits", "state_bits")


@dataclass(frozen=True)
class Memory:
    """SRAM: energy of one access by size, and how many bits a weight and a membrane take.

    Attributes:
        access_pj_by_kilobytes: ascending sizes.
    """

    access_bits: int
    access_pj_by_kilobytes: dict[float, float]
    weight_bits: int
    state_bits: int

    def access_pj(self, values: int, bits: int) -> float:
        """Energy per value of ``bits`` bits from the smallest memory that holds that many values (or the largest)."""
        kilobytes = values * bits / 8 / 1024
        sizes = list(self.access_pj_by_kilobytes.items())
        price = next((pj for size, pj in sizes if kilobytes <= size), sizes[-1][1])
        return price * bits / self.access_bits


@dataclass(frozen=True)
class Target:
    """Constants of one piece of hardware from one source; energies in pJ.

    Attributes:
        operations_pj: by operation: ``ac``, ``ac_conv`` (of convolutions, if they differ), ``mac``, ``neuron_update``,
            ``spike``.
        evidence: one of :data:`EVIDENCE`.
    """

    name: str
    title: str
    chip: str
    process: str
    source: str
    evidence: str
    includes: str
    leaves_out: str
    operations_pj: dict[str, float]
    memory: Memory | None


@dataclass(frozen=True)
class Energy:
    """Energy of one decision in one task on one target, mean over the recorded decisions.

    Attributes:
        compute_pj: operations, neuron updates and spikes that have a price.
        memory_pj: weight and membrane traffic; None where the target has no memory model.
        not_included: what was counted and has no price, in words.
        ann_compute_pj: of the ANN twin; None where the target cannot multiply.
        quantised_ann_compute_pj: of the quantised twin, bit-serial: one addition per activation bit and weight, if that
            is cheaper than the target's multiplication.
    """

    target: str
    task: str
    compute_pj: float
    memory_pj: float | None
    not_included: tuple[str, ...]
    ann_compute_pj: float | None
    ann_memory_pj: float | None
    quantised_ann_compute_pj: float | None

    @property
    def total_pj(self) -> float:
        """Compute and, where known, memory."""
        return self.compute_pj + (self.memory_pj or 0.0)

    @property
    def by_ann(self) -> float | None:
        """This energy by the ANN twin's; None where the target cannot multiply."""
        if self.ann_compute_pj is None:
            return None
        return self.total_pj / (self.ann_compute_pj + (self.ann_memory_pj or 0.0))

    @property
    def by_quantised_ann(self) -> float | None:
        """This energy by the quantised twin's, whose memory traffic is taken as the ANN twin's."""
        if self.quantised_ann_compute_pj is None:
            return None
        return self.total_pj / (self.quantised_ann_compute_pj + (self.ann_memory_pj or 0.0))

    def to_dict(self) -> dict[str, Any]:
        """Plain values, with the power at :data:`DECISIONS_PER_S`."""
        return {
            **{name: list(v) if isinstance(v, tuple) else v for name, v in vars(self).items()},
            "total_pj": self.total_pj,
            "by_ann": self.by_ann,
            "by_quantised_ann": self.by_quantised_ann,
            "power_uw": self.total_pj * 1e-12 * DECISIONS_PER_S * 1e6,
        }


def estimate(task: TaskProfile, target: Target) -> Energy:
    """Energy of a task's mean decision."""
    prices, unpriced, compute = target.operations_pj, [], 0.0

    def charge(count: float, price: float | None, what: str) -> None:
        nonlocal compute
        if count > 0 and price is None:
            unpriced.append(f"{count:,.0f} {what}")
        elif price is not None:
            compute += count * price

    for layer in task.layers:
        price = prices.get("mac") if layer.operation == "MAC" else _ac_price(prices, layer)
        kind = "multiplications" if layer.operation == "MAC" else "accumulations"
        charge(layer.effective_per_decision, price, f"{kind} of {layer.name}")
    if task.spiking:
        charge(
            sum(layer.neuron_updates_per_decision for layer in task.layers),
            prices.get("neuron_update"),
            "neuron updates",
        )
        # A spike has a price of its own on some chips; on the others it is part of what it causes.
        compute += task.spikes * prices.get("spike", 0.0)
    macs, mac = task.dense_macs_of_ann_twin, prices.get("mac")
    bits = math.ceil(math.log2(task.timesteps + 1))
    return Energy(
        target=target.name,
        task=task.task,
        compute_pj=compute,
        memory_pj=None if target.memory is None else _memory_pj(task, target.memory),
        not_included=tuple(unpriced),
        ann_compute_pj=None if mac is None else macs * mac,
        ann_memory_pj=None if target.memory is None else _ann_memory_pj(task, target.memory),
        quantised_ann_compute_pj=None if mac is None else macs * min(mac, bits * prices["ac"]),
    )


def _ac_price(prices: dict[str, float], layer: LayerProfile) -> float | None:
    return prices.get("ac_conv", prices.get("ac")) if layer.convolution else prices.get("ac")


def _memory_pj(task: TaskProfile, memory: Memory) -> float:
    """Every effective operation reads its weight; every neuron update reads and writes its membrane."""
    total = 0.0
    for layer in task.layers:
        total += layer.effective_per_decision * memory.access_pj(layer.weights, memory.weight_bits)
        if layer.neuron_updates_per_decision:
            state_pj = memory.access_pj(layer.neurons, memory.state_bits)
            total += 2 * layer.neuron_updates_per_decision * state_pj
    return total


def _ann_memory_pj(task: TaskProfile, memory: Memory) -> float:
    """Every multiplication reads its weight (no reuse, as for the spiking network); activations are written once."""
    total = 0.0
    for layer in task.layers:
        macs = layer.dense_per_decision // max(1, len(layer.effective_T))
        total += macs * memory.access_pj(layer.weights, memory.weight_bits)
        if layer.neurons:
            total += layer.neurons * memory.access_pj(layer.neurons, memory.state_bits)
    return total


def builtin_targets() -> dict[str, Target]:
    """The targets that come with the package, by name."""
    files = sorted(
        (path for path in resources.files("switchmt_snn.export.targets").iterdir() if path.name.endswith(".yaml")),
        key=lambda path: path.name,
    )
    targets = [read_target(path.read_text(encoding="utf-8"), path.name) for path in files]
    return {target.name: target for target in targets}


def load_target(name_or_file: str) -> Target:
    """A built-in target by name, or one from a YAML file.

    Raises:
        ConfigError: no such target, or a file that is not one.
    """
    path = Path(name_or_file)
    if path.suffix in (".yaml", ".yml"):
        try:
            return read_target(path.read_text(encoding="utf-8"), name_or_file)
        except OSError as error:
            raise ConfigError(
                f"target {name_or_file} cannot be read ({error.strerror}), expected a YAML file"
            ) from error
    known = builtin_targets()
    if name_or_file not in known:
        raise ConfigError(f"unknown target {name_or_file!r}{did_you_mean(name_or_file, known)}")
    return known[name_or_file]


def read_target(text: str, where: str) -> Target:
    """Read and check a target.

    Raises:
        ConfigError: a key is missing or unknown, a text is empty, a constant is negative, or a unit is not known.
    """
    try:
        raw = yaml.safe_load(text)
    except yaml.YAMLError as error:
        raise ConfigError(f"{where} is not YAML ({str(error).splitlines()[0]}), expected a target") from error
    _keys(where, "", raw, (*_TEXTS, "evidence", "unit", "operations"), ("memory",))
    for key in _TEXTS:
        if not isinstance(raw[key], str) or not raw[key].strip():
            raise ConfigError(f"{where}: {key} is {raw[key]!r}, expected a text; every constant needs its origin")
    if raw["evidence"] not in EVIDENCE:
        raise ConfigError(f"{where}: evidence is {raw['evidence']!r}, expected one of {', '.join(EVIDENCE)}")
    if raw["unit"] not in UNITS_PJ:
        raise ConfigError(f"{where}: unit is {raw['unit']!r}, expected one of {', '.join(UNITS_PJ)}")
    factor = UNITS_PJ[raw["unit"]]
    _keys(where, "operations.", raw["operations"], ("ac",), _OPERATIONS)
    operations = {k: _number(where, f"operations.{k}", v) * factor for k, v in raw["operations"].items()}
    memory = None
    if raw.get("memory") is not None:
        _keys(where, "memory.", raw["memory"], _MEMORY, ())
        levels = raw["memory"]["energy_by_kilobytes"]
        if not isinstance(levels, dict) or not levels:
            raise ConfigError(f"{where}: memory.energy_by_kilobytes is {levels!r}, expected sizes and energies")
        priced = {
            _number(where, "a size", size): _number(where, f"memory of {size} kB", pj) * factor
            for size, pj in levels.items()
        }
        bits = {k: int(_number(where, f"memory.{k}", raw["memory"][k])) for k in _MEMORY if k.endswith("_bits")}
        memory = Memory(bits["access_bits"], dict(sorted(priced.items())), bits["weight_bits"], bits["state_bits"])
    texts = {key: raw[key] for key in _TEXTS}
    return Target(**texts, evidence=raw["evidence"], operations_pj=operations, memory=memory)


def _keys(where: str, prefix: str, raw: Any, needed: tuple[str, ...], allowed: tuple[str, ...]) -> None:
    if not isinstance(raw, dict):
        raise ConfigError(f"{where}: {prefix.rstrip('.') or 'the file'} is {raw!r:.60}, expected keys and values")
    for key in needed:
        if key not in raw:
            raise ConfigError(f"{where} has no {prefix}{key}, expected one; see the files in export/targets")
    for key in raw:
        if key not in (*needed, *allowed):
            hint = did_you_mean(str(key), (*needed, *allowed))
            raise ConfigError(f"{where} has the unknown key {prefix}{key}{hint}")


def _number(where: str, key: str, value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value) or value < 0:
        raise ConfigError(f"{where}: {key} is {value!r}, expected a number of at least 0")
    return float(value)
