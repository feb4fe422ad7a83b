"""A batch over two Ray nodes, one of which is lost: the bits of one server, for hardly more work."""

import importlib.util
import json
import os
import secrets
import subprocess
import sys
from pathlib import Path

import pytest

CASES, STEPS = 10_000, 3000


@pytest.mark.skipif(
    any(importlib.util.find_spec(name) is None for name in ("ray", "psutil")), reason="needs ray and psutil"
)
def test_a_batch_outlives_a_node(server):
    environment = {**os.environ, "RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN": secrets.token_hex(32)}
    environment |= {"RAY_USAGE_STATS_ENABLED": "0"}
    command = [sys.executable, Path(__file__).with_name("over_nodes.py"), str(CASES), str(STEPS)]
    ended = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=280)
    assert ended.returncode == 0, ended.stderr
    told = json.loads(ended.stdout.splitlines()[-1])
    one, nodes = told["one"], told["nodes"]
    print(f"{CASES} cases of {STEPS} steps, processor seconds of the servers and of everything; wall:")
    for name, what in [("one server", one), ("two nodes of Ray, one lost", nodes)]:
        print(f"  {name:27}{what['servers_s']:6.1f} {what['all_s']:6.1f} s; {what['wall_s']:5.1f} s")
    assert told["servers_of_lost_node"] == 1 and told["alive"] == 1
    assert nodes["digest"] == one["digest"]
    print(f"  of {told['pieces']} pieces {told['pieces_again']} were begun again")
    # What the lost node was doing, and no more.
    assert told["pieces"] * told["size"] == CASES
    assert told["pieces_again"] <= told["most_under_way"]
    assert told["servers_left"] == told["processes_left"] == []
