"""Energy from counts and sourced constants: several profiles of the same chip, never one number.

A target is a YAML file in ``export/targets/`` or of one's own. What a target has no price for is not guessed: its count
is reported as not included.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from importlib import resources
from pathlib import Path
from typing import Any

import yaml

from switchmt_snn.errors import ConfigError, did_you_mean
from switchmt_snn.export.counts.network import LayerProfile, TaskProfile
from switchmt_snn.export.energy.traffic import Traffic, ann_traffic, traffic

UNITS_PJ = {"fJ": 1e-3, "pJ": 1.0, "nJ": 1e3}
EVIDENCE = ("measured", "simulated", "estimated", "reported")
"""``reported``: a number in a survey, without how it was found."""
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
class LayerEnergy:
    """Energy of one layer per decision; ``memory_pj`` by what is accessed, empty without a memory model."""

    layer: str
    compute_pj: float
    memory_pj: dict[str, float]

    @property
    def total_pj(self) -> float:
        """Compute and memory."""
        return self.compute_pj + sum(self.memory_pj.values())


@dataclass(frozen=True)
class Energy:
    """Energy of one decision in one task on one target, mean over the recorded decisions.

    Attributes:
        layers: in forward order: operations, neuron updates and spikes that have a price, and memory traffic where the
            target has a memory model.
        not_included: what was counted and has no price, in words.
        ann_pj: compute and memory of the ANN twin; None where the target cannot multiply.
        quantised_ann_pj: of the quantised twin: where the ANN's inputs are activations, one addition per activation bit
            and weight, if that is cheaper than a multiplication, and activations of that many bits in memory.
    """

    target: str
    task: str
    layers: tuple[LayerEnergy, ...]
    not_included: tuple[str, ...]
    has_memory: bool
    ann_pj: float | None
    quantised_ann_pj: float | None

    @property
    def compute_pj(self) -> float:
        """Operations, neuron updates and spikes."""
        return sum(layer.compute_pj for layer in self.layers)

    @property
    def memory_pj(self) -> float | None:
        """Weight, state and activation traffic; None where the target has no memory model."""
        return sum(sum(layer.memory_pj.values()) for layer in self.layers) if self.has_memory else None

    @property
    def total_pj(self) -> float:
        """Compute and, where known, memory."""
        return self.compute_pj + (self.memory_pj or 0.0)

    @property
    def by_ann(self) -> float | None:
        """This energy by the ANN twin's; None where the target cannot price all of both."""
        return self._by(self.ann_pj)

    @property
    def by_quantised_ann(self) -> float | None:
        """This energy by the quantised twin's; None where the target cannot price all of both."""
        return self._by(self.quantised_ann_pj)

    def _by(self, twin_pj: float | None) -> float | None:
        return self.total_pj / twin_pj if twin_pj and not self.not_included else None

    def to_dict(self) -> dict[str, Any]:
        """Plain values."""
        return {
            "target": self.target,
            "task": self.task,
            "compute_pj": self.compute_pj,
            "memory_pj": self.memory_pj,
            "total_pj": self.total_pj,
            "not_included": list(self.not_included),
            "ann_pj": self.ann_pj,
            "quantised_ann_pj": self.quantised_ann_pj,
            "by_ann": self.by_ann,
            "by_quantised_ann": self.by_quantised_ann,
            "layers": [asdict(layer) | {"total_pj": layer.total_pj} for layer in self.layers],
        }


def estimate(task: TaskProfile, target: Target) -> Energy:
    """Energy of a task's mean decision."""
    unpriced: list[str] = []
    layers = tuple(_layer_energy(layer, task.spiking, target, unpriced) for layer in task.layers)
    return Energy(
        target=target.name,
        task=task.task,
        layers=layers,
        not_included=tuple(unpriced),
        has_memory=target.memory is not None,
        ann_pj=_ann_pj(task, target),
        quantised_ann_pj=_ann_pj(task, target, quantised=True),
    )


def _ann_pj(task: TaskProfile, target: Target, quantised: bool = False) -> float | None:
    """Energy of the ANN of the same shape, or of its twin with activations of few bits."""
    mac = target.operations_pj.get("mac")
    if mac is None:
        return None
    total = 0.0
    for layer in task.layers:
        # Where numbers come in (the first layer), the quantised twin sees the same numbers.
        few_bits = quantised and layer.operation == "AC"
        bits = task.activation_bits
        price = min(mac, bits * target.operations_pj["ac"]) if few_bits else mac
        total += layer.macs_of_ann_twin * price
        if target.memory is not None:
            parts = _memory_pj(ann_traffic(layer), layer, target.memory)
            if few_bits:
                parts["activations"] *= min(1.0, bits / target.memory.state_bits)
            total += sum(parts.values())
    return total


def _layer_energy(layer: LayerProfile, spiking: bool, target: Target, unpriced: list[str]) -> LayerEnergy:
    prices = target.operations_pj
    if layer.operation == "MAC":
        charges = [(layer.effective_per_decision, prices.get("mac"), "multiplications")]
    else:
        price = prices.get("ac_conv", prices["ac"]) if layer.convolution else prices["ac"]
        charges = [(layer.effective_per_decision, price, "accumulations")]
    if spiking:
        charges.append((layer.neuron_updates_per_decision, prices.get("neuron_update"), "neuron updates"))
        # A spike has a price of its own on some chips; on the others it is part of what it causes.
        charges.append((layer.spikes_per_decision, prices.get("spike", 0.0), "spikes"))
    unpriced += [f"{count:,.0f} {what} of {layer.name}" for count, price, what in charges if count and price is None]
    compute = sum(count * price for count, price, _ in charges if price is not None)
    memory = {} if target.memory is None else _memory_pj(traffic(layer, spiking), layer, target.memory)
    return LayerEnergy(layer.name, compute, memory)


def _memory_pj(accesses: Traffic, layer: LayerProfile, memory: Memory) -> dict[str, float]:
    """Energy of memory accesses: each from the smallest memory that holds what lies there."""
    smallest = memory.access_pj(1, memory.state_bits)
    return {
        "events": accesses.events * smallest,
        "activations": accesses.activations * memory.access_pj(max(layer.inputs, layer.outputs), memory.state_bits),
        "weights": accesses.weights * memory.access_pj(layer.weights, memory.weight_bits),
        "biases": accesses.biases * memory.access_pj(layer.outputs, memory.weight_bits),
        "state": accesses.state * memory.access_pj(layer.outputs, memory.state_bits),
    }


def builtin_targets() -> dict[str, Target]:
    """The targets that come with the package, by name."""
    files = sorted(
        (
            path
            for path in resources.files("switchmt_snn.export.energy.targets").iterdir()
            if path.name.endswith(".yaml")
        ),
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
            text = path.read_text(encoding="utf-8")
        except (OSError, UnicodeDecodeError) as error:
            reason = error.strerror if isinstance(error, OSError) else "it is not UTF-8 text"
            raise ConfigError(f"target {name_or_file} cannot be read ({reason}), expected a YAML file") from error
        return read_target(text, name_or_file)
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
    if not isinstance(raw["evidence"], str) or raw["evidence"] not in EVIDENCE:
        raise ConfigError(f"{where}: evidence is {raw['evidence']!r}, expected one of {', '.join(EVIDENCE)}")
    if not isinstance(raw["unit"], str) or raw["unit"] not in UNITS_PJ:
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
        bits = {k: _whole(where, f"memory.{k}", raw["memory"][k]) for k in _MEMORY if k.endswith("_bits")}
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
    number = isinstance(value, (int, float)) and not isinstance(value, bool)
    if not number or not 0 <= value < 1e18:  # NaN is not
        hint = "; YAML reads 2e-3 as text: write 2.0e-3" if isinstance(value, str) else ""
        raise ConfigError(f"{where}: {key} is {value!r:.60}, expected a number of at least 0{hint}")
    return float(value)


def _whole(where: str, key: str, value: Any) -> int:
    if isinstance(value, bool) or not isinstance(value, int) or not 1 <= value <= 1024:
        raise ConfigError(f"{where}: {key} is {value!r:.60}, expected a whole number of bits, 1 to 1024")
    return value
