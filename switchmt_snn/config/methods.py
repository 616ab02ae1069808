"""The seven methods of the paper, and what their names stand for."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

from switchmt_snn.config.switching import Policy

Method = Literal["DQN", "DSQN", "DQN_D", "DSQN_D", "MTSpark_AD", "MTSpark_ADD", "SwitchMT"]
METHODS: tuple[str, ...] = get_args(Method)


@dataclass(frozen=True)
class MethodTraits:
    """What a method name of the paper stands for (ALGORITHM section 1; paper, Table 3)."""

    spiking: bool
    dueling: bool
    dendrites: bool
    switching: Policy


METHOD_TRAITS: dict[str, MethodTraits] = {
    "DQN": MethodTraits(spiking=False, dueling=False, dendrites=False, switching="fixed_episodes"),
    "DSQN": MethodTraits(spiking=True, dueling=False, dendrites=False, switching="fixed_episodes"),
    "DQN_D": MethodTraits(spiking=False, dueling=True, dendrites=False, switching="fixed_episodes"),
    "DSQN_D": MethodTraits(spiking=True, dueling=True, dendrites=False, switching="fixed_episodes"),
    "MTSpark_AD": MethodTraits(spiking=True, dueling=False, dendrites=True, switching="fixed_episodes"),
    "MTSpark_ADD": MethodTraits(spiking=True, dueling=True, dendrites=True, switching="fixed_episodes"),
    "SwitchMT": MethodTraits(spiking=True, dueling=True, dendrites=True, switching="parameter_change"),
}
"""The seven methods that the paper compares."""
