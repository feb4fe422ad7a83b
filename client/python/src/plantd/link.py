"""A driver over shared memory, for processes on the server's machine.

    from plantd.link import LinkDriver

    with LinkDriver("pendulum") as driver:
        state = driver.state
        for _ in range(1000):
            state = driver.step(gain(state))

Needs the package ``iceoryx2`` (``pip install "plantd[link]"``): Linux on x86-64.
The layout and the conversation are described in ``client/c/plantd_link.h``.
"""

from __future__ import annotations

import contextlib
import ctypes
import fcntl
import os
import re
import secrets
import shutil
import stat
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import iceoryx2 as iox2
import numpy as np
import numpy.typing as npt

from ._arrays import Array, Vector, vector
from ._errors import PlantdError, StepError
from ._states import State, StepReport

if TYPE_CHECKING:
    from ._handle import PlantHandle

LAYOUT_VERSION = 5
MAGIC = int.from_bytes(b"plnt", "little")
POLL_FOREVER_NS = 2**64 - 1

ATTACH, INPUT, DETACH = 1, 2, 3
ATTACHED, STATE, FAILURE, CLOSED = 16, 17, 18, 19

(
    CODE_LAYOUT,
    CODE_KIND,
    CODE_LEASE_HELD,
    CODE_NOT_ATTACHED,
    CODE_SEQUENCE,
    CODE_DIMENSION,
    CODE_INPUT_NOT_FINITE,
    CODE_NOT_CONVERGED,
    CODE_NOT_FINITE,
    CODE_SINGULAR,
    CODE_PLANT_DELETED,
    CODE_LINK_CLOSED,
    CODE_TOO_FAST,
    CODE_SINGULAR_CONSTRAINTS,
    CODE_INCONSISTENT_CONSTRAINTS,
    CODE_WATCHDOG,
) = range(1, 17)

# In `code` of a state: the plant runs by itself, and the message answers no input.
LIVE, LIVE_INPUT_LATE, LIVE_INPUT_SAFE = 1 << 31, 1, 2

# Codes and reasons are those of gRPC; the message takes the header `h`.
_STEP_ERRORS = {
    CODE_SEQUENCE: ("ABORTED", "SEQUENCE", "an input was lost; number {h.detail_a} was expected"),
    CODE_DIMENSION: (
        "INVALID_ARGUMENT",
        "INPUT_DIMENSION",
        "the input has {h.detail_b} entries; {h.detail_a} are needed",
    ),
    CODE_INPUT_NOT_FINITE: (
        "INVALID_ARGUMENT",
        "INPUT_NOT_FINITE",
        "input {h.detail_a} is {h.detail_value}",
    ),
    CODE_NOT_CONVERGED: (
        "FAILED_PRECONDITION",
        "NOT_CONVERGED",
        "no convergence after {h.iterations} iterations: residual is {h.residual:g} times round-off",
    ),
    CODE_NOT_FINITE: (
        "FAILED_PRECONDITION",
        "MOTION_NOT_FINITE",
        "the motion left the finite numbers after {h.iterations} iterations",
    ),
    CODE_SINGULAR: (
        "FAILED_PRECONDITION",
        "SINGULAR",
        "singular Newton matrix at coordinate {h.detail_a} (relative pivot {h.detail_value:g})",
    ),
    CODE_TOO_FAST: (
        "FAILED_PRECONDITION",
        "TOO_FAST",
        "coordinate {h.detail_a} turned by {h.detail_value:.3f} rad in one step",
    ),
    CODE_SINGULAR_CONSTRAINTS: (
        "FAILED_PRECONDITION",
        "SINGULAR_CONSTRAINTS",
        "singular constraints: {h.detail_b} from equation {h.detail_a} on (reciprocal condition "
        "{h.detail_value:g})",
    ),
    CODE_WATCHDOG: (
        "FAILED_PRECONDITION",
        "WATCHDOG",
        "watchdog {h.detail_a} holds the plant: {guarded} is {h.detail_value:g}, beyond the bound "
        "{h.residual:g}; Run lets it go on, Reset and Restore put it elsewhere, SetSafety sets other bounds",
    ),
    CODE_INCONSISTENT_CONSTRAINTS: (
        "FAILED_PRECONDITION",
        "INCONSISTENT_CONSTRAINTS",
        "{h.detail_b} constraints, the first of them equation {h.detail_a}, contradict each other "
        "by {h.detail_value:g}",
    ),
}
_LINK_ERRORS = {
    CODE_NOT_ATTACHED: ("ABORTED", "LEASE_LOST", "the server has taken the lease back"),
    CODE_PLANT_DELETED: ("NOT_FOUND", "PLANT_DELETED", "the plant was deleted"),
    CODE_LINK_CLOSED: ("UNAVAILABLE", "LINK_CLOSED", "the server has closed the link"),
}
_HOLDERS = {1: "a call of Step", 2: "a Drive stream", 3: "a driver over shared memory"}
_INPUT_LEN_USUAL = 64
_CHECK_PERIOD_NS = 100_000_000
_ATTACH_PERIOD_NS = 50_000_000
_LOOK_PERIOD_S = 0.02
# Python has no memory barrier: a little before the server falls asleep it is notified as well.
_NOTIFY_MARGIN_NS = 10_000
_SHARED_MEMORY = Path("/dev/shm")
_NOTHING: Array = np.empty(0)


class Header(ctypes.Structure):
    """The header of every message."""

    _fields_ = [
        ("magic", ctypes.c_uint32),
        ("layout_version", ctypes.c_uint32),
        ("schema_hash", ctypes.c_uint64),
        ("server", ctypes.c_uint64),
        ("driver", ctypes.c_uint64),
        ("sequence", ctypes.c_uint64),
        ("step", ctypes.c_uint64),
        ("time_s", ctypes.c_double),
        ("time_step_s", ctypes.c_double),
        ("model_digest", ctypes.c_uint64),
        ("stamp_ns", ctypes.c_uint64),
        ("poll_ns", ctypes.c_uint64),
        ("process_start", ctypes.c_uint64),
        ("pid", ctypes.c_uint32),
        ("kind", ctypes.c_uint32),
        ("code", ctypes.c_uint32),
        ("dynamic", ctypes.c_uint32),
        ("prescribed", ctypes.c_uint32),
        ("inputs", ctypes.c_uint32),
        ("constraints", ctypes.c_uint32),
        ("iterations", ctypes.c_uint32),
        ("factorizations", ctypes.c_uint32),
        ("redundant_constraints", ctypes.c_uint32),
        ("steps", ctypes.c_uint32),
        ("halvings", ctypes.c_uint32),
        ("outputs", ctypes.c_uint32),
        ("output_channels", ctypes.c_uint32),
        ("residual", ctypes.c_double),
        ("constraint_residual", ctypes.c_double),
        ("reciprocal_condition", ctypes.c_double),
        ("constraint_reciprocal_condition", ctypes.c_double),
        ("detail_a", ctypes.c_uint64),
        ("detail_b", ctypes.c_uint64),
        ("detail_value", ctypes.c_double),
    ]

    @staticmethod
    def type_name() -> str:
        """Name under which the service knows the type."""
        return "PlantdLinkHeader5"


def _fnv1a(data: bytes) -> int:
    value = 0xCBF29CE484222325
    for byte in data:
        value = ((value ^ byte) * 0x100000001B3) & (2**64 - 1)
    return value


def _schema_hash() -> int:
    names = {ctypes.c_uint32: "u32", ctypes.c_uint64: "u64", ctypes.c_double: "f64"}
    header: Any = Header._fields_
    fields = (f"{n}:{names[t]}@{getattr(Header, n).offset};" for n, t in header)
    return _fnv1a("".join(fields).encode())


SCHEMA_HASH = _schema_hash()


class LinkError(PlantdError):
    """The link cannot be used, or can no longer be used; `reason` says why.

    ``NOT_OPEN``: the plant has no open link. ``LEASE_HELD``: somebody else drives it. ``TIMEOUT``: no
    answer in time; a step may still be taken. ``SERVER_GONE``, ``SERVER_RESTARTED``, ``LEASE_LOST``,
    ``LINK_CLOSED``, ``PLANT_DELETED``: this connection has ended, make a new one.
    ``ROOT_NOT_PRIVATE``, ``SEGMENT_NOT_PRIVATE``: files of the link are not this user's alone.
    """


def default_root() -> Path:
    """The server's default root path."""
    runtime = os.environ.get("XDG_RUNTIME_DIR", "")
    if os.path.isabs(runtime):
        return Path(runtime) / "plantd"
    return Path(f"/tmp/plantd-{os.getuid()}")


class LinkDriver:
    """A driver of one plant; holds its lease until it is closed."""

    def __init__(
        self,
        plant: str | PlantHandle,
        *,
        root: os.PathLike[str] | str | None = None,
        poll_s: float | None = 50e-6,
        timeout_s: float = 1.0,
        connect_timeout_s: float = 1.0,
    ) -> None:
        """Connects to a plant and takes its lease. Of a plant in hand, `Client.plant`, the link is opened, and
        the server says where it is; of one by its id it is open, below ``root``.

        A wait for an answer polls for ``poll_s`` (``None``: all the time), then sleeps.
        """
        if not isinstance(plant, str):
            root, plant = root or plant.open_link().root_path, plant.id
        self._plant = plant
        self._root = Path(root) if root is not None else default_root()
        self._poll_ns = POLL_FOREVER_NS if poll_s is None else round(poll_s * 1e9)
        self._timeout_s = timeout_s
        self._pid = os.getpid()
        self._process_start = _process_start(self._pid) or 0
        self._is_open = False
        deadline_ns = _after(connect_timeout_s)
        room = _INPUT_LEN_USUAL
        self._connect(room, deadline_ns)
        if self.input_len > room:
            self.close()
            self._connect(self.input_len, deadline_ns)

    def __enter__(self) -> LinkDriver:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def report(self) -> StepReport:
        """What the solver did in the last step."""
        h = self._last
        return StepReport(
            h.iterations,
            h.factorizations,
            h.residual,
            h.constraint_residual,
            h.reciprocal_condition,
            h.constraint_reciprocal_condition,
            h.redundant_constraints,
            h.steps,
            h.halvings,
        )

    @property
    def state(self) -> State:
        """The last state: of the last step, or of the time of the connection."""
        return self._state

    @property
    def y(self) -> Array:
        """What the output channels delivered after the last step; empty without channels."""
        return self._y

    @property
    def lost(self) -> npt.NDArray[np.bool_]:
        """For each output channel, whether its numbers stand for lost ones."""
        lost: npt.NDArray[np.bool_] = self._lost
        return lost

    @property
    def input_len(self) -> int:
        """Entries of an input: inputs, then prescribed coordinates."""
        return int(self._last.inputs + self._last.prescribed)

    @property
    def time_step_s(self) -> float:
        """Time step of the plant, seconds."""
        return float(self._last.time_step_s)

    def step(self, u: Vector = ()) -> State:
        """Takes one step with the input ``u`` (input forces, then next prescribed positions).

        Of a plant that runs by itself it waits for the latest state on which the input acted, so
        that the same loop drives both.

        Raises `StepError` if the step failed: the plant is where it was and the driver goes on.
        """
        if not self._is_open:
            raise _not_open("the driver is closed")
        self.offer(u)
        return self._wait_for_answer(_after(self._timeout_s))

    def offer(self, u: Vector) -> None:
        """Gives a plant that runs by itself an input, which acts from its next step on."""
        self._sequence += 1
        self._send(INPUT, vector(u), self._server_poll_end_ns)

    def close(self) -> None:
        """Gives the lease back and leaves the domain."""
        if not self._is_open:
            return
        self._is_open = False
        try:
            self._send(DETACH, _NOTHING, 0)
        finally:
            self._leave()

    def _connect(self, room: int, deadline_ns: int) -> None:
        self._driver = secrets.randbits(63) + 1
        self._server = 0
        self._server_pid = 0
        self._sequence = 0
        self._poll_end_ns = 0
        self._server_poll_end_ns = 0
        self._open_ports(room, deadline_ns)
        try:
            self._attach(deadline_ns)
        except BaseException:
            self._leave()
            raise
        self._is_open = True

    def _open_ports(self, room: int, deadline_ns: int) -> None:
        iox2.set_log_level_from_env_or(iox2.LogLevel.Fatal)
        while True:
            self._member: int | None = None
            try:
                self._enter()
                self._node = (
                    iox2.NodeBuilder.new()
                    .name(iox2.NodeName.new("plantd-driver-python"))
                    .config(self._config())
                    .signal_handling_mode(iox2.SignalHandlingMode.Disabled)
                    .create(iox2.ServiceType.Ipc)
                )
                inputs, input_bell = self._open_services("input")
                self._states, state_bell = self._open_services("state")
                self._listener = state_bell.listener_builder().create()
                self._subscriber = self._states.subscriber_builder().create()
                self._notifier = input_bell.notifier_builder().create()
                self._publisher = (
                    inputs.publisher_builder()
                    .initial_max_slice_len(room)
                    .max_loaned_samples(1)
                    .backpressure_strategy(iox2.BackpressureStrategy.DiscardData)
                    .create()
                )
                return
            except LinkError as error:
                self._leave_domain()
                if error.reason != "NOT_OPEN" or time.monotonic_ns() >= deadline_ns:
                    raise
                time.sleep(_LOOK_PERIOD_S)

    def _enter(self) -> None:
        """Finds the domain that the plant's link is in, becomes a member, and looks at its segments."""
        _check_private(self._root)
        link = _read_link(self._root, self._plant)
        if link is None or not link[1] or not _is_locked(self._root / link[0]):
            raise _not_open(f"plant `{self._plant}` has no open link under {self._root}")
        self._domain, segments = link
        path = self._root / self._domain / f"{_host_pid()}.member"
        try:
            while self._member is None:
                member = os.open(path, os.O_CREAT | os.O_RDWR | os.O_CLOEXEC, 0o600)
                fcntl.flock(member, fcntl.LOCK_SH)
                # It may have been removed between the two, as that of a process that has gone.
                if path.exists() and os.path.samestat(os.fstat(member), os.stat(path)):
                    self._member = member
                else:
                    os.close(member)
        except FileNotFoundError:
            raise _not_open(f"the server under {self._root} has ended") from None
        _check_segments(segments)

    def _prefix(self) -> str:
        """Start of the name of every file of the domain."""
        return f"plantd{LAYOUT_VERSION}_{self._domain}_"

    def _config(self) -> iox2.config.Config:
        config = iox2.config.default()
        config.global_cfg.root_path = iox2.Path.new(str(self._root / self._domain))
        config.global_cfg.prefix = iox2.FileName.new(self._prefix())
        # The server cleans up after dead drivers.
        config.global_cfg.node.cleanup_dead_nodes_on_creation = False
        config.global_cfg.node.cleanup_dead_nodes_on_destruction = False
        config.global_cfg.service.cleanup_dead_nodes_on_open = False
        return config

    def _open_services(self, direction: str) -> tuple[Any, ...]:
        name = iox2.ServiceName.new(f"plantd/{LAYOUT_VERSION}/{self._plant}/{direction}")
        demands = (
            iox2.AttributeVerifier.new()
            .require(_key("plantd.layout"), _value(str(LAYOUT_VERSION)))
            .require(_key("plantd.schema"), _value(f"{SCHEMA_HASH:016x}"))
        )
        try:
            channel = (
                self._node.service_builder(name)
                .publish_subscribe(iox2.Slice[ctypes.c_double])
                .user_header(Header)
                .open_with_attributes(demands)
            )
            bell = self._node.service_builder(name).event().open()
        except (iox2.PublishSubscribeOpenError, iox2.EventOpenError) as error:
            if "DoesNotExist" in str(error) or "MarkedForDestruction" in str(error):
                message = f"plant `{self._plant}` has no open link under {self._root}"
                raise _not_open(message) from error
            message = f"the link of plant `{self._plant}` cannot be opened: {error}"
            raise LinkError("UNAVAILABLE", message) from error
        return channel, bell

    def _leave(self) -> None:
        for port in (self._publisher, self._notifier, self._subscriber, self._listener):
            port.delete()
        del self._publisher, self._notifier, self._subscriber, self._listener
        del self._states, self._node
        self._leave_domain()

    def _leave_domain(self) -> None:
        """Ends the membership; the last one to leave a domain without server removes it."""
        if self._member is None:
            return
        os.close(self._member)
        self._member = None
        directory = self._root / self._domain
        with contextlib.suppress(OSError):
            root = os.open(self._root, os.O_RDONLY)
            try:
                fcntl.flock(root, fcntl.LOCK_EX)
                members = directory.glob("*.member")
                if not _is_locked(directory) and not any(map(_is_locked, members)):
                    for segment in _SHARED_MEMORY.glob(f"{self._prefix()}*"):
                        segment.unlink(missing_ok=True)
                    shutil.rmtree(directory)
            finally:
                os.close(root)

    def _send(self, kind: int, u: Array, peer_poll_end_ns: int) -> None:
        sample = self._publisher.loan_slice_uninit(len(u))
        ctypes.memmove(sample.payload().as_ptr(), u.ctypes.data, u.nbytes)
        now_ns = time.monotonic_ns()
        header = sample.user_header().contents
        ctypes.memset(ctypes.addressof(header), 0, ctypes.sizeof(header))
        header.magic = MAGIC
        header.layout_version = LAYOUT_VERSION
        header.schema_hash = SCHEMA_HASH
        header.server = self._server
        header.driver = self._driver
        header.sequence = self._sequence if kind == INPUT else 0
        header.stamp_ns = now_ns
        header.poll_ns = self._poll_ns
        header.process_start = self._process_start
        header.pid = self._pid
        header.kind = kind
        self._poll_end_ns = now_ns + self._poll_ns
        sample.assume_init().send()
        if time.monotonic_ns() + _NOTIFY_MARGIN_NS >= peer_poll_end_ns:
            self._notifier.notify()

    def _receive(self, deadline_ns: int) -> tuple[Header, Array] | None:
        """The next message, or nothing at the deadline: polls, then sleeps."""
        while True:
            now_ns = time.monotonic_ns()
            sample = self._subscriber.receive()
            if sample is not None:
                try:
                    header = Header.from_buffer_copy(sample.user_header().contents)
                    # The length of `sample.payload()` counts bytes in iceoryx2 0.10, not entries.
                    entries = ctypes.c_double * sample.header.number_of_elements
                    return header, np.array(entries.from_address(sample.payload_ptr))
                finally:
                    sample.delete()
            if now_ns >= deadline_ns:
                return None
            if now_ns >= self._poll_end_ns:
                self._listener.timed_wait(iox2.Duration.from_nanos(deadline_ns - now_ns))

    def _attach(self, deadline_ns: int) -> None:
        """Asks for the lease until the server answers."""
        while True:
            self._send(ATTACH, _NOTHING, 0)
            repeat_ns = min(time.monotonic_ns() + _ATTACH_PERIOD_NS, deadline_ns)
            while (message := self._receive(repeat_ns)) is not None:
                header, payload = message
                if header.schema_hash != SCHEMA_HASH:
                    raise LinkError("UNIMPLEMENTED", "the server speaks another layout")
                if header.driver != self._driver:
                    continue
                if header.kind != ATTACHED:
                    raise _error(header)
                self._server = header.server
                self._server_pid = header.pid
                self._note_state(header, payload)
                return
            if time.monotonic_ns() >= deadline_ns:
                raise _timeout("the server does not answer")

    def _wait_for_answer(self, deadline_ns: int) -> State:
        while True:
            check_ns = min(time.monotonic_ns() + _CHECK_PERIOD_NS, deadline_ns)
            while (message := self._receive(check_ns)) is not None:
                header, payload = message
                if header.server != self._server:
                    raise _restarted()
                if header.kind == CLOSED:
                    raise _error(header)
                if header.driver != self._driver or header.sequence != self._sequence:
                    continue
                if header.kind != STATE:
                    raise _error(header)
                return self._note_state(header, payload)
            self._check_server()
            if time.monotonic_ns() >= deadline_ns:
                raise _timeout(f"no answer from the server within {self._timeout_s} s")

    def _check_server(self) -> None:
        """Off the fast path: nothing has come for a while."""
        link = _read_link(self._root, self._plant)
        if link is not None and link[0] != self._domain:
            raise _restarted()
        is_dead = not _is_locked(self._root / self._domain)
        if is_dead or self._states.dynamic_config.number_of_publishers == 0:
            pid = self._server_pid
            raise LinkError("UNAVAILABLE", f"the server (process {pid}) is gone", "SERVER_GONE")

    def _note_state(self, header: Header, payload: Array) -> State:
        nd, nq = header.dynamic, header.dynamic + header.prescribed
        velocity = 2 * nq + header.constraints
        outputs = velocity + nq
        flags = outputs + header.outputs
        if len(payload) != flags + header.output_channels:
            raise LinkError("INTERNAL", "the server sent a state of the wrong length")
        self._last = header
        self._server_poll_end_ns = header.stamp_ns + header.poll_ns
        self._state = State(
            step=header.step,
            time=header.time_s,
            q=payload[:nq],
            p=payload[nq : nq + nd],
            v=payload[nq + nd : 2 * nq],
            multipliers=payload[2 * nq : velocity],
            time_step=header.time_step_s,
            velocity=payload[velocity:outputs],
        )
        self._y = payload[outputs:flags]
        self._lost = payload[flags:] != 0.0
        return self._state


def _key(text: str) -> iox2.AttributeKey:
    return iox2.AttributeKey.new(text)


def _value(text: str) -> iox2.AttributeValue:
    return iox2.AttributeValue.new(text)


def _after(seconds: float) -> int:
    return time.monotonic_ns() + round(seconds * 1e9)


def _process_start(pid: int) -> int | None:
    """Start time of a live process, clock ticks since boot."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return None
    return None if fields[0] in "ZXx" else int(fields[19])


def _host_pid() -> int:
    """Process id of this process in the outermost pid namespace that can be seen."""
    found = re.search(r"^NSpid:\s*(\d+)", Path("/proc/self/status").read_text(), re.MULTILINE)
    return int(found[1]) if found else os.getpid()


def _check_private(path: Path) -> None:
    """A directory that others can write to would let them put their files under our names."""
    try:
        status = path.lstat()
    except FileNotFoundError:
        raise _not_open(f"there is no server under {path}") from None
    if stat.S_ISLNK(status.st_mode):
        raise LinkError("FAILED_PRECONDITION", f"{path} is a symbolic link", "ROOT_NOT_PRIVATE")
    if not stat.S_ISDIR(status.st_mode) or status.st_uid != os.getuid() or status.st_mode & 0o077:
        message = f"{path} must belong to user {os.getuid()} and be closed to others (mode 0700)"
        raise LinkError("FAILED_PRECONDITION", message, "ROOT_NOT_PRIVATE")


def _check_segments(expected: dict[str, int]) -> None:
    """Segments of the link must be this user's alone, and as the server has made them."""
    for name, size in expected.items():
        path = _SHARED_MEMORY / name
        try:
            status = path.lstat()
        except FileNotFoundError:
            # What killed drivers have kept of a closed link may be listed as well, and goes in time.
            continue
        is_private = stat.S_ISREG(status.st_mode) and not status.st_mode & 0o077
        if not is_private or status.st_uid != os.getuid():
            message = f"{path} must belong to user {os.getuid()} and be closed to others (mode 0600)"
            raise LinkError("FAILED_PRECONDITION", message, "SEGMENT_NOT_PRIVATE")
        if status.st_size != size:
            found = status.st_size
            raise _not_open(f"{path} has {found} bytes, not the {size} that the server has given it")


def _read_link(root: Path, plant: str) -> tuple[str, dict[str, int]] | None:
    """The domain that a plant's link is in, and sizes of segments: none until the link is open."""
    try:
        domain, *lines = (root / f"{plant}.link").read_text().splitlines()
        if not re.fullmatch("[0-9a-f]{6}", domain):
            return None
        return domain, {name: int(size) for size, name in map(str.split, lines)}
    except (OSError, ValueError):
        return None


def _is_locked(path: Path) -> bool:
    """Whether a living process has locked a file or directory for itself or, of a member, shared."""
    try:
        file = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    except OSError:
        return False
    try:
        kind = fcntl.LOCK_SH if path.is_dir() else fcntl.LOCK_EX
        fcntl.flock(file, kind | fcntl.LOCK_NB)
    except OSError:
        return True
    finally:
        os.close(file)
    return False


def _restarted() -> LinkError:
    message = "the server has restarted, or has reopened the link"
    return LinkError("ABORTED", message, "SERVER_RESTARTED")


def _error(header: Header) -> PlantdError:
    """The error that a failure message speaks of."""
    if header.code in _STEP_ERRORS:
        code, reason, message = _STEP_ERRORS[header.code]
        return StepError(code, message.format(h=header, guarded=_guarded(header)), reason)
    if header.code in _LINK_ERRORS:
        code, reason, message = _LINK_ERRORS[header.code]
        return LinkError(code, message, reason)
    if header.code == CODE_LEASE_HELD:
        holder = _HOLDERS.get(header.detail_a, "somebody else")
        process = f" (process {header.detail_b})" if header.detail_b else ""
        message = f"the plant is driven by {holder}{process}"
        return LinkError("FAILED_PRECONDITION", message, "LEASE_HELD")
    return LinkError("INTERNAL", f"the server refused a message (code {header.code})")


def _guarded(header: Header) -> str:
    """What a watchdog looks at, as a failure says it; the link has no room for names."""
    if not header.detail_b:
        return "its quantity"
    kind, index = divmod(header.detail_b - 1, 1 << 32)
    names = [f"coordinate {index}", f"the velocity of coordinate {index}"]
    names += [f"the force of constraint equation {index}", "the energy"]
    return names[kind] if kind < len(names) else "its quantity"


def _not_open(message: str) -> LinkError:
    return LinkError("NOT_FOUND", message, "NOT_OPEN")


def _timeout(message: str) -> LinkError:
    return LinkError("DEADLINE_EXCEEDED", message, "TIMEOUT")
