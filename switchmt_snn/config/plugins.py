"""Classes from outside the package, named in a config as ``package.module:Name``."""

from __future__ import annotations

import importlib
import re
from typing import Any, NewType

from switchmt_snn.errors import ConfigError

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
        ConfigError: the module cannot be imported, or has no such attribute.
    """
    module_name, _, attribute = name.partition(":")
    try:
        module = importlib.import_module(module_name)
    except ImportError as error:
        raise ConfigError(
            f"{key} is {name!r}, expected an importable module, but importing {module_name!r} fails ({error}); "
            "install it, or add its folder to PYTHONPATH"
        ) from error
    try:
        return getattr(module, attribute)
    except AttributeError:
        raise ConfigError(
            f"{key} is {name!r}, expected a name that {module_name!r} defines, but it has no {attribute!r}; "
            "check the spelling"
        ) from None


def plugin_name(plugin: type[Any], key: str) -> PluginName:
    """The ``package.module:Name`` by which :func:`load_plugin` finds a class again.

    Raises:
        ConfigError: the class is local to a function or nested in a class, so no config can name it.
    """
    name = f"{plugin.__module__}:{plugin.__qualname__}"
    if not is_plugin(name):
        raise ConfigError(
            f"{key} is the local class {plugin.__qualname__!r}, expected a class at the top level of a module; a run "
            "stores its name, so that it can be resumed"
        )
    return PluginName(name)
