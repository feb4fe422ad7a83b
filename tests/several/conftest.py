"""Acceptance of docs/several.md on one machine: run by `cargo verify --only several`, which installs what they need.

They use the client's own tests, and the server that `PLANTD_SERVER` names.
"""

import os
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "client/python/tests"))


@pytest.fixture
def server(monkeypatch):
    """The program that is tested; processes that are started find it, too."""
    program = os.environ.get("PLANTD_SERVER")
    if not program:
        pytest.exit("PLANTD_SERVER must name the plantd binary", returncode=2)
    monkeypatch.setenv("PLANTD", program)
    return program
