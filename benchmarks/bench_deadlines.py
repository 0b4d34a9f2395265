"""Whether 120 Hz are kept: ``python benchmarks/bench_deadlines.py [--minutes 10] [--save]``.

Flies the simulated vehicle in real time as ``fip fly --real-time`` does (failsafe, command sender, recorder, view, the
GA beside it), notes every tick, and says for each one missed whether our own code was the cause or
the machine. A process on each core that wakes at the same rate and does nothing shows how late the machine itself is.

A tick is due when its frame of motion capture is to be delivered, and missed if its command has not left one tick
later. It is put down to the machine only if it would have been met without the time that the machine took: time in
which a core stood still, or in which we were ready to run while it ran somebody else. Where our own processes were busy
at that moment, the doubt is decided against us.

Ctrl-C lands, and what was flown until then is reported and saved. Runs on Linux. Simulated: no vehicle has flown.
"""

import argparse
import csv
import dataclasses
import fcntl
import gc
import math
import multiprocessing
import os
import resource
import struct
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from multiprocessing.connection import Connection
from pathlib import Path
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from fiplib.flight import command
from fiplib.flight.failsafe import Guard
from fiplib.flight.limits import Limits
from fiplib.flight.links.simulated import SimulatedLink
from fiplib.flight.loop import FlightLoop
from fiplib.flight.sender import START_TIME, ignore_the_terminal
from fiplib.flight.session import Session
from fiplib.flight.setpoint import Setpoint
from fiplib.mpc import Solution
from fiplib.params import NANO, FipError
from fiplib.pilot import Pilot, Tick
from fiplib.recording import Measurement
from fiplib.simulate import SCENARIOS, Scenario

SAVED = Path(__file__).parent / "deadlines.csv"
"""What the figure fig13-deadlines reads. Committed, since times differ from run to run and figures should not."""
EDGES = np.geomspace(1.0, 1e6, 61)
"""Upper edges of the bins of the saved distributions, us: ten to a decade, the last one open."""
OWN = ("garbage collection", "solver", "logging and hand-over", "view", "vehicle", "sender", "recorder", "estimator")
"""The parts of our own code that may be the cause of a missed tick."""
SIOCGSTAMPNS = 0x8907
"""Linux: asks a socket when the packet that was read last came; over the loopback interface, when it was sent."""
ATTEMPTS = 10
"""Flights at most: one that the machine has ended is followed by another, until the time asked for is full."""

TICK = np.dtype(
    [
        (name, np.int64)
        for name in (
            *(
                "due",
                "sent",
                "taken",
                "out",
            ),  # the frame due, sent by the vehicle, taken by us; the command handed over
            *("solve", "answering"),  # the MPC's time; processor time from taken to out
            *("thread", "collecting", "waiting"),  # so far, of the thread that flies: processor, gc, ready but not run
            *("view", "vehicle", "vehicle_waiting", "sender", "recorder", "estimator"),  # so far
        )
    ]
)
"""What is noted of a tick, ns. Moments are those of the monotonic clock."""


class Missed(NamedTuple):
    """A tick that was missed. Times in ns.

    ``before`` and ``answered`` index the ticks: the last whose command had left when the trouble can have begun, and
    the one whose command came in place of this one's.
    """

    due: int
    out: int
    before: int
    answered: int


class Spent(NamedTuple):
    """Where the time of a missed tick went, ns.

    ``delay`` from due to command; ``stall`` in which a core stood still; ``waiting`` in which we could have run, but a
    core ran somebody else; ``own`` processor time of our parts; ``urgent``: real-time scheduling was allowed, so that
    what is not urgent holds nothing up, neither us nor those that saw the core stand still.
    """

    delay: int
    stall: int
    waiting: int
    own: Mapping[str, int]
    urgent: bool = True


# --- what was missed, and why: plain functions of what was noted


def missed(ticks: NDArray, tick: int) -> list[Missed]:
    """The ticks of one flight, a ``TICK`` each, that were answered later than one ``tick`` (ns), or not at all.

    A frame that comes much too late moves the ticks after it by half a period; that alone misses none.
    """
    found = []

    def since(moment: int, index: int) -> int:
        return max(0, int(np.searchsorted(out[:index], moment, side="right")) - 1)

    out, due = ticks["out"], ticks["due"]
    gaps = np.diff(due, prepend=due[:1] - tick)
    lost = np.maximum(np.rint(2.0 * gaps / tick).astype(int) // 2 - 1, 0)  # there are two frames to a tick
    for index in np.flatnonzero((out - due > tick) | (lost > 0)):
        # a frame that was taken late, yet in time, may cost the tick after it: look back as far as that
        earlier = since(int(due[max(0, index - 1)]), index)
        for late in range(lost[index], 0, -1):
            found.append(Missed(int(due[index]) - tick * late, int(out[index]), earlier, int(index)))
        if out[index] - due[index] > tick:
            found.append(Missed(int(due[index]), int(out[index]), since(int(due[index]), index), int(index)))
    return found


def spent(miss: Missed, ticks: NDArray, stalls: Sequence[NDArray], urgent: bool) -> Spent:
    """Where the time went between the two commands around a missed tick.

    Args:
        ticks: of the flight, ``TICK``.
        stalls: for each core (n, 2): when a process that does nothing was to wake, and when it did, ns.
        urgent: whether those processes go before ours.
    """
    first, last = ticks[miss.before], ticks[miss.answered]
    used = {name: max(0, int(last[name] - first[name])) for name in TICK.names[6:]}
    between = ticks[min(miss.before + 1, miss.answered) : miss.answered + 1]
    late_sent = max(0, int((between["sent"] - between["due"]).max()))
    answering = int(between["answering"].sum())
    own = {
        "garbage collection": used["collecting"],  # wherever it was: not counted again there
        "solver": max(0, answering - used["collecting"]),
        "logging and hand-over": max(0, used["thread"] - max(answering, used["collecting"])),
        "view": used["view"],
        "vehicle": min(used["vehicle"], late_sent),  # it holds nothing up but its own frames
        "sender": used["sender"],
        "recorder": used["recorder"],
        "estimator": used["estimator"],
    }
    window = int(first["out"]), miss.out
    still = [int(np.clip(np.minimum(core[:, 1], window[1]) - np.maximum(core[:, 0], window[0]), 0, None).sum())
             for core in stalls]  # fmt: skip
    waiting = used["waiting"] + min(used["vehicle_waiting"], late_sent)
    return Spent(miss.out - miss.due, max(still, default=0), waiting, own, urgent)


def cause(spent: Spent, tick: int) -> str:
    """What a tick (ns) was missed for: one of ``OWN``, "machine" or "unexplained".

    The machine's only if it would have been met without it.
    """
    # those that can keep us from running: with real-time scheduling only they, without it all that run beside us
    rivals = ("vehicle", "sender") if spent.urgent else ("vehicle", "sender", "recorder", "estimator")
    busy = sum(spent.own[name] for name in rivals)
    contested = min(spent.waiting, busy)
    stall = spent.stall if spent.urgent else max(0, spent.stall - busy)
    machine = max(stall, spent.waiting - contested)
    if spent.delay - machine <= tick:
        return "machine"
    own = {name: spent.own[name] for name in OWN if name not in ("sender", "recorder", "estimator")}
    rival = max(rivals, key=spent.own.__getitem__)
    own[rival] = max(own.get(rival, 0), contested)
    worst = max(own, key=own.__getitem__)
    return worst if own[worst] >= spent.delay - machine - sum(own.values()) else "unexplained"


def histogram(times: NDArray) -> NDArray:
    """How many of the times (ns) fall into each bin of ``EDGES``; what is longer than the last is in the last."""
    bins = np.searchsorted(EDGES, np.asarray(times) / 1e3, side="left")
    return np.bincount(np.minimum(bins, len(EDGES) - 1), minlength=len(EDGES))


def named(kind: str, counts: NDArray) -> dict[str, float]:
    """A distribution as rows of the table, named by upper edge: ``lateness_us_100``; empty bins are left out."""
    return {f"{kind}_us_{edge:.4g}": float(count) for edge, count in zip(EDGES, counts, strict=True) if count}


# --- notes in flight


class Counters:
    """Processor time and waiting time of our threads and processes, in ns since they began.

    Args:
        pids: of the flight's processes, by name; the thread that flies is the one that asks here.
    """

    def __init__(self, pids: Mapping[str, int]) -> None:
        # the clock of a process, as clock_getcpuclockid of the C library makes it
        self._clocks = {name: (~pid << 3) | 2 for name, pid in pids.items()}
        self._waits = {
            "pilot": os.open(f"/proc/self/task/{threading.get_native_id()}/schedstat", os.O_RDONLY),
            "vehicle": os.open(f"/proc/{pids['vehicle']}/schedstat", os.O_RDONLY),
        }
        view = [thread.native_id for thread in threading.enumerate() if thread.name == "fip-view"]
        self._view = os.open(f"/proc/self/task/{view[0]}/schedstat", os.O_RDONLY) if view else -1

    def processor(self, name: str) -> int:
        """Of a process; 0 if there is none."""
        try:
            return time.clock_gettime_ns(self._clocks[name])
        except (KeyError, OSError):
            return 0

    def waiting(self, name: str) -> int:
        """How long the "pilot" (the thread that flies) or the "vehicle" was ready to run, and was not."""
        return schedstat(self._waits[name])[1]

    def view(self) -> int:
        """Of the view's thread, running or waiting to: it holds the interpreter's lock in both."""
        return sum(schedstat(self._view)) if self._view >= 0 else 0

    def close(self) -> None:
        for descriptor in (*self._waits.values(), self._view):
            if descriptor >= 0:
                os.close(descriptor)


def schedstat(descriptor: int) -> tuple[int, int]:
    """Time on a processor and time waiting for one, ns, of a thread that may have ended."""
    try:
        ran, waited, _ = os.pread(descriptor, 96, 0).split()
    except (OSError, ValueError):
        return 0, 0
    return int(ran), int(waited)


def resident() -> int:
    """Memory of this process, bytes."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGESIZE")


class TimedPilot(Pilot):
    """The pilot that notes in ``took`` how long its last solve took, ns."""

    took = 0

    def solve(self, tick: Tick) -> Solution:
        began = time.monotonic_ns()
        try:
            return super().solve(tick)
        finally:
            self.took = time.monotonic_ns() - began


class WatchedLink(SimulatedLink):
    """``--link sim`` in real time that notes every tick of a flight with its ``pilot``.

    Attributes:
        grown: by how many bytes the process that flies has grown in the flight.
    """

    def __init__(self, scenario: Scenario, limits: Limits) -> None:
        super().__init__(scenario, limits)
        self.pilot = TimedPilot(scenario.params, scenario.reference)
        self.grown = 0
        rate = scenario.params.piloting.control_rate
        self._ticks = np.zeros(round(1.1 * rate * (scenario.duration + 30.0)), TICK)
        self._ticks["due"] = -1  # the memory is really there, and not fetched in flight
        self._count = 0
        self._latency = round(scenario.params.simulation.mocap_latency * NANO)
        self._counters: Counters | None = None
        self._arrived = self._due = self._sent = self._taken = self._thread = 0
        self._collecting = self._collection = 0

    @property
    def ticks(self) -> NDArray:
        """The ticks so far, ``TICK``."""
        return self._ticks[: self._count]

    def observe(self, loop: FlightLoop, session: Session) -> None:
        """After each step of the flight; the first says which processes it has."""
        if self._counters is None:
            self._counters = Counters(session.pids)

    def __enter__(self) -> Self:
        super().__enter__()
        gc.callbacks.append(self._collected)
        self._resident = resident()
        return self

    def __exit__(self, *raised: object) -> None:
        self.grown = resident() - self._resident
        gc.callbacks.remove(self._collected)
        super().__exit__(*raised)  # type: ignore[arg-type]
        if self._counters is not None:
            self._counters.close()

    def _collected(self, phase: str, info: dict) -> None:
        if phase == "start":
            self._collection = time.monotonic_ns()
        else:
            self._collecting += time.monotonic_ns() - self._collection

    def receive(self, timeout: float) -> tuple[int, Measurement] | None:
        came = super().receive(timeout)
        if came is not None:
            self._sent = self._when_sent()
            self._arrived, self._taken = came[0], came[0] - self.offset
            self._due, self._thread = came[1].stamp - self.offset + self._latency, time.thread_time_ns()
        return came

    def _when_sent(self) -> int:
        """When the last frame was sent, on the monotonic clock; 0 where the kernel does not say."""
        try:
            seconds, nanoseconds = struct.unpack("qq", fcntl.ioctl(self.frames, SIOCGSTAMPNS, bytes(16)))
        except OSError:
            return 0
        return time.monotonic_ns() - (time.time_ns() - seconds * NANO - nanoseconds)

    def send(self, setpoint: Setpoint) -> None:
        super().send(setpoint)
        answer, counters = setpoint.command, self._counters
        if answer is None or answer.stamp != self._arrived or counters is None or self._count == len(self._ticks):
            return  # no new one, or more than ten per cent more of them than there should be
        out, thread = time.monotonic_ns(), time.thread_time_ns()
        self._ticks[self._count] = (
            *(self._due, self._sent or self._taken, self._taken, out),
            *(self.pilot.took, thread - self._thread),
            *(thread, self._collecting, counters.waiting("pilot")),
            *(counters.view(), counters.processor("vehicle"), counters.waiting("vehicle")),
            *(counters.processor(name) for name in ("sender", "recorder", "estimator")),
        )
        self._count += 1


# --- the watch


class WatchError(Exception):
    """The machine cannot be watched; the message says why."""


class Watch:
    """A process on each core that wakes four times a tick and does nothing: how late the machine is by itself.

    Attributes:
        urgent: whether they go before everything of ours (real-time scheduling is allowed).
        lateness: (n,) counts by ``EDGES`` of all their wakings.
        stalls: for each core (n, 2): when it was to wake and when it did, ns, wherever that was ``LATE`` later.
        spent: their processor time, ns.
    """

    def __init__(self, tick: int) -> None:
        self.lateness, self.stalls, self.spent = np.zeros(len(EDGES), np.int64), [], 0
        context = multiprocessing.get_context("spawn")
        self._running = []
        for core in sorted(os.sched_getaffinity(0)):
            ours, theirs = context.Pipe()
            process = context.Process(target=_watch, args=(core, tick // 4, theirs), name="fip-watch", daemon=True)
            process.start()
            theirs.close()
            self._running.append((process, ours))
        try:
            self.urgent = all([self._started(pipe) for _, pipe in self._running])
        except BaseException:
            self.__exit__()
            raise

    @staticmethod
    def _started(pipe: Connection) -> bool:
        if not pipe.poll(START_TIME):
            raise WatchError(f"the process that watches a core has not started within {START_TIME:g} s")
        try:
            return pipe.recv()
        except EOFError:
            raise WatchError("the process that watches a core ended while starting") from None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *raised: object) -> None:
        for process, pipe in self._running:
            with suppress(OSError, EOFError):
                pipe.send("end")
                if pipe.poll(5.0):
                    counts, stalls, used = pipe.recv()
                    self.lateness += counts
                    self.stalls.append(stalls)
                    self.spent += used
            process.kill()
            process.join()


LATE = 500_000
"""ns after which a waking counts as a core that stood still."""


def _watch(core: int, period: int, pipe: Connection) -> None:
    ignore_the_terminal()
    os.sched_setaffinity(0, {core})
    urgent = True
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(4))
    except OSError:
        urgent = False
    gc.freeze()
    gc.disable()
    late, stalls = np.zeros(1 << 16, np.int64), []
    counts = np.zeros(len(EDGES), np.int64)
    with suppress(EOFError, OSError):
        pipe.send(urgent)
        began = time.process_time_ns()
        due, index = time.monotonic_ns(), 0
        while True:
            due += period
            while (left := due - time.monotonic_ns()) > 0:
                time.sleep(left / NANO)
            now = time.monotonic_ns()
            late[index] = now - due
            if now - due > LATE:
                stalls.append((due, now))
                due = now  # what a standstill has skipped is one lateness, not many
            if (index := index + 1) == len(late):
                counts, index = counts + histogram(late), 0
            if index % 64 == 0 and pipe.poll():
                break
        pipe.send(
            (
                counts + histogram(late[:index]),
                np.array(stalls, np.int64).reshape(-1, 2),
                time.process_time_ns() - began,
            )
        )


# --- the flight and its report


class Machine(NamedTuple):
    """What the machine had done by a moment: ns of all cores busy, stolen by a hypervisor; ours; switches; memory."""

    when: int
    busy: int
    stolen: int
    ours: int
    switches: int

    @classmethod
    def now(cls) -> Self:
        unit = NANO // os.sysconf("SC_CLK_TCK")
        user, nice, system, _, _, irq, soft, stolen = map(int, Path("/proc/stat").read_text().split()[1:9])
        own = resource.getrusage(resource.RUSAGE_SELF)
        over = resource.getrusage(resource.RUSAGE_CHILDREN)
        ours = sum(usage.ru_utime + usage.ru_stime for usage in (own, over))
        return cls(
            time.monotonic_ns(),
            (user + nice + system + irq + soft) * unit,
            stolen * unit,
            round(ours * NANO),
            own.ru_nivcsw,
        )


def report(
    flights: Sequence[NDArray], watch: Watch, before: Machine, after: Machine, tick: int, grown: int = 0
) -> dict[str, float]:
    """The quantities of the table, in order; the distributions last. ``grown``: bytes of memory in the last flight."""
    ticks = np.concatenate(flights)
    lateness, answers = ticks["taken"] - ticks["due"], ticks["out"] - ticks["taken"]
    found = Counter(
        cause(spent(miss, flight, watch.stalls, watch.urgent), tick)
        for flight in flights
        for miss in missed(flight, tick)
    )
    slips = sum(int((np.rint(2.0 * np.diff(flight["due"]) / tick) == 3).sum()) for flight in flights)
    span, cores = after.when - before.when, len(watch.stalls)
    lasted = sum(flight["due"][-1] - flight["due"][0] + tick for flight in flights)
    values: dict[str, float] = {
        "minutes": lasted / NANO / 60,
        "flights": len(flights),
        "ticks": len(ticks),
        "cores": cores,
        "real_time_scheduling": watch.urgent,
        "tick_us": tick / 1e3,
        "missed": sum(found.values()),
        "missed_ours": sum(found[name] for name in OWN),
        "missed_machine": found["machine"],
        "missed_unexplained": found["unexplained"],
        **{key(name): found[name] for name in OWN},
        "moved_by_half_a_tick": slips,
    }
    for name, times in (("lateness", lateness), ("solve", ticks["solve"]), ("answer", answers)):
        for percent in (50, 99, 99.9, 100):
            values[f"{name}_p{percent:g}_us"] = np.percentile(times, percent) / 1e3
    values |= {
        "estimator_share": sum(flight["estimator"][-1] - flight["estimator"][0] for flight in flights) / lasted,
        "watch_share": watch.spent / span,
        "collections_ms": sum(flight["collecting"][-1] - flight["collecting"][0] for flight in flights) / 1e6,
        "stalls_over_1_ms": sum(int((core[:, 1] - core[:, 0] > 1_000_000).sum()) for core in watch.stalls),
        "longest_stall_us": max((np.diff(core).max(initial=0) for core in watch.stalls), default=0) / 1e3,
        "stolen_ms": (after.stolen - before.stolen) / 1e6,
        "involuntary_switches": after.switches - before.switches,
        "busy_share": (after.busy - before.busy) / span / cores,
        "busy_share_of_others": max(0.0, after.busy - before.busy - (after.ours - before.ours)) / span / cores,
        "memory_grown_mb": grown / 1e6,
    }
    for kind, times in (("lateness", lateness), ("solve", ticks["solve"]), ("answer", answers)):
        values |= named(kind, histogram(times))
    return values | named("machine", watch.lateness)


def summary(values: Mapping[str, float]) -> str:
    """The quantities in words."""
    share = values["missed"] / values["ticks"]
    urgent = "real-time scheduling" if values["real_time_scheduling"] else "ordinary scheduling: real-time not allowed"
    causes = ", ".join(f"{values[key(name)]:.0f} {name}" for name in OWN if values[key(name)])
    rows = [f"{'us':26}{'p50':>10}{'p99':>10}{'p99.9':>10}{'worst':>10}"]
    for kind, words in (
        ("lateness", "frame taken after due"),
        ("solve", "MPC's solve"),
        ("answer", "taken to command"),
    ):
        rows.append(f"{words:26}" + "".join(f"{values[f'{kind}_p{p:g}_us']:10.0f}" for p in (50, 99, 99.9, 100)))
    return "\n".join(
        [
            f"simulated: {values['ticks']:.0f} ticks in {values['minutes']:.2f} min, "
            f"{values['flights']:.0f} flight(s), {values['cores']:.0f} cores, {urgent}",
            *rows,
            f"a tick is {values['tick_us']:.0f} us; missed {values['missed']:.0f} ({share:.4%}): "
            f"{values['missed_ours']:.0f} by our own code{causes and f' ({causes})'}, "
            f"{values['missed_machine']:.0f} by the machine, {values['missed_unexplained']:.0f} unexplained; "
            f"{values['moved_by_half_a_tick']:.0f} moved by half a tick",
            f"the machine: cores {values['busy_share']:.0%} busy, {values['busy_share_of_others']:.0%} by others, "
            f"one core {values['estimator_share']:.0%} by the estimator; "
            f"{values['stolen_ms']:.0f} ms stolen; a core stood still {values['stalls_over_1_ms']:.0f} times for more "
            f"than 1 ms, {values['longest_stall_us'] / 1e3:.1f} ms at the longest; we lost a processor "
            f"{values['involuntary_switches']:.0f} times; {values['collections_ms']:.0f} ms of garbage collection, "
            f"memory grew by {values['memory_grown_mb']:.0f} MB",
        ]
    )


def key(name: str) -> str:
    """The quantity that counts a cause."""
    return f"missed_{name.replace(' ', '_').replace('-', '_')}"


def save(values: Mapping[str, float], path: Path = SAVED) -> None:
    """Write the table: a quantity and its value in each row."""
    part = path.with_suffix(".new")
    with part.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["quantity", "value"])
        writer.writerows([name, f"{value:.6g}"] for name, value in values.items())
    part.replace(path)
    print(f"wrote {path}")


def run(minutes: float) -> tuple[dict[str, float], bool]:
    """Fly for so long; what is to be reported, empty if nothing has flown, and whether the operator ended it."""
    scenario = SCENARIOS["estimate-1.4"]
    rate = scenario.params.piloting.control_rate
    wanted, interrupted, grown = round(60.0 * minutes * rate), False, 0
    flights: list[NDArray] = []
    before, limits = Machine.now(), Limits()
    with Watch(round(NANO / rate)) as watch, tempfile.TemporaryDirectory() as folder:
        for attempt in range(ATTEMPTS):
            left = (wanted - sum(map(len, flights))) / rate
            if interrupted or (attempt and left < 1.0):
                break
            if attempt:
                print(f"the flight ended too early: another one, for the {left:.0f} s that are left", file=sys.stderr)
            flown = dataclasses.replace(scenario, duration=left)
            link = WatchedLink(flown, limits)
            session = Session(flown, limits, link, Path(folder) / f"flight-{attempt}", real_time=True)
            try:
                interrupted = command.fly(session, Guard(link.pilot, limits), link.observe) == 130
            except (FipError, OSError) as error:  # what has flown counts
                print(f"bench_deadlines.py: {error}", file=sys.stderr)
            flights.append(link.ticks)
            grown = link.grown
    flights = [ticks for ticks in flights if len(ticks)]
    after = Machine.now()
    return (report(flights, watch, before, after, round(NANO / rate), grown) if flights else {}), interrupted


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--minutes", type=float, default=10.0, help="how long to fly (default: %(default)g)")
    parser.add_argument(
        "--save", nargs="?", type=Path, const=SAVED, metavar="CSV", help="write the table (default: deadlines.csv here)"
    )
    options = parser.parse_args(arguments)
    if not 0.0 < options.minutes < math.inf:
        parser.error(f"--minutes {options.minutes:g}: give minutes > 0")
    if not sys.platform.startswith("linux"):
        parser.error("needs what Linux counts about processes: run it there")
    try:
        values, interrupted = run(options.minutes)
    except (KeyboardInterrupt, WatchError) as error:
        print(f"bench_deadlines.py: {error or 'interrupted before the flight'}", file=sys.stderr)
        return 130 if isinstance(error, KeyboardInterrupt) else 2
    if not values:
        print("bench_deadlines.py: nothing has flown", file=sys.stderr)
        return 1
    print(summary(values))
    if options.save:
        save(values, options.save)
    return 130 if interrupted else 0


if __name__ == "__main__":
    sys.exit(main())
