"""What a switching criterion is, and the registry of criteria.

A criterion is one subclass of ``Criterion`` in one file. The class itself states what other parts of the package
must know: the columns of switches.csv, the memory it takes, the line on the screen.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from typing import Any, ClassVar

from torch import Tensor

from switchmt_snn.config import SwitchingConfig
from switchmt_snn.config.plugins import is_plugin, plugin_name, plugin_options, user_code
from switchmt_snn.config.registry import Registry
from switchmt_snn.errors import ConfigError, did_you_mean, shown
from switchmt_snn.learning.state import Stateful
from switchmt_snn.tasks.suite import Reference

DECISION_COLUMNS = (
    "step",
    "visit",
    "task",
    "episodes_in_visit",
    "steps_in_visit",
    "decision",
    "next_task",
    "reason",
)
"""The columns of switches.csv that every run has; a criterion's own columns follow."""


def _no_network(asked: object) -> Any:
    raise ConfigError(
        "this episode's record has no network to ask for observations or values, expected one of a training; a "
        "criterion that needs them cannot judge recorded episodes"
    )


@dataclass(frozen=True)
class EpisodeRecord:
    """What a criterion may look at when an episode ends.

    Attributes:
        task: index of the task.
        episodes_in_visit: episodes that ended since the task was entered, this one included.
        steps_in_visit: agent steps since the task was entered.
        updates: gradient steps of the whole run.
        updates_in_visit: gradient steps from the task's own replay since the task was entered.
        episode_return: raw return of the episode.
        parameters: returns theta_t as a vector, a copy that stays as it is. Only a criterion that declares
            ``Criterion.snapshots`` may call it.
        observations: takes a count, and returns so many observations ``[count, ...]`` drawn from the task's replay, to
            ask ``values`` about. The same step gives the same draw; training's random numbers stay as they are.
        values: takes observations, and returns their Q-values ``[count, A]`` for the task's actions, by the network
            that learns, in eval mode.
        silent_shares: takes observations, and returns by layer the share of neurons, within [0, 1], that fire at none
            of them (ANN: whose output is 0), in the network that learns, in eval mode.
        recorded: when a finished run is replayed (``switchmt-snn replay-policies``), the numbers that its switches.csv
            holds for this episode's end, and no network; None in a training.
    """

    task: int
    episodes_in_visit: int
    steps_in_visit: int
    updates: int
    updates_in_visit: int
    episode_return: float
    parameters: Callable[[], Tensor]
    observations: Callable[[int], Tensor] = _no_network
    values: Callable[[Tensor], Tensor] = _no_network
    silent_shares: Callable[[Tensor], dict[str, float]] = _no_network
    recorded: Mapping[str, float] | None = None

    def recorded_number(self, column: str) -> float:
        """A number that the replayed run measured at this episode's end.

        Raises:
            ConfigError: it measured none.
        """
        if self.recorded is None or column not in self.recorded:
            raise ConfigError(
                f"the run measured no {column} at episode {self.episodes_in_visit} of a visit, where this policy needs "
                "one, expected the bounds and switching.judge_learning with which the run was trained"
            )
        return self.recorded[column]


@dataclass(frozen=True)
class Verdict:
    """A criterion's answer.

    Attributes:
        leave: whether learning has levelled off.
        reason: a short name for what decided; a column of switches.csv.
        measured: every number that the answer rests on, by its name in ``Criterion.columns``.
        summary: how near the task is to a switch, in a few words for the progress display.
    """

    leave: bool
    reason: str
    measured: dict[str, float]
    summary: str = ""


@dataclass(frozen=True)
class Deciding:
    """A number that decides, for charts of a run.

    Attributes:
        number: the column of switches.csv.
        bound: columns whose product it is compared with; empty for none.
    """

    number: str
    bound: tuple[str, ...] = ()


class Criterion(Stateful):
    """Decides at each episode's end whether learning on the current task has levelled off.

    A subclass defines ``columns``, its constructor and ``end_of_episode``. ``switching.options`` sets keyword
    arguments of its constructor; give each a default. Attributes that change are named in ``SAVED`` and the others in
    ``DERIVED``, so that a run resumes exactly.

    Attributes:
        columns: names of the numbers that it reports in ``Verdict.measured``; they are columns of switches.csv.
        deciding: which of them decide; charts show these, or all of ``columns`` if it is empty.
        judges_learning: whether it concludes from what was learned. Then it sees no episode of a visit that ended
            before the visit's first update (``switching.judge_learning``). False for a rule that only counts.
        needs_network: columns that only a network gives, each with the settings under ``switching`` on which it
            depends. A finished run can be replayed if it has these columns (``EpisodeRecord.recorded``), measured with
            the same settings.
    """

    columns: ClassVar[tuple[str, ...]]
    deciding: ClassVar[tuple[Deciding, ...]] = ()
    judges_learning: ClassVar[bool] = True
    needs_network: ClassVar[Mapping[str, tuple[str, ...]]] = {}

    def __init__(self, config: SwitchingConfig) -> None:
        """Take what it needs of the settings in section ``switching``."""

    @classmethod
    def snapshots(cls, config: SwitchingConfig) -> int:
        """The largest number of parameter vectors that it holds at a time, for the memory estimate. Default: 0."""
        return 0

    def meet_tasks(self, num_tasks: int, references: tuple[Reference | None, ...]) -> None:
        """Learn how many tasks there are, and their published scores; called once, after the constructor.

        What it sets belongs into ``SAVED`` or ``DERIVED``, too. Default: nothing.
        """

    def next_task(self, task: int, num_tasks: int, steps_in_visit: int) -> int:
        """The task that follows when a visit ends, also when ``max_stay_steps`` ends it. Default: the next in order.

        Called once per visit, before ``start_visit`` and before the rest of the episodes that ended in the same step.

        Args:
            task: the task that is left.
            num_tasks: number of tasks K, at least 2.
            steps_in_visit: agent steps of the visit, those after its last episode end included.

        Returns:
            an index below K, other than ``task``.
        """
        return (task + 1) % num_tasks

    def start_visit(self) -> None:
        """Forget the last visit (Algorithm 1: H_i <- []). Default: nothing to forget."""

    def end_of_episode(self, record: EpisodeRecord) -> Verdict:
        """Take an episode in, and judge."""
        raise NotImplementedError(f"{type(self).__name__} defines no end_of_episode, expected its rule")


def check_criterion(criterion: Any, policy: str) -> type[Criterion]:
    """Return the class if it is a whole criterion.

    Raises:
        ConfigError: it is no subclass of ``Criterion``, lacks ``Criterion.columns`` or ``Criterion.end_of_episode``, a
            column bears a name of ``DECISION_COLUMNS``, or another fact has another type.
    """
    seen = f"switching.policy is {policy!r}"
    if not (isinstance(criterion, type) and issubclass(criterion, Criterion)):
        raise ConfigError(
            f"{seen}, which is no criterion, expected a subclass of switchmt_snn.learning.switching.Criterion"
        )
    if criterion.end_of_episode is Criterion.end_of_episode:
        raise ConfigError(f"{seen}, which defines no end_of_episode, expected end_of_episode(self, record) -> Verdict")
    columns = getattr(criterion, "columns", None)
    if not (isinstance(columns, tuple) and all(isinstance(column, str) for column in columns)):
        raise ConfigError(
            f"{seen}, whose columns are {columns!r}, expected a tuple with the names of the numbers that it measures; "
            "() if it measures none"
        )
    for attribute in ("SAVED", "DERIVED"):
        names = getattr(criterion, attribute)
        if not (isinstance(names, tuple) and all(isinstance(name, str) for name in names)):
            raise ConfigError(
                f'{seen}, whose {attribute} is {names!r}, expected a tuple of names, as ("returns",) with its comma'
            )
    if not isinstance(criterion.judges_learning, bool):
        raise ConfigError(f"{seen}, whose judges_learning is {criterion.judges_learning!r}, expected True or False")
    known = (*columns, "episodes_in_visit", "steps_in_visit")
    deciding = criterion.deciding
    if not (isinstance(deciding, tuple) and all(isinstance(one, Deciding) for one in deciding)):
        raise ConfigError(f"{seen}, whose deciding is {deciding!r}, expected a tuple of Deciding(number, bound)")
    for name in (name for one in deciding for name in (one.number, *one.bound)):
        if name not in known:
            raise ConfigError(f"{seen}, whose deciding names {name!r}, expected one of {', '.join(known)}")
    for column in columns:
        if column in DECISION_COLUMNS or not column.isidentifier() or columns.count(column) > 1:
            raise ConfigError(
                f"{seen}, which has a column {column!r}, expected plain names, each once, and none of "
                f"{', '.join(DECISION_COLUMNS)}"
            )
    return criterion


CRITERIA: Registry[type[Criterion]] = Registry(SwitchingConfig, "switching.policy", check_criterion)
"""The criteria of this package, by the name that ``switching.policy`` takes."""

register_criterion, criterion_class = CRITERIA.register, CRITERIA.find


def with_policy(config: SwitchingConfig, criterion: type[Criterion]) -> SwitchingConfig:
    """The settings with a class from outside the package in place of their policy; it takes their options.

    Raises:
        ConfigError: a class that no config can name, or an option of the replaced policy that it does not have.
    """
    name = plugin_name(criterion, "policy")
    known = inspect.signature(criterion).parameters
    for option in plugin_options(config.options, "switching.options"):
        if option not in known:
            raise ConfigError(
                f"switching.options has {option!r} for the config's policy {config.policy}, which the argument policy "
                f"replaces by {name}, expected options that {name} has ({', '.join(list(known)[1:]) or 'none'}); "
                "replace switching.options, too, or leave the argument out"
            )
    return replace(config, policy=name)


def make_criterion(config: SwitchingConfig) -> Criterion:
    """The criterion of a resolved config, with its options.

    Raises:
        ConfigError: an unknown policy, a constructor that takes no config or fails, an option that the class does not
            take or that has another type, or state that a resume would lose.
    """
    cls = criterion_class(config.policy)
    options = plugin_options(config.options, "switching.options")
    parameters = list(inspect.signature(cls).parameters.values())
    if not parameters or parameters[0].name in options or parameters[0].default is not inspect.Parameter.empty:
        raise ConfigError(
            f"switching.policy is {config.policy!r}, whose constructor takes {inspect.signature(cls)}, expected "
            "__init__(self, config, ...): the settings under switching come first, then the options"
        )
    known = [parameter.name for parameter in parameters[1:]]
    for name in options:
        if name not in known:
            raise ConfigError(
                f"switching.options has {name!r}, expected keyword arguments of {cls.__name__}"
                f"{did_you_mean(name, known) if known else ' (it has none)'}"
            )
    for parameter in parameters[1:]:
        if parameter.name in options:
            _require_kind(parameter, options[parameter.name])
    with criterion_code(config.policy, "its constructor"):
        criterion = cls(config, **options)
    check_state(criterion)
    with criterion_code(config.policy, "snapshots"):
        held: Any = criterion.snapshots(config)
    if not isinstance(held, int) or held < 0:
        raise ConfigError(
            f"switching.policy is {config.policy!r}, whose snapshots gave {shown(held)}, expected a whole number from 0"
        )
    return criterion


def criterion_code(policy: str, where: str) -> AbstractContextManager[None]:
    """Around a call of the criterion that ``switching.policy`` names; see ``user_code``."""
    seen = f"switching.policy is {policy!r}, which fails in {where}"
    return user_code(seen, "no error; mend it", outside=is_plugin(policy))


def _require_kind(parameter: inspect.Parameter, value: Any) -> None:
    """Refuse an option of another type than its annotation, or, without a plain one, than its default."""
    kinds: dict[Any, tuple[type, ...]] = {bool: (bool,), int: (int,), float: (int, float), str: (str,)}
    stated = {"bool": bool, "int": int, "float": float, "str": str}.get(parameter.annotation, parameter.annotation)
    allowed = kinds.get(stated)
    if allowed is None and stated is inspect.Parameter.empty:
        default = type(parameter.default)
        allowed = kinds.get(float if default is int else default)
    if allowed is None or (isinstance(value, allowed) and (bool in allowed or not isinstance(value, bool))):
        return
    shown = "" if parameter.default is inspect.Parameter.empty else f", as its default {parameter.default!r}"
    expected = "a number" if allowed == (int, float) else f"a value of type {allowed[0].__name__}"
    raise ConfigError(f"switching.options has {parameter.name}={value!r}, expected {expected}{shown}")


def check_state(criterion: Criterion) -> None:
    """Refuse a criterion with an attribute that a resume would lose.

    Raises:
        ConfigError: naming the attribute.
    """
    for name in vars(criterion):
        if name not in (*criterion.SAVED, *criterion.DERIVED):
            raise ConfigError(
                f"{type(criterion).__name__} has the attribute {name!r}, expected it in SAVED (what changes) or "
                "DERIVED (what the constructor sets); else a resumed run would lose it"
            )
