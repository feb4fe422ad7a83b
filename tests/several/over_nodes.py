"""Does a batch on one server, then on two Ray nodes of which one is killed meanwhile, and prints as JSON what it took.

    python3 over_nodes.py CASES STEPS           # takes RAY_AUTH_MODE, RAY_AUTH_TOKEN and PLANTD in the environment

Both nodes are started and ended here, on this machine: a node is a processor.
"""

import contextlib
import hashlib
import json
import math
import os
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

import psutil

assert os.environ["RAY_AUTH_MODE"] == "token"
# It reads the environment.
import ray  # noqa: E402
from plantd import batch  # noqa: E402

SIZE = 250
NODES = 2
PATIENCE = 60


class Times:
    """Processor times of processes that have this process's token, those that are gone included, s."""

    def __init__(self):
        #: By process: its name, its time.
        self.seen = {}
        self._is_over = threading.Event()
        self._lock = threading.Lock()
        self._thread = threading.Thread(target=self._watch, daemon=True)
        self._thread.start()

    def _watch(self):
        while not self._is_over.wait(0.1):
            self.look()

    def look(self):
        with self._lock:
            for process in own():
                with contextlib.suppress(psutil.Error):
                    spent = process.cpu_times()
                    self.seen[process.pid, process.create_time()] = (process.name(), spent.user + spent.system)

    def of_servers(self):
        self.look()
        return sum(spent for name, spent in self.seen.values() if name == "plantd")

    def of_all(self):
        self.look()
        return sum(spent for _, spent in self.seen.values())

    def stop(self):
        self._is_over.set()
        self._thread.join()


def own():
    """The processes of this run."""
    for process in psutil.process_iter():
        with contextlib.suppress(psutil.Error):
            if process.environ().get("RAY_AUTH_TOKEN") == os.environ["RAY_AUTH_TOKEN"]:
                yield process


def servers():
    return [process.pid for process in own() if process.name() == "plantd"]


def free_port():
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        return one.getsockname()[1]


def node(folder, number, head):
    command = [Path(sys.executable).with_name("ray"), "start", "--block", "--num-cpus=1", "--node-ip-address=127.0.0.1"]
    command += ["--object-store-memory=100000000", "--disable-usage-stats"]
    if number:
        command += [f"--address=127.0.0.1:{head}"]
    else:
        command += ["--head", f"--port={head}", "--include-dashboard=false", f"--temp-dir={folder / 'ray'}"]
    with (folder / f"node-{number}").open("w") as log:
        return subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=log, stderr=log, start_new_session=True)


@contextlib.contextmanager
def cluster(folder):
    head = free_port()
    nodes = []
    try:
        nodes.append(node(folder, 0, head))
        wait_for(lambda: is_listening(head), nodes)
        nodes += [node(folder, number, head) for number in range(1, NODES)]
        ray.init(address=f"127.0.0.1:{head}", _node_ip_address="127.0.0.1", log_to_driver=False)
        try:
            wait_for(lambda: alive() == NODES, nodes)
            yield nodes
        finally:
            ray.shutdown()
    finally:
        left = [process for one in nodes for process in tree(one.pid)]
        for one in nodes:
            one.terminate()
        psutil.wait_procs(left, timeout=10)
        for process in left:
            with contextlib.suppress(psutil.Error):
                process.kill()
        for one in nodes:
            one.wait()


def alive():
    return sum(one["Alive"] for one in ray.nodes())


def is_listening(port):
    with socket.socket() as one:
        return one.connect_ex(("127.0.0.1", port)) == 0


def wait_for(condition, nodes):
    deadline = time.monotonic() + PATIENCE
    while not condition():
        assert all(one.poll() is None for one in nodes), "a node has ended"
        assert time.monotonic() < deadline, "the cluster is not ready"
        time.sleep(0.05)


def tree(pid):
    try:
        process = psutil.Process(pid)
        return [process, *process.children(recursive=True)]
    except psutil.NoSuchProcess:
        return []


def kill_node(one):
    """All of a node but the servers, which find out for themselves; the number of them that there were."""
    processes = tree(one.pid)
    left = [process for process in processes if process.name() == "plantd"]
    for process in processes:
        if process not in left:
            with contextlib.suppress(psutil.Error):
                process.send_signal(signal.SIGKILL)
    return len(left)


def cases(count):
    for k in range(count):
        yield batch.case(q=[0.001 * k, math.sin(k)], velocity=[0.0, 0.0003 * k])


def noted(file):
    """`batch.run` for a node's worker, with a line in a file of each piece that it begins."""

    def run(piece):
        with file.open("a") as begun:
            begun.write(f"{piece.first}\n")
        return batch.run(piece)

    return run


def digest(done):
    done.raise_errors()
    return hashlib.sha256(done.x.tobytes()).hexdigest()


def main():
    count, steps = map(int, sys.argv[1:])
    common = batch.case([[0.3]], steps=steps - 1)
    times = Times()
    told = {"cases": count, "size": SIZE}

    def measured(name, over, given):
        before, of_all, begun = times.of_servers(), times.of_all(), time.monotonic()
        done = batch.rollout("cart-pole", given, over, size=SIZE, common=common)
        told[name] = {
            "digest": digest(done),
            "servers_s": times.of_servers() - before,
            "all_s": times.of_all() - of_all,
            "wall_s": time.monotonic() - begun,
        }

    measured("one", None, cases(count))
    for key in list(batch._servers):
        batch._servers.pop(key).close()

    with tempfile.TemporaryDirectory() as folder, cluster(Path(folder)) as nodes:
        # Workers and their servers are started, one on each node.
        while len(servers()) < NODES:
            batch.rollout("cart-pole", cases(2 * NODES), ray, size=1, common=common)
        at = count * 3 // 10 + batch._WAITING * NODES * SIZE
        assert at < count

        def killing():
            for k, one in enumerate(cases(count)):
                if k == at:
                    # What is not waiting any more is done.
                    times.look()
                    told["servers_of_lost_node"] = kill_node(nodes[1])
                yield one

        # Workers import the module for themselves: what they call is its own `run`.
        begun = Path(folder) / "begun"
        batch.run, run = noted(begun), batch.run
        measured("nodes", ray, killing())
        batch.run = run
        firsts = begun.read_text().split()
        told["pieces"], told["pieces_again"] = len(set(firsts)), len(firsts) - len(set(firsts))
        told["most_under_way"] = batch._WAITING * NODES
        # It takes Ray a while to believe it, longer than a short batch.
        deadline = time.monotonic() + PATIENCE
        while alive() == NODES and time.monotonic() < deadline:
            time.sleep(0.05)
        told["alive"] = alive()
    deadline = time.monotonic() + PATIENCE
    while servers() and time.monotonic() < deadline:
        time.sleep(0.05)
    told["servers_left"] = servers()
    told["processes_left"] = [process.name() for process in own() if process.pid != os.getpid()]
    times.stop()
    print(json.dumps(told))


if __name__ == "__main__":
    main()
