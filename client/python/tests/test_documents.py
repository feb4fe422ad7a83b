"""The listings of the tutorial, in their order."""

import os
import re
import subprocess
import sys
from pathlib import Path

DOCUMENTS = Path(__file__).parents[3] / "docs"


def test_the_tutorial_runs(tmp_path):
    text = (DOCUMENTS / "tutorial.md").read_text()
    listings = re.findall(r"^```python\n(.*?)^```", text, flags=re.M | re.S)
    assert len(listings) >= 6
    script = tmp_path / "tutorial.py"
    script.write_text("\n".join(listings))
    environment = {**os.environ, "PLANTD": os.environ["PLANTD_SERVER"], "MPLBACKEND": "Agg"}
    run = subprocess.run([sys.executable, script], env=environment, cwd=tmp_path, capture_output=True, text=True)
    assert run.returncode == 0, run.stdout + run.stderr
    assert "did you mean `second`?" in run.stdout
