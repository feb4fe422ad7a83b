"""The starter scenarios whose controllers are written in Python."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

SCENARIOS = Path(__file__).parents[2] / "scenarios"
PYTHON = [p for p in sorted(SCENARIOS.glob("*.toml")) if '"python3"' in p.read_text()]


@pytest.mark.parametrize("scenario", PYTHON, ids=lambda path: path.stem)
def test_scenario(scenario):
    programs = Path(os.environ["PLANTD_SERVER"]).resolve().parent
    # This interpreter is the one that has the package.
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    environment = {**os.environ, "PATH": path}
    environment.pop("PLANTD_ADDRESS", None)
    test = subprocess.run(
        [programs / "plantctl", "test", scenario, "--json"],
        env=environment,
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert test.returncode == 0, test.stdout + test.stderr
    summary = json.loads(test.stdout.splitlines()[-1])
    assert summary["passed"] > 0 and summary["failed"] == summary["errors"] == 0


def test_there_are_some():
    assert PYTHON
