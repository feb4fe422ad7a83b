"""A server of one's own: started here, ended with whoever started it."""

from __future__ import annotations

import importlib.metadata
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
import weakref
from collections.abc import Iterator, Sequence
from os import PathLike
from pathlib import Path

from ._client import Client
from ._errors import PlantdError

#: Longest wait for a server to serve, and for it to end.
_PATIENCE_SECONDS = 30.0
_LOG_SHOWN = 4096


class Server:
    """A ``plantd`` that this process has started on a Unix-domain socket in a temporary folder.

    It ends with `stop`, with this object, and with the process, however that ends: the server reads a
    pipe of which only this process holds the other end.
    """

    def __init__(self, program: Path, arguments: Sequence[str]):
        self._folder = tempfile.TemporaryDirectory(prefix="plantd-")
        folder = Path(self._folder.name)
        self._log, ready = folder / "log", folder / "ready.json"
        command = [str(program), "serve", "--grpc", "off", "--metrics", "off"]
        command += ["--worker-priority", "normal", "--shutdown-grace-s", "0.2", "--until-stdin-ends"]
        command += ["--unix", str(folder / "plantd.sock"), "--link-root", str(folder / "link")]
        command += ["--ready-file", str(ready), *arguments]
        # What is set for another server is not meant for this one.
        environment = {k: v for k, v in os.environ.items() if not k.startswith("PLANTD")}
        try:
            with self._log.open("w") as log:
                # In a group of its own: Ctrl-C is for this process, which goes on with its server.
                self._process = subprocess.Popen(
                    command,
                    env=environment,
                    stdin=subprocess.PIPE,
                    stdout=log,
                    stderr=log,
                    start_new_session=True,
                )
        except OSError as error:
            self._folder.cleanup()
            raise PlantdError("UNAVAILABLE", f"cannot start `{program}`: {error.strerror}") from None
        #: Stops the server; also called when the object is no longer used, and at exit.
        self._finalizer = weakref.finalize(self, _end, self._process, self._folder, os.getpid())
        addresses = self._wait_until_ready(ready)
        #: Its address, ``unix:/path``.
        self.address: str = addresses["unix"]
        #: Root of its shared-memory links, for `plantd.link`; None where there are none.
        self.link_root: str | None = addresses.get("link_root")
        #: Id of its process.
        self.pid: int = self._process.pid

    def _wait_until_ready(self, ready: Path) -> dict[str, str]:
        deadline = time.monotonic() + _PATIENCE_SECONDS
        while not ready.exists():
            if self._process.poll() is not None:
                # Waits for what it has written to be there.
                log = self.log().strip()
                self.stop()
                raise PlantdError("UNAVAILABLE", f"plantd has not started:\n{log}")
            if time.monotonic() > deadline:
                log = self.log().strip()
                self.stop()
                raise PlantdError(
                    "UNAVAILABLE", f"plantd is not ready after {_PATIENCE_SECONDS:g} s:\n{log}"
                )
            time.sleep(0.005)
        addresses: dict[str, str] = json.loads(ready.read_text())
        return addresses

    def log(self) -> str:
        """The end of what it has logged."""
        if not self._log.exists():
            return ""
        return self._log.read_bytes()[-_LOG_SHOWN:].decode(errors="replace")

    @property
    def is_running(self) -> bool:
        """It has not ended."""
        return self._process.poll() is None

    def stop(self) -> None:
        """Ends it, and waits until it has ended; its plants go with it."""
        self._finalizer()

    def __repr__(self) -> str:
        return f"<plantd server {self.pid} at {self.address}>"


def _end(process: subprocess.Popen[bytes], folder: tempfile.TemporaryDirectory[str], owner: int) -> None:
    # A process that was forked off this one leaves the server to it.
    if os.getpid() != owner:
        return
    try:
        if process.stdin is not None:
            process.stdin.close()
    except OSError:
        pass
    try:
        process.wait(timeout=_PATIENCE_SECONDS)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
    folder.cleanup()


def launch(
    program: str | PathLike[str] | None = None,
    *,
    arguments: Sequence[str] = (),
    timeout: float = 60.0,
) -> Client:
    """Starts a server of one's own and connects to it; ``client.server`` is the server.

        with plantd.launch() as client:
            ...

    The server ends when the client is closed or no longer used, and with this process, even if that is
    killed. ``program`` is the ``plantd`` to start; by default the one that the environment variable
    ``PLANTD`` names, or the one of this package's wheel, the one beside Python, or in ``PATH``. ``arguments`` are more
    of ``plantd serve``, such as ``["--limit", "plants=10"]``; ``timeout`` is that of `connect`.
    """
    if isinstance(arguments, str):
        raise TypeError(f"`arguments` is the text `{arguments}`; a list of texts is needed")
    server = Server(_find(program), list(arguments))
    try:
        client = Client(server.address, timeout=timeout)
    except BaseException:
        server.stop()
        raise
    client.server = server
    return client


def _find(program: str | PathLike[str] | None) -> Path:
    """The program to start; the error names the places where there is none."""
    for given, what in [(program, "`program`"), (os.environ.get("PLANTD"), "the variable PLANTD")]:
        if given:
            found = shutil.which(os.fspath(given))
            if found is None:
                message = f"{what} names `{os.fspath(given)}`, which is no program"
                raise PlantdError("UNAVAILABLE", message)
            return Path(found)
    for path in _places():
        if os.access(path, os.X_OK) and path.is_file():
            return path
    in_path = shutil.which("plantd")
    if in_path is not None:
        return Path(in_path)
    looked = ", ".join(f"`{place}`" for place in _places())
    raise PlantdError(
        "UNAVAILABLE",
        f"there is no program `plantd` in PATH, nor {looked}: install the package with it in "
        "it (`python3 client/python/wheel.py` makes one), or build it with `cargo build --release -p plantd-server` "
        "and give its path to `plantd.launch` or in the variable PLANTD",
    )


def _places() -> Iterator[Path]:
    try:
        installed = importlib.metadata.files("plantd")
    except importlib.metadata.PackageNotFoundError:
        installed = None
    # Where the wheel has put it, whatever the scheme of the installation.
    for file in installed or ():
        if file.name == "plantd" and not str(file).startswith("plantd"):
            yield Path(os.path.normpath(file.locate()))
    yield Path(sys.executable).parent / "plantd"
