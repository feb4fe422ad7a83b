"""Where a fleet of servers ends, and what losses cost it: a simulation from what one server takes.

    python3 deploy/capacity.py                                  # 100 servers, 100 000 plants
    python3 deploy/capacity.py --servers 3 --plants 3000 --through 0
    python3 deploy/capacity.py --sizes                          # fleets from one server to a thousand

What one server takes stands in capacity.json, which measure.py writes; what a fleet has is said by the options. Two
tables come out. The first has each resource in steady state: how much of it is needed of what there is, and with how
many plants on a server (for the gateways: in all) it would be full. The second has losses, one at a time, of the whole
fleet in simulated time: plants are placed in turn on servers that are ready, step, are saved, stand while their server
is away, and come back with what was saved. In it no plant and no step gets lost unnoticed: before and after each loss
all are counted (`Simulation.check`).

What it leaves out: other work of the servers (batches, searches, watchers), networks, and that a processor which is
nearly full is slow.
"""

import argparse
import heapq
import json
import math
import random
from collections import Counter
from dataclasses import dataclass, fields, replace
from pathlib import Path


@dataclass(frozen=True)
class Costs:
    """What one server takes for a plant, a step, a stream: seconds, processor seconds, bytes."""

    #: A server without plants, from its start until it serves.
    start_s: float
    restore_s: float
    record_bytes: float
    memory_empty_bytes: float
    memory_bytes: float
    create_cpu_s: float
    #: A plant that is saved: on its server, and of its processors.
    write_s: float
    write_cpu_s: float
    #: A look whether a plant has changed since it was saved.
    look_cpu_s: float
    health_cpu_s: float
    health_p50_s: float
    health_saving_p99_s: float
    stream_cpu_s: float
    stream_bytes: float
    step_cpu_s: float
    gateway_step_cpu_s: float


@dataclass(frozen=True)
class Fleet:
    """What there is, and what it is used for."""

    servers: int = 100
    plants: int = 100_000
    #: Of each server: processors, memory, the limit `plants`.
    cores: float = 2.0
    memory_bytes: float = 1 << 30
    limit: int = 1024
    #: Share of the plants that are driven, steps a second of each, and the share of those that go through gateways.
    driven: float = 0.1
    rate_hz: float = 100.0
    through: float = 0.1
    gateways: int = 2
    gateway_cores: float = 2.0
    interval_s: float = 2.0
    #: Records a second: of the volume of each server, or of one store for all of them, which outlives machines.
    store_rate: float = 3000.0
    is_store_shared: bool = False
    #: What one read or write waits for such a store, s; of a volume it is in what was measured.
    store_answer_s: float = 0.0
    #: Until somebody says that another server adopts the plants of a lost one, which takes a shared store, s; 0: nobody.
    adopt_s: float = 0.0
    #: Until a process is started again, and until a machine is given up, s.
    restart_s: float = 1.0
    machine_s: float = 300.0
    #: Pause of a driver before it looks for its plant again, s.
    pause_s: float = 0.5
    #: Plants that clients create in a second, all together, until all are there.
    create_rate: float = 5000.0


#: Records that a server reads or writes side by side.
SIDE_BY_SIDE = 16
#: Between two checks of a server by a gateway, and for which it waits for an answer, s.
CHECK_S, CHECK_TIMEOUT_S = 0.5, 1.0
#: For which Kubernetes waits until a server has started, and until it has ended after it has drained, s.
STARTUP_S, END_S = 120.0, 30.0


@dataclass(frozen=True)
class Need:
    """A resource: what is needed of what there is."""

    resource: str
    need: float
    have: float
    unit: str

    @property
    def share(self) -> float:
        return self.need / self.have if self.have else math.inf


def rate_of(fleet: Fleet, each_s: float) -> float:
    """Records that a server reads or writes in a second if the store has no other work."""
    answering = SIDE_BY_SIDE / fleet.store_answer_s if fleet.store_answer_s else math.inf
    return min(1 / max(each_s, 1e-9), answering)


def needs(fleet: Fleet, costs: Costs) -> list[Need]:
    """What a fleet in steady state needs, of the fullest server and of all gateways."""
    plants = math.ceil(fleet.plants / fleet.servers)
    driven = plants * fleet.driven
    changed, steps = driven, driven * fleet.rate_hz
    memory = costs.memory_empty_bytes + plants * costs.memory_bytes + driven * costs.stream_bytes
    looks = (plants * costs.look_cpu_s + changed * costs.write_cpu_s) / fleet.interval_s
    checks = fleet.gateways / CHECK_S
    processors = steps * costs.step_cpu_s + looks + checks * costs.health_cpu_s
    sharing = fleet.servers if fleet.is_store_shared else 1
    written = sharing * changed / fleet.interval_s
    at_once = min(rate_of(fleet, costs.write_s), fleet.store_rate / sharing)
    restored = min(rate_of(fleet, costs.restore_s), fleet.store_rate / sharing)
    found = [
        Need("limit `plants`", plants, fleet.limit, "plants"),
        Need("memory", memory / 2**20, fleet.memory_bytes / 2**20, "MiB"),
        Need("processors", processors, fleet.cores, "cores"),
        Need("saving", plants * costs.look_cpu_s + changed / at_once, fleet.interval_s, "s"),
        Need("store" if fleet.is_store_shared else "volume", written, fleet.store_rate, "records/s"),
        Need("start after all have ended", costs.start_s + plants / restored, STARTUP_S, "s"),
        Need("saving at the end", plants * costs.look_cpu_s + changed / at_once, END_S, "s"),
    ]
    if fleet.gateways:
        found.append(Need("health check while it saves", costs.health_saving_p99_s, CHECK_TIMEOUT_S, "s"))
        streams = fleet.plants * fleet.driven * fleet.through * fleet.rate_hz
        of_checks = fleet.gateways * fleet.servers / CHECK_S * costs.health_cpu_s
        has = fleet.gateways * fleet.gateway_cores
        found.append(Need("gateways", streams * costs.gateway_step_cpu_s + of_checks, has, "cores"))
    return found


def full_at(fleet: Fleet, costs: Costs, resource: str) -> float:
    """With how many plants on a server a resource is full; infinite where they do not matter."""

    def is_full(each: int) -> bool:
        larger = replace(fleet, plants=each * fleet.servers)
        return next(need for need in needs(larger, costs) if need.resource == resource).share > 1

    low, high = 0, 1
    while not is_full(high):
        low, high = high, 2 * high
        if high > 1 << 40:
            return math.inf
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if is_full(middle) else (middle, high)
    return low


class Store:
    """What writes and reads of all servers share: so many records a second, in equal parts, of which none takes more
    than its server can."""

    def __init__(self, rate: float, is_shared: bool):
        self.rate, self.is_shared = rate, is_shared
        self.is_there = True
        #: Records that are left, and the most that the server does in a second.
        self.jobs: dict[object, list[float]] = {}
        self.written = 0.0

    def rates(self) -> dict[object, float]:
        if not self.is_there:
            return dict.fromkeys(self.jobs, 0.0)
        if not self.is_shared:
            return {key: min(own, self.rate) for key, (_, own) in self.jobs.items()}
        found, left, number = {}, self.rate, len(self.jobs)
        for key, (_, own) in sorted(self.jobs.items(), key=lambda job: job[1][1]):
            found[key] = min(own, left / number)
            left, number = left - found[key], number - 1
        return found

    def next_end(self) -> tuple[float, object]:
        """In how long a job ends first, and which."""
        ends = [(self.jobs[key][0] / rate if rate else math.inf, key) for key, rate in self.rates().items()]
        return min(ends, key=lambda end: end[0], default=(math.inf, None))

    def advance(self, time: float) -> None:
        for key, rate in self.rates().items():
            self.jobs[key][0] = max(0.0, self.jobs[key][0] - rate * time)


class Server:
    """A server: its plants, and the steps of those that are driven."""

    def __init__(self) -> None:
        self.is_up = True
        #: Counts its lives: what was meant for an earlier one is void.
        self.life = 0
        self.plants: list[int] = []
        self.driven = 0
        #: Steps in its records; under way to them; in its memory alone.
        self.saved = self.under_way = self.unsaved = 0.0
        #: Up to when its steps are counted.
        self.counted = 0.0
        #: Plants that were read: they are written once more, although nobody drives them.
        self.anew = 0
        self.writing = 0.0
        #: Share of its drivers that stand.
        self.standing = 0.0


ON, WAITING, LOST, REFUSED = "on a server", "waiting for its server", "lost", "refused"


@dataclass(frozen=True)
class Adoption:
    """Plants of a lost server that another one reads, in one life of each."""

    lost: int
    life: int
    by: int
    life_of_adopter: int


class Simulation:
    """A fleet in time."""

    def __init__(self, fleet: Fleet, costs: Costs, seed: int = 1):
        self.fleet, self.costs = fleet, costs
        self.random = random.Random(seed)
        self.now = 0.0
        self.events: list[tuple[float, int, object]] = []
        self.number = 0
        self.store = Store(fleet.store_rate, fleet.is_store_shared)
        self.servers = [Server() for _ in range(fleet.servers)]
        self.is_driven = [self.random.random() < fleet.driven for _ in range(fleet.plants)]
        #: Of each plant that was asked for: its server, and what has become of it.
        self.home: list[int | None] = []
        self.became: list[str] = []
        self.turn = 0
        self.taken = self.lost_steps = 0.0
        self.most_waiting = 0
        self.waiting = 0
        #: When the last plant that waited was there again.
        self.whole_at = 0.0
        for k in range(fleet.servers):
            # Servers were not started at the same moment.
            self.at(self.random.random() * fleet.interval_s, self.pass_begins, k, 0)
        # In portions of a twentieth of a second.
        portion = max(1, round(fleet.create_rate / 20))
        for first in range(0, fleet.plants, portion):
            self.at(first / fleet.create_rate, self.place, min(portion, fleet.plants - first))
        self.placed_at = fleet.plants / fleet.create_rate

    def at(self, time: float, call, *arguments) -> None:
        self.number += 1
        heapq.heappush(self.events, (time, self.number, (call, arguments)))

    def run(self, until: float) -> None:
        while self.now < until:
            end, key = self.store.next_end()
            event = self.events[0][0] if self.events else math.inf
            time = min(until, event, self.now + end)
            self.store.advance(time - self.now)
            self.now = time
            if time == event and event <= self.now + end:
                _, _, (call, arguments) = heapq.heappop(self.events)
                call(*arguments)
            elif key is not None and end < math.inf and time < until:
                del self.store.jobs[key]
                self.job_ends(key)
        for server in self.servers:
            self.count(server)

    # Plants.

    def place(self, count: int) -> None:
        """New plants go to servers that are ready and not full, in turn."""
        for _ in range(count):
            plant = len(self.home)
            for _ in range(len(self.servers)):
                k = self.turn = (self.turn + 1) % len(self.servers)
                server = self.servers[k]
                if server.is_up and len(server.plants) < self.fleet.limit:
                    self.count(server)
                    server.plants.append(plant)
                    server.driven += self.is_driven[plant]
                    self.home.append(k)
                    self.became.append(ON)
                    break
            else:
                self.home.append(None)
                self.became.append(REFUSED)

    def count(self, server: Server) -> None:
        """Counts the steps that it has taken."""
        if server.is_up:
            steps = server.driven * (1 - server.standing) * self.fleet.rate_hz * (self.now - server.counted)
            self.taken += steps
            server.unsaved += steps
        server.counted = self.now

    # Saving.

    def pass_begins(self, k: int, life: int) -> None:
        server = self.servers[k]
        if server.life != life:
            return
        self.count(server)
        changed = min(len(server.plants), server.driven + server.anew)
        server.anew = 0
        server.under_way, server.unsaved = server.unsaved, 0.0
        server.writing = changed
        looking = len(server.plants) * self.costs.look_cpu_s
        self.at(self.now + looking, self.writing_begins, k, life)

    def writing_begins(self, k: int, life: int) -> None:
        server = self.servers[k]
        if server.life != life:
            return
        if server.writing:
            self.store.jobs[k] = [server.writing, rate_of(self.fleet, self.costs.write_s)]
        else:
            self.pass_ends(k)

    def pass_ends(self, k: int) -> None:
        server = self.servers[k]
        self.store.written += server.writing
        server.saved, server.under_way = server.saved + server.under_way, 0.0
        self.at(self.now + self.fleet.interval_s, self.pass_begins, k, server.life)

    def job_ends(self, key) -> None:
        if isinstance(key, Adoption):
            self.adopted(key)
            return
        k = key
        if self.servers[k].is_up:
            self.pass_ends(k)
        else:
            self.is_back(k)

    # Losses.

    def kill(self, k: int, away_s: float | None = None) -> None:
        """A process ends without a word; it is started again."""
        server = self.servers[k]
        self.count(server)
        if server.is_up:
            self.waiting += len(server.plants)
            self.most_waiting = max(self.most_waiting, self.waiting)
        server.is_up, server.life = False, server.life + 1
        self.store.jobs.pop(k, None)
        for adoption in [key for key in self.store.jobs if isinstance(key, Adoption) and key.by == k]:
            del self.store.jobs[adoption]
        self.lost_steps += server.unsaved + server.under_way
        server.unsaved = server.under_way = 0.0
        for plant in server.plants:
            self.became[plant] = WAITING
        away = self.fleet.restart_s if away_s is None else away_s
        self.at(self.now + away + self.costs.start_s, self.loads, k, server.life)

    def lose_machine(self, k: int) -> None:
        """The same, and it takes its time until somebody says so; the volume goes along, or another server adopts."""
        self.kill(k, self.fleet.machine_s)
        if self.fleet.is_store_shared and self.fleet.adopt_s:
            self.at(self.now + self.fleet.adopt_s, self.adopts, k, self.servers[k].life)

    def lose_disk(self, k: int) -> None:
        """A machine with its disk: the plants are gone, unless they are in a store elsewhere."""
        self.lose_machine(k)
        if self.fleet.is_store_shared:
            return
        server = self.servers[k]
        self.lost_steps += server.saved
        server.saved = 0.0
        for plant in server.plants:
            self.became[plant] = LOST
            self.home[plant] = None
        self.waiting -= len(server.plants)
        server.plants, server.driven = [], 0

    def adopts(self, k: int, life: int) -> None:
        """The server with the most room takes the plants of one that is away."""
        if self.servers[k].life != life or self.servers[k].is_up:
            return
        ready = [j for j, server in enumerate(self.servers) if server.is_up]
        if ready:
            j = min(ready, key=lambda j: len(self.servers[j].plants))
            plants = min(len(self.servers[k].plants), self.fleet.limit - len(self.servers[j].plants))
            if plants > 0:
                rate = rate_of(self.fleet, self.costs.restore_s)
                self.store.jobs[Adoption(k, life, j, self.servers[j].life)] = [plants, rate]

    def adopted(self, adoption: "Adoption") -> None:
        lost, adopter = self.servers[adoption.lost], self.servers[adoption.by]
        if (lost.life, adopter.life) != (adoption.life, adoption.life_of_adopter) or lost.is_up:
            # One of the two has started anew: the plants are the first one's, and read by it.
            return
        self.count(adopter)
        room = max(0, self.fleet.limit - len(adopter.plants))
        taken, lost.plants = lost.plants[:room], lost.plants[room:]
        driven = sum(self.is_driven[plant] for plant in taken)
        # What is saved of their steps goes along, as much for each that is driven.
        saved = lost.saved * driven / lost.driven if lost.driven else 0.0
        lost.saved, adopter.saved = lost.saved - saved, adopter.saved + saved
        lost.driven, adopter.driven = lost.driven - driven, adopter.driven + driven
        adopter.plants += taken
        adopter.anew += len(taken)
        for plant in taken:
            self.home[plant], self.became[plant] = adoption.by, ON
        self.waiting -= len(taken)
        self.whole_at = self.now

    def lose_gateway(self) -> None:
        """Its drivers stand until they have found the next one."""
        share = self.fleet.through / max(1, self.fleet.gateways)
        streams = self.fleet.plants * self.fleet.driven * share
        back = self.fleet.pause_s + streams * self.costs.stream_cpu_s / self.fleet.gateway_cores
        for server in self.servers:
            self.count(server)
            server.standing = share
        self.at(self.now + back, self.gateway_is_back)

    def gateway_is_back(self) -> None:
        for server in self.servers:
            self.count(server)
            server.standing = 0.0
        self.whole_at = self.now

    def lose_store(self, for_s: float) -> None:
        self.store.is_there = False
        self.at(self.now + for_s, self.store_is_back)

    def store_is_back(self) -> None:
        self.store.is_there = True

    def loads(self, k: int, life: int) -> None:
        server = self.servers[k]
        if server.life != life:
            return
        if server.plants:
            self.store.jobs[k] = [len(server.plants), rate_of(self.fleet, self.costs.restore_s)]
        else:
            self.is_back(k)

    def is_back(self, k: int) -> None:
        server = self.servers[k]
        # In a store for all each plant is written by whoever takes it.
        server.is_up, server.anew = True, len(server.plants) if self.fleet.is_store_shared else 0
        server.counted = self.now
        for plant in server.plants:
            self.became[plant] = ON
        if server.plants:
            self.waiting -= len(server.plants)
            self.whole_at = self.now
        self.at(self.now + self.fleet.interval_s, self.pass_begins, k, server.life)

    # Laws.

    def check(self) -> Counter:
        """Every plant that was asked for is on one server, or waits for one, or is counted as lost or refused; every
        step that was taken is held by a server, or is counted as lost. Else it raises `ArithmeticError`."""
        counts = Counter(self.became)
        seen: Counter = Counter()
        for k, server in enumerate(self.servers):
            if server.driven != sum(self.is_driven[plant] for plant in server.plants):
                raise ArithmeticError(f"server {k} drives {server.driven} plants that are not its own")
            for plant in server.plants:
                if self.home[plant] != k or self.became[plant] != (ON if server.is_up else WAITING):
                    raise ArithmeticError(f"plant {plant} is on server {k}, and {self.became[plant]}")
            seen.update(server.plants)
        if seen and max(seen.values()) > 1:
            raise ArithmeticError("a plant is on two servers")
        if len(seen) != counts[ON] + counts[WAITING] or self.waiting != counts[WAITING]:
            raise ArithmeticError(f"{len(seen)} plants are on servers, and they are {dict(counts)}")
        if sum(counts.values()) != len(self.home) or (not self.events and len(self.home) != self.fleet.plants):
            raise ArithmeticError(f"{len(self.home)} plants were asked for, and they are {dict(counts)}")
        held = sum(server.saved + server.under_way + server.unsaved for server in self.servers)
        if not math.isclose(self.taken, held + self.lost_steps, rel_tol=1e-9, abs_tol=1e-6):
            raise ArithmeticError(f"{self.taken} steps were taken, {held} are held, {self.lost_steps} lost")
        return counts


#: A name, and what happens to a fleet whose plants are there.
LOSSES = {
    "a process": lambda fleet: fleet.kill(0),
    "a machine": lambda fleet: fleet.lose_machine(0),
    "a machine with its disk": lambda fleet: fleet.lose_disk(0),
    "a gateway": lambda fleet: fleet.lose_gateway(),
    "the store for a minute, and a process meanwhile": lambda fleet: (
        fleet.lose_store(60.0),
        fleet.at(fleet.now + 30.0, fleet.kill, 0),
    ),
    "all processes at once": lambda fleet: [fleet.kill(k) for k in range(len(fleet.servers))],
}


@dataclass(frozen=True)
class Loss:
    """What a loss has cost."""

    what: str
    plants_away: int
    away_s: float
    steps_lost: float
    #: The most steps that one driven plant has lost.
    steps_lost_each: float
    plants_lost: int
    stood: float


def losses(fleet: Fleet, costs: Costs, seed: int = 1) -> list[Loss]:
    found = []
    for what, happens in LOSSES.items():
        if what == "a gateway" and not (fleet.gateways and fleet.through):
            continue
        simulation = Simulation(fleet, costs, seed)
        # Plants are placed, and passes have met.
        begun = simulation.placed_at + 5 * fleet.interval_s
        simulation.run(begun)
        simulation.check()
        driven = sum(server.driven for server in simulation.servers)
        taken = simulation.taken
        affected = simulation.servers if what == "all processes at once" else simulation.servers[:1]
        of_affected = sum(server.driven for server in affected)
        happens(simulation)
        simulation.check()
        after = begun + fleet.machine_s + 120.0
        simulation.run(after)
        counts = simulation.check()
        away = simulation.whole_at - begun if simulation.whole_at > begun else 0.0
        if what.startswith("the store"):
            # It was lost in the middle.
            away -= 30.0
        wanted = driven * fleet.rate_hz * (after - begun)
        stood = wanted - (simulation.taken - taken)
        lost = simulation.lost_steps
        each = lost / of_affected if of_affected and lost else 0.0
        found.append(Loss(what, simulation.most_waiting, away, lost, each, counts[LOST], stood))
    return found


def rounded(value: float) -> str:
    if value == 0:
        return "0"
    if value == math.inf:
        return "-"
    if abs(value) >= 100:
        return f"{value:,.0f}".replace(",", " ")
    return f"{value:.2g}" if abs(value) < 10 else f"{value:.0f}"


def table(heads: list[str], rows: list[list[str]]) -> str:
    widths = [max(len(row[i]) for row in [heads, *rows]) for i in range(len(heads))]
    rule = ["-" * widths[0], *("-" * (width - 1) + ":" for width in widths[1:])]

    def line(row):
        cells = [row[0].ljust(widths[0]), *(cell.rjust(width) for cell, width in zip(row[1:], widths[1:]))]
        return f"| {' | '.join(cells)} |"

    return "\n".join(map(line, [heads, rule, *rows]))


def ends(fleet: Fleet, costs: Costs) -> str:
    found = sorted(needs(fleet, costs), key=lambda need: -need.share)
    rows = []
    for need in found:
        full = full_at(fleet, costs, need.resource)
        rows.append(
            [
                need.resource,
                f"{rounded(need.need)} of {rounded(need.have)} {need.unit}",
                f"{100 * need.share:.0f} %",
                rounded(full if need.resource != "gateways" else full * fleet.servers),
            ]
        )
    return table(["resource", "needed", "used", "full at plants"], rows)


def costs_of(found: list[Loss]) -> str:
    rows = [
        [
            loss.what,
            rounded(loss.plants_away),
            "ever" if loss.plants_lost else f"{rounded(loss.away_s)} s",
            rounded(loss.steps_lost),
            rounded(loss.steps_lost_each),
            rounded(loss.plants_lost),
        ]
        for loss in found
    ]
    heads = ["lost", "plants away", "for", "steps lost", "of each driven", "plants lost"]
    return table(heads, rows)


#: Servers and plants of fleets that are compared.
SIZES = [(1, 1000), (3, 3000), (20, 20_000), (100, 100_000), (1000, 1_000_000)]


def of_sizes(fleet: Fleet, costs: Costs) -> str:
    rows = []
    for servers, plants in SIZES:
        # A single server has no gateway.
        sized = replace(fleet, servers=servers, plants=plants, gateways=fleet.gateways if servers > 1 else 0)
        found = sorted(needs(sized, costs), key=lambda need: -need.share)
        gateway = next((need.need for need in found if need.resource == "gateways"), 0.0)
        written = plants * fleet.driven / fleet.interval_s
        fullest = [f"{need.resource}, {100 * need.share:.0f} %" for need in found[:2]]
        rows.append([rounded(servers), rounded(plants), *fullest, rounded(gateway), rounded(written)])
    heads = ["servers", "plants", "fullest", "next", "cores of gateways", "records written a second"]
    return table(heads, rows)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--costs", type=Path, default=Path(__file__).with_name("capacity.json"), metavar="FILE")
    parser.add_argument("--seed", type=int, default=1, help="of the moments at which servers were started")
    for field in fields(Fleet):
        name = f"--{field.name.removeprefix('is_').replace('_', '-')}"
        if isinstance(field.default, bool):
            parser.add_argument(name, dest=field.name, action="store_true")
        else:
            parser.add_argument(name, dest=field.name, type=type(field.default), default=field.default, metavar="N")
    parser.add_argument("--sizes", action="store_true", help="fleets of other sizes that have the same else")
    given = vars(parser.parse_args())
    costs = Costs(**json.loads(given.pop("costs").read_text()))
    seed, are_sizes = given.pop("seed"), given.pop("sizes")
    fleet = Fleet(**given)
    if fleet.servers < 1 or fleet.plants < 1 or not 0 <= fleet.driven <= 1 or not 0 <= fleet.through <= 1:
        parser.error("there are servers and plants, and shares are from 0 to 1")
    if are_sizes:
        print(of_sizes(fleet, costs))
        return
    print(f"{fleet.servers} servers, {fleet.plants} plants, of which {100 * fleet.driven:g} % are driven\n")
    print(ends(fleet, costs), end="\n\n")
    print(costs_of(losses(fleet, costs, seed)))


if __name__ == "__main__":
    main()
