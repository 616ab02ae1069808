"""What all pages share: the template environment with its filters and the style sheet."""

from __future__ import annotations

from jinja2 import ChoiceLoader, Environment, PackageLoader, StrictUndefined

from switchmt_snn.drawing.marks import DARK, LIGHT
from switchmt_snn.drawing.numbers import bytes_of, digits, percent, two, whole

FILTERS = {filter.__name__: filter for filter in (whole, digits, percent, two, bytes_of)}


def page_environment(package: str) -> Environment:
    """Jinja over the templates of a package and those that all pages share (``style.css.jinja``)."""
    environment = Environment(
        loader=ChoiceLoader([PackageLoader(package), PackageLoader("switchmt_snn.drawing")]),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= FILTERS
    environment.globals |= FILTERS | {"light": LIGHT, "dark": DARK}
    return environment
