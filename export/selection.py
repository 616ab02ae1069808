"""Which energy targets and chips a profile uses: built-in ones by name, and YAML files of either kind."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from switchmt_snn.errors import ConfigError
from switchmt_snn.export.chips.chip import Chip
from switchmt_snn.export.chips.chip_file import CHIPS
from switchmt_snn.export.energy.estimate import TARGETS, Target
from switchmt_snn.export.yaml_files import SUFFIXES, file_text, parse

KINDS = ("energy", "chip")
"""Values of a file's key ``kind``."""


@dataclass(frozen=True)
class Selection:
    """Energy targets to price with, and chips to fit on."""

    targets: tuple[Target, ...]
    chips: tuple[Chip, ...]

    @classmethod
    def of(cls, names: str | Path | Sequence[str | Path]) -> Selection:
        """Select by name and by file; a name may be both an energy target and a chip. None selects all built-in ones.

        Raises:
            ConfigError: no such target or chip, a file that is neither or takes a built-in one's name, or one name
                for two.
        """
        known, chips = TARGETS.built_in, CHIPS.built_in
        names = (names,) if isinstance(names, (str, Path)) else names
        if not names:
            return cls(tuple(known.values()), tuple(chips.values()))
        found: list[Target | Chip] = []
        _require_each_once(list(map(str, names)))
        for name in map(str, names):
            if Path(name).suffix in SUFFIXES:
                found.append(_read(name))
            elif name in known or name in chips:
                found += [built_in[name] for built_in in (known, chips) if name in built_in]
            else:
                raise ConfigError(
                    f"unknown target {name!r}, expected a YAML file, an energy target ({', '.join(known)}) or a chip "
                    f"({', '.join(chips)})"
                )
        targets = tuple(one for one in found if isinstance(one, Target))
        selected = tuple(one for one in found if isinstance(one, Chip))
        _require_different_names("targets", [target.name for target in targets])
        _require_different_names("chips", [chip.name for chip in selected])
        return cls(targets, selected)


def _read(file: str) -> Target | Chip:
    """The target or chip of a file; without a ``kind``, one with ``limits`` is a chip, any other a target."""
    raw = parse(file_text(file), file)
    kind = raw.get("kind", "chip" if "limits" in raw else "energy")
    if kind not in KINDS:
        raise ConfigError(f"{file}: kind is {kind!r:.60}, expected one of {', '.join(KINDS)}")
    if kind == "chip":
        return CHIPS.own(CHIPS.read(raw, file), file)
    return TARGETS.own(TARGETS.read(raw, file), file)


def _require_each_once(names: list[str]) -> None:
    for name in names:
        if names.count(name) > 1:
            raise ConfigError(f"the target {name!r} is named {names.count(name)} times, expected each once")


def _require_different_names(what: str, names: list[str]) -> None:
    if len(set(names)) < len(names):
        raise ConfigError(
            f"two {what} have one name ({', '.join(names)}), expected different ones; change the name in your file"
        )
