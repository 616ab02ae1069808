"""An update engine from outside the package, as docs/extending.md writes it."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.recipes import code_of


@pytest.mark.slow
def test_the_recipe_of_an_update_engine_runs(tmp_path: Path) -> None:
    module, script = code_of("Update engine")
    (tmp_path / "my_engines.py").write_text(module)
    done = subprocess.run(
        [sys.executable, "-c", script], cwd=tmp_path, env=os.environ, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert "'loss'" in done.stdout
    assert "Anomaly Detection has been enabled" in done.stderr
