"""Servers as processes that tests kill, stop and start again."""

import json
import os
import signal
import socket
import subprocess
import threading
import time
from contextlib import contextmanager
from pathlib import Path

import plantd

#: Longest wait for a server to serve or to end, s.
PATIENCE = 60


class Process:
    """A server on a port of the loopback interface, which it takes again when it is started again."""

    def __init__(self, folder, name, *arguments):
        folder.mkdir(parents=True, exist_ok=True)
        self.folder, self.name, self.arguments = folder, name, arguments
        self.place = "127.0.0.1:0"
        self.process = None
        self.start()

    def start(self):
        ready, log = self.folder / "ready.json", self.folder / "log"
        ready.unlink(missing_ok=True)
        command = [os.environ["PLANTD_SERVER"], "serve", "--name", self.name, "--grpc", self.place, "--link", "off"]
        command += ["--worker-priority", "normal", "--ready-file", str(ready), "--until-stdin-ends"]
        with log.open("a") as output:
            # It ends with this process, too.
            self.process = subprocess.Popen(
                [*command, *self.arguments], stdin=subprocess.PIPE, stdout=output, stderr=output
            )
        deadline = time.monotonic() + PATIENCE
        while not ready.exists():
            assert self.process.poll() is None and time.monotonic() < deadline, log.read_text()
            time.sleep(0.01)
        self.address = json.loads(ready.read_text())["grpc"]
        self.place = self.address.removeprefix("http://")

    def cpu_s(self):
        """Processor time that it has used, s."""
        text = Path(f"/proc/{self.process.pid}/stat").read_text()
        user, system = text.rpartition(")")[2].split()[11:13]
        return (int(user) + int(system)) / os.sysconf("SC_CLK_TCK")

    def signal(self, number):
        self.process.send_signal(number)

    def hang(self):
        """Stops it for good or until SIGCONT, and waits until all its threads stand still."""
        self.signal(signal.SIGSTOP)
        deadline = time.monotonic() + PATIENCE
        tasks = Path(f"/proc/{self.process.pid}/task")
        while any(task.joinpath("stat").read_text().rpartition(")")[2].split()[0] != "T" for task in tasks.iterdir()):
            assert time.monotonic() < deadline

    def wait(self):
        self.process.wait(timeout=PATIENCE)

    def kill(self):
        self.signal(signal.SIGKILL)
        self.wait()

    def end(self):
        self.process.stdin.close()
        if self.process.poll() is None:
            self.process.kill()
            self.process.wait()


class Gateway:
    """Hands bytes to a server and back, until its connections are cut."""

    def __init__(self, place):
        host, port = place.rsplit(":", 1)
        self._server = (host, int(port))
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.address = f"http://127.0.0.1:{self._listener.getsockname()[1]}"
        self._sockets = []
        threading.Thread(target=self._accept, daemon=True).start()

    def _accept(self):
        while True:
            try:
                near, _ = self._listener.accept()
            except OSError:
                return
            far = socket.create_connection(self._server)
            self._sockets += [near, far]
            for here, there in [(near, far), (far, near)]:
                here.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                threading.Thread(target=self._hand_on, args=(here, there), daemon=True).start()

    @staticmethod
    def _hand_on(here, there):
        try:
            while data := here.recv(65536):
                there.sendall(data)
        except OSError:
            pass

    def cut(self):
        """Breaks all connections; what is on its way is lost."""
        broken, self._sockets = self._sockets, []
        for one in broken:
            try:
                one.shutdown(socket.SHUT_RDWR)
            except OSError:
                pass
            one.close()

    def close(self):
        self._listener.close()
        self.cut()


@contextmanager
def processes(folder, *names, arguments=("--drain-s", "0")):
    """Servers by their names, each with a client."""
    servers = []
    try:
        for name in names:
            servers.append(Process(folder / name, name, *arguments))
        for server in servers:
            server.client = plantd.connect(server.address)
        yield servers
    finally:
        for server in servers:
            if hasattr(server, "client"):
                server.client.close()
            server.end()
