"""The notebooks, which are scripts in jupytext's percent format: each runs from its first line to its last."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

NOTEBOOKS = sorted((Path(__file__).parents[1] / "notebooks").glob("*.py"))


@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_runs(notebook, tmp_path):
    environment = {**os.environ, "PLANTD": os.environ["PLANTD_SERVER"], "MPLBACKEND": "Agg"}
    run = subprocess.run(
        [sys.executable, str(notebook)], env=environment, cwd=tmp_path, capture_output=True, text=True
    )
    assert run.returncode == 0, run.stdout + run.stderr
    text = notebook.read_text()
    assert text.startswith("# ---\n# jupyter:") and text.count("# %% [markdown]") >= 3


def test_there_are_notebooks():
    assert len(NOTEBOOKS) >= 6
