"""Whether a page that the program wrote is sound in a real browser."""

from __future__ import annotations

from importlib import resources
from pathlib import Path

import pytest

from docs.tools.browser import View, find_browser, opened
from switchmt_snn.errors import MissingExtraError

AUDITED = (View(1280), View(400, dark=True))
"""An audit takes seconds; between them these hold both layouts and both sets of colours."""
VIEWS = (*AUDITED, View(400), View(1280, dark=True), View(718, paper=True))
AUDIT = "axe.run().then(found => found.violations.map(one => one.impact + ' ' + one.id + ': ' + one.nodes[0].html))"


def assert_sound(page: Path) -> None:
    """Open a page narrow and wide, light, dark and as it is printed.

    Nothing is cut, the console is silent, nothing is asked of a network, and axe-core finds no fault of accessibility.
    Skips the test where there is no browser of the Chromium family.
    """
    try:
        find_browser()
    except MissingExtraError as error:
        pytest.skip(str(error))
    axe = (resources.files("axe_core_python") / "axe.min.js").read_text("utf-8")
    with opened() as window:
        for view in VIEWS:
            look = window.look(page, view)
            faults = (look.too_wide, look.complaints, look.requests)
            assert faults == ((), (), ()), (view, faults)
            if view in AUDITED:
                window.evaluate(f"{axe}; 0")
                assert window.evaluate(AUDIT) == [], view
