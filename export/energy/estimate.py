"""Energy from counts and constants with a source: several targets for the same chip, never one number.

A target is a YAML file in ``export/energy/targets/`` or of one's own. An operation without a price is not guessed: its
count is reported as not included.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from itertools import pairwise
from typing import Any

from switchmt_snn.errors import ConfigError
from switchmt_snn.export.counts.network import LayerCounts, TaskCounts
from switchmt_snn.export.energy.traffic import Traffic, ann_traffic, traffic
from switchmt_snn.export.yaml_files import Catalog, Section, check_number

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
        evidence: one of ``EVIDENCE``.
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
        ann_layers_pj: compute and memory of the ANN twin by layer; None where the target cannot multiply.
        quantised_ann_pj: of the quantised twin: where the ANN's inputs are activations, one addition per activation bit
            and weight, if that is cheaper than a multiplication, and activations of that many bits in memory. None also
            where the network is an ANN, whose activations have no number of bits.
    """

    target: str
    task: str
    layers: tuple[LayerEnergy, ...]
    not_included: tuple[str, ...]
    has_memory: bool
    ann_layers_pj: tuple[float, ...] | None
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
    def ann_pj(self) -> float | None:
        """Compute and memory of the ANN twin."""
        return None if self.ann_layers_pj is None else sum(self.ann_layers_pj)

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
            "ann_layers_pj": None if self.ann_layers_pj is None else list(self.ann_layers_pj),
            "quantised_ann_pj": self.quantised_ann_pj,
            "by_ann": self.by_ann,
            "by_quantised_ann": self.by_quantised_ann,
            "layers": [asdict(layer) | {"total_pj": layer.total_pj} for layer in self.layers],
        }


def estimate(task: TaskCounts, target: Target) -> Energy:
    """Energy of a task's mean decision."""
    unpriced: list[str] = []
    layers = tuple(_layer_energy(layer, task.spiking, target, unpriced) for layer in task.layers)
    quantised = _ann_layers_pj(task, target, quantised=True) if task.spiking else None
    return Energy(
        target=target.name,
        task=task.task,
        layers=layers,
        not_included=tuple(unpriced),
        has_memory=target.memory is not None,
        ann_layers_pj=_ann_layers_pj(task, target),
        quantised_ann_pj=None if quantised is None else sum(quantised),
    )


def _ann_layers_pj(task: TaskCounts, target: Target, quantised: bool = False) -> tuple[float, ...] | None:
    """Energy of each layer of the ANN of the same shape, or of its twin with activations of few bits."""
    mac = target.operations_pj.get("mac")
    if mac is None:
        return None
    layers = []
    for layer in task.layers:
        # Where numbers come in (the first layer), the quantised twin sees the same numbers.
        few_bits = quantised and layer.operation == "AC"
        bits = task.activation_bits
        price = min(mac, bits * target.operations_pj["ac"]) if few_bits else mac
        layer_pj = layer.macs_of_ann_twin * price
        if target.memory is not None:
            parts = _memory_pj(ann_traffic(layer), layer, target.memory)
            if few_bits:
                parts["activations"] *= min(1.0, bits / target.memory.state_bits)
            layer_pj += sum(parts.values())
        layers.append(layer_pj)
    return tuple(layers)


def _layer_energy(layer: LayerCounts, spiking: bool, target: Target, unpriced: list[str]) -> LayerEnergy:
    prices = target.operations_pj
    if layer.operation == "MAC":
        charges = [(layer.effective_per_decision, prices.get("mac"), "multiplications")]
    else:
        price = prices.get("ac_conv", prices["ac"]) if layer.convolution else prices["ac"]
        charges = [(layer.effective_per_decision, price, "accumulations")]
    if spiking:
        # Targets price the update of a neuron with a membrane and nothing else.
        update = prices.get("neuron_update") if layer.states == 1 else None
        charges.append((layer.neuron_updates_per_decision, update, "neuron updates"))
        # A spike has a price of its own on some chips; on the others it is part of what it causes.
        charges.append((layer.spikes_per_decision, prices.get("spike", 0.0), "spikes"))
    unpriced += [f"{count:,.0f} {what} of {layer.name}" for count, price, what in charges if count and price is None]
    compute = sum(count * price for count, price, _ in charges if price is not None)
    memory = {} if target.memory is None else _memory_pj(traffic(layer, spiking), layer, target.memory)
    return LayerEnergy(layer.name, compute, memory)


def _memory_pj(accesses: Traffic, layer: LayerCounts, memory: Memory) -> dict[str, float]:
    """Energy of memory accesses: each from the smallest memory that holds what lies there."""
    smallest = memory.access_pj(1, memory.state_bits)
    return {
        "events": accesses.events * smallest,
        "activations": accesses.activations * memory.access_pj(max(layer.inputs, layer.outputs), memory.state_bits),
        "weights": accesses.weights * memory.access_pj(layer.weights, memory.weight_bits),
        "biases": accesses.biases * memory.access_pj(layer.outputs, memory.weight_bits),
        "state": accesses.state * memory.access_pj(layer.outputs, memory.state_bits),
    }


def read_target(raw: Any, where: str) -> Target:
    """A target from the keys and values of its file.

    Raises:
        ConfigError: a key is missing or unknown, a text is empty, a constant is negative, accumulations are free, a
            larger memory is cheaper than a smaller one, or a unit is not known.
    """
    file = Section(where, raw, "", (*_TEXTS, "evidence", "unit", "operations"), ("kind", "memory"))
    if "kind" in file:
        file.choice("kind", ("energy",))
    texts = {key: file.text(key, "; every constant needs its origin") for key in _TEXTS}
    file.short_name("name")
    evidence = file.choice("evidence", EVIDENCE)
    factor = UNITS_PJ[file.choice("unit", tuple(UNITS_PJ))]
    prices = file.section("operations", ("ac",), _OPERATIONS)
    operations = {name: prices.number(name) * factor for name in prices.raw}
    if operations["ac"] == 0:
        raise prices.wrong("ac", "a number above 0: spikes cost accumulations")
    memory = _memory(file.section("memory", _MEMORY), factor) if "memory" in file else None
    return Target(**texts, evidence=evidence, operations_pj=operations, memory=memory)


def _memory(section: Section, factor: float) -> Memory:
    levels = section.section("energy_by_kilobytes", optional=None)
    if not levels.raw:
        raise section.wrong("energy_by_kilobytes", "sizes and energies")
    energies = {
        float(check_number(levels.where, "a size of memory.energy_by_kilobytes", size)): levels.number(size) * factor
        for size in levels.raw
    }
    by_size = sorted(energies.items())
    for (small, low), (large, high) in pairwise(by_size):
        if high < low:
            raise ConfigError(
                f"{section.where}: memory.energy_by_kilobytes has {high / factor:g} for {large:g} kB and "
                f"{low / factor:g} for {small:g} kB, expected no less for a larger memory"
            )
    bits = {key: section.whole(key, 1, 1024, "bits") for key in _MEMORY if key.endswith("_bits")}
    return Memory(bits["access_bits"], dict(by_size), bits["weight_bits"], bits["state_bits"])


TARGETS = Catalog("energy target", "switchmt_snn.export.energy.targets", read_target)
"""The energy targets that come with the package, and files of targets."""
