"""Small networks and neurons of the tests."""

from __future__ import annotations

from typing import cast

from switchmt_snn.config import NetworkConfig, resolve
from switchmt_snn.native.neurons import Neurons
from switchmt_snn.spiking.network import ObservationSpec, QNetwork, Stream, build_network
from tests.conftest import small_config


def network_of(actions: int = 6, **settings: object) -> QNetwork:
    config = small_config(network={"trunk": "mlp", "hidden_units": 37, **settings}, learning={"loss": "huber"})
    return build_network(resolve(config).network, ObservationSpec((7,), 1, 1.0, True, actions, 3), 1)


def streams_of(network: QNetwork) -> list[Stream]:
    return [cast(Stream, stream) for stream in network.streams.values()]


def neurons_of(timesteps: int) -> Neurons:
    """The default neurons."""
    return Neurons(NetworkConfig(trunk="mlp", dendrites="none", timesteps=timesteps))
