"""Classes from outside the package, named in a config as ``package.module:Name``."""

from __future__ import annotations

import contextlib
import importlib
import os
import re
import sys
import traceback
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any, NewType

from switchmt_snn.config.strict_yaml import parse_yaml
from switchmt_snn.config.trust import require_trusted
from switchmt_snn.errors import ConfigError, SwitchMTError

PluginName = NewType("PluginName", str)
"""A config value that names a class from outside the package: ``package.module:Name``."""

_PLUGIN = re.compile(r"[A-Za-z_]\w*(\.[A-Za-z_]\w*)*:[A-Za-z_]\w*")


def is_plugin(name: object) -> bool:
    """Whether a config value names a class from outside the package, as in ``my_module:MyNeuron``."""
    return isinstance(name, str) and _PLUGIN.fullmatch(name) is not None


def load_plugin(name: str, key: str) -> Any:
    """The object that ``package.module:Name`` stands for.

    Args:
        name: module and attribute; the module must be importable (installed, or in the current folder's path).
        key: the config key that holds the name, for the error.

    Raises:
        ConfigError: the module cannot be imported, its code fails, or it has no such attribute.
    """
    module_name, _, attribute = name.partition(":")
    try:
        module = import_plugin_module(module_name)
    except ImportError as error:
        raise ConfigError(
            f"{key} is {name!r}, expected an importable module, but importing {module_name!r} fails ({error}); "
            "install it, add its folder to PYTHONPATH, or mend it"
        ) from error
    try:
        return getattr(module, attribute)
    except AttributeError:
        raise ConfigError(
            f"{key} is {name!r}, expected a name that {module_name!r} defines, but it has no {attribute!r}; "
            "check the spelling"
        ) from None
    except Exception as error:  # a module that looks its names up when they are asked for
        raise ConfigError(
            f"{key} is {name!r}, expected a name that {module_name!r} defines, but looking it up fails "
            f"({failure(error)}); install what it needs, or mend it"
        ) from error


def import_plugin_module(module_name: str) -> ModuleType:
    """Import a module from outside the package.

    The script that runs is not imported a second time. The current folder is searched last, so that ``switchmt-snn``
    finds modules that lie in it. All imports of modules that a config names pass here.

    Raises:
        UntrustedError: a stored file names it, and this user does not trust it (``switchmt_snn.config.trust``).
        ImportError: the module, or one that it imports, is not found, or its code fails.
    """
    require_trusted([module_name])
    if module_name == _script_name():
        return _script()
    if module_name.endswith(".__main__"):
        raise ImportError(f"{module_name} is a program, not a module")
    folder = str(Path.cwd())
    if folder not in sys.path:
        sys.path.append(folder)
    try:
        return importlib.import_module(module_name)
    except ImportError:
        raise
    except (Exception, SystemExit) as error:  # whatever the module's own code raises
        raise ImportError(failure(error)) from error


def plugin_file(name: str) -> Path | None:
    """The source file of the module of ``package.module:Name``; None if it has none (built in, interactive).

    Raises:
        ImportError: see ``import_plugin_module``.
    """
    path = getattr(import_plugin_module(name.partition(":")[0]), "__file__", None)
    return None if path is None else Path(path)


def plugin_name(plugin: type[Any], key: str) -> PluginName:
    """The ``package.module:Name`` by which ``load_plugin`` finds a class again.

    A class of the script that runs gets the script's name: ``own_policy:MyCriterion`` in ``python own_policy.py``.

    Raises:
        ConfigError: it is no class, or local to a function or nested in a class, so no config can name it.
    """
    if not isinstance(plugin, type):
        raise ConfigError(f"{key} is {plugin!r}, expected a class; names of classes belong into the config")
    module_name = _script_name() or "__main__" if plugin.__module__ == "__main__" else plugin.__module__
    name = f"{module_name}:{plugin.__qualname__}"
    if not is_plugin(name):
        raise ConfigError(
            f"{key} is {plugin.__qualname__} of the module {module_name!r}, expected a class at the top level of a "
            "module that can be imported; a run stores its name, so that it can be resumed"
        )
    return PluginName(name)


def failure(error: BaseException) -> str:
    """One line for what code from outside the package raised, and the place in a file outside the package.

    Example: ``AttributeError: 'float' object has no attribute 'clamp' at my_neurons.py, line 9``.
    """
    text = " ".join(f"{type(error).__name__}: {error}".split())
    ours, installed = str(Path(__file__).parents[1]), ("site-packages", "dist-packages", f"{os.sep}lib{os.sep}python")
    frames = [
        frame
        for frame in traceback.extract_tb(error.__traceback__)
        if not frame.filename.startswith((ours, "<")) and not any(part in frame.filename for part in installed)
    ]
    return f"{text} at {Path(frames[-1].filename).name}, line {frames[-1].lineno}" if frames else text


@contextlib.contextmanager
def user_code(
    seen: str, expected: str, kind: type[SwitchMTError] = ConfigError, outside: bool = True
) -> Iterator[None]:
    """Around a call of code from outside the package: what it raises becomes the one line of an error.

    The line is ``SEEN (FAILURE), expected EXPECTED``, with ``failure`` in the middle. An error that this package raises
    on purpose has its line already and goes through.

    Args:
        seen: the class and what fails, as ``network.encoding is 'my_module:Mine', which fails in encode``.
        expected: what the contract wants of the code, or what to do.
        kind: the error's class.
        outside: whether the code is from outside the package. False lets everything through: it is a fault of ours,
            and its traceback is needed.

    Raises:
        SwitchMTError: of class ``kind``.
    """
    try:
        yield
    except SwitchMTError:
        raise
    except (Exception, SystemExit) as error:
        if not outside:
            raise
        raise kind(f"{seen} ({failure(error)}), expected {expected}") from error


def plugin_options(options: Sequence[str], key: str) -> dict[str, bool | int | float | str]:
    """Keyword arguments of a plugin from ``name=value`` texts; a value is read as YAML reads it.

    Raises:
        ConfigError: a text has no name or no plain value, or a name comes twice.
    """
    arguments: dict[str, bool | int | float | str] = {}
    for option in options:
        name, equals, text = option.partition("=")
        value = _plain(text)
        if not (equals and name.isidentifier()) or value is None or name in arguments:
            raise ConfigError(f"{key} has {option!r}, expected name=value with a plain value, each name once")
        arguments[name] = value
    return arguments


def _plain(text: str) -> bool | int | float | str | None:
    """A number, a truth value or text; None for anything else."""
    try:
        value = parse_yaml(text, "an option", "a plain value")
    except ConfigError:
        return None
    if isinstance(value, str):
        with contextlib.suppress(ValueError):  # YAML 1.1 reads 1e-4 (no dot) as text
            return float(value)
    return value if isinstance(value, (bool, int, float, str)) else None


def _script() -> ModuleType:
    return sys.modules["__main__"]


def _script_name() -> str | None:
    """The name under which the running script can be imported; None for an interactive session."""
    script = _script()
    if getattr(script, "__spec__", None) is not None:
        return str(script.__spec__.name)  # type: ignore[union-attr]
    path = getattr(script, "__file__", None)
    return None if path is None else Path(path).stem
