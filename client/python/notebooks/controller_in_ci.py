# ---
# jupyter:
#   jupytext:
#     text_representation:
#       extension: .py
#       format_name: percent
# ---

# %% [markdown]
# # Testing a controller in CI
#
# A scenario is a file: a plant, a controller, what happens to them, and what is expected. `plantctl test` runs it on a server
# of its own and ends with 0 where every expectation came true, so a pipeline needs one line.

# %%
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path


def find(program):
    """Beside the server that this notebook uses, beside Python, or in PATH."""
    beside = [Path(os.environ["PLANTD"]).with_name(program)] if "PLANTD" in os.environ else []
    places = [*beside, Path(sys.executable).with_name(program)]
    return next((str(p) for p in places if p.exists()), shutil.which(program))


plantctl = find("plantctl")

# %% [markdown]
# ## The controller
#
# Any program that speaks gRPC or shared memory; this one is a Python file. What to drive it learns from its environment. It
# has a gain of its own, which somebody may break by tomorrow.

# %%
CONTROLLER = """
import os, plantd

with plantd.connect(os.environ["PLANTD_ADDRESS"]) as client:
    law = client.solve_lqr("pendulum", at="upright", q=[100, 1], r=[1], dt=0.02)
    gain = GAIN * law.k
    with client.drive(os.environ["PLANTD_PLANT"]) as driver:
        state = driver.plant.state
        for _ in range(int(os.environ["PLANTD_STEPS"])):
            state = driver.step(law.u_reference - gain @ (state.x - law.x_reference))
"""
folder = Path("ci")
folder.mkdir(exist_ok=True)
(folder / "controller.py").write_text(CONTROLLER.replace("GAIN", "1.0"))

# %% [markdown]
# ## The scenario
#
# Starts and masses are drawn at random from a seed, a push comes along, and a sensor fails to be anything but noisy. In
# lockstep the results are the same on each machine.

# %%
SCENARIO = f"""
name = "pendulum: held upright by a controller of our own"
duration_s = 4.0
seed = 1

[plant]
model = "pendulum"
time_step_s = 0.02

[reference]
at = "upright"

[controller.command]
run = ["{sys.executable}", "controller.py"]

[random]
cases = 4
q = {{ theta = {{ uniform = [2.9, 3.4] }} }}
parameters = {{ "frames[rod].body.mass" = {{ normal = [1.0, 0.05] }} }}

[[events]]
at_s = 2.0
for_s = 0.1
inputs = {{ tau = 2.0 }}

[[expect]]
settles = {{ signal = "error(theta)", to = 0, within = 0.02, by_s = 3.9 }}
"""
(folder / "hold.toml").write_text(SCENARIO)


def test():
    """Runs the scenario as a pipeline would; its exit code and its summary."""
    command = [plantctl, "test", "hold.toml", "--json", "--junit", "junit.xml", "--html", "report.html"]
    environment = {k: v for k, v in os.environ.items() if k != "PLANTD_ADDRESS"}
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True)
    return done.returncode, json.loads(done.stdout.splitlines()[-1])


code, summary = test()
print("exit code", code, summary)
assert code == 0 and summary["passed"] == 4

# %% [markdown]
# ## Somebody breaks it
#
# The pipeline goes red, and says in which cases. `junit.xml` is for the pipeline's page, `report.html` has the plots.

# %%
(folder / "controller.py").write_text(CONTROLLER.replace("GAIN", "0.1"))
code, summary = test()
print("exit code", code, summary)
assert code != 0 and summary["failed"] == 4
print(sorted(path.name for path in folder.iterdir()))
