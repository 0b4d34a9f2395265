"""Reading a bag into arrays, and its rivals: ``python -m benchmarks.bags``.

One recorded flight (simulated) is read whole, every topic of the contract, by ``fiplib.bags.read`` with all its checks,
by a loop over rosbags' ``AnyReader``, by ``mcap-ros2-support``, and by pandas from CSV files of the same numbers, one a
topic. Agreement is that of all numbers and stamps of all topics.
"""

import dataclasses
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.harness import FOLDER, Contender, Row, compare, main, needs, peak_memory, rate
from fiplib import bags
from fiplib.params import NANO
from fiplib.recording import ROLES, Flight, Poses
from fiplib.simulate import SCENARIOS, fly

TOPIC = "bags"
BAG = FOLDER.parent / "data" / "circle-0.8"
SIGNALS = ("vehicle", "pendulum", "state", "command", "reference", "truth_state")
"""The roles whose numbers are compared; lengths and events are a handful of messages."""


def table(signal: Any) -> NDArray:
    """A signal as one array (n, 1 + k): stamp in ns, then its numbers."""
    values = np.hstack([signal.position, signal.orientation]) if isinstance(signal, Poses) else signal.values
    return np.column_stack([signal.stamp - signal.stamp[0], values])


def tables(flight: Flight) -> NDArray:
    """All signals in one flat array, in the order of ``SIGNALS``."""
    return np.concatenate([table(getattr(flight, role)).ravel() for role in SIGNALS])


def stack(rows: dict[str, list[tuple[float, ...]]]) -> NDArray:
    """Rows of (stamp ns, numbers) by topic, as ``tables``."""
    found = []
    for role in SIGNALS:
        stamps = np.array([row[0] for row in rows[ROLES[role].topic]])
        values = np.array([row[1:] for row in rows[ROLES[role].topic]])
        found.append(np.column_stack([stamps - stamps[0], values]).ravel())
    return np.concatenate(found)


def row(kind: str, message: Any) -> tuple[float, ...]:
    """Stamp in ns and numbers of a decoded message, from rosbags or from mcap-ros2-support alike."""
    stamp = message.header.stamp
    now = stamp.sec * NANO + (stamp.nanosec if hasattr(stamp, "nanosec") else 0)
    if kind.endswith("PoseStamped"):
        p, q = message.pose.position, message.pose.orientation
        return now, p.x, p.y, p.z, q.x, q.y, q.z, q.w
    if kind.endswith("JointState"):
        return now, *message.position
    rate_ = message.body_rate
    return now, rate_.x, rate_.y, rate_.z, message.thrust


WANTED = {ROLES[role].topic: ROLES[role].type for role in SIGNALS}


def any_reader(bag: Path) -> Contender:
    """The loop that the documentation of rosbags shows."""
    highlevel, typesys = needs("rosbags.highlevel", "rosbags.typesys")
    store = typesys.get_typestore(typesys.Stores.LATEST)

    def call(_: None) -> dict[str, list[tuple[float, ...]]]:
        found: dict[str, list[tuple[float, ...]]] = {topic: [] for topic in WANTED}
        with highlevel.AnyReader([bag], default_typestore=store) as reader:
            connections = [connection for connection in reader.connections if connection.topic in WANTED]
            for connection, _, data in reader.messages(connections=connections):
                found[connection.topic].append(row(connection.msgtype, reader.deserialize(data, connection.msgtype)))
        return found

    return Contender(call, stack)


def mcap_ros2(bag: Path) -> Contender:
    """mcap-ros2-support's iterator."""
    (reader,) = needs("mcap_ros2.reader")
    [file] = bag.glob("*.mcap")

    def call(_: None) -> dict[str, list[tuple[float, ...]]]:
        found: dict[str, list[tuple[float, ...]]] = {topic: [] for topic in WANTED}
        for message in reader.read_ros2_messages(file, topics=list(WANTED)):
            found[message.channel.topic].append(row(message.schema.name, message.ros_msg))
        return found

    return Contender(call, stack)


def pandas(flight: Flight, folder: Path) -> Contender:
    """CSV files of the same numbers, exact to the last bit."""
    (module,) = needs("pandas")
    for role in SIGNALS:
        signal = getattr(flight, role)
        values = np.hstack([signal.position, signal.orientation]) if isinstance(signal, Poses) else signal.values
        frame = module.DataFrame(values, columns=ROLES[role].names)
        frame.insert(0, "stamp", signal.stamp)
        frame.to_csv(folder / f"{role}.csv", index=False)

    def call(_: None) -> list[tuple[NDArray, NDArray]]:
        found = []
        for role in SIGNALS:
            frame = module.read_csv(folder / f"{role}.csv", float_precision="round_trip")
            found.append((frame.pop("stamp").to_numpy(), frame.to_numpy()))
        return found

    def answer(found: list[tuple[NDArray, NDArray]]) -> NDArray:
        return np.concatenate([np.column_stack([s - s[0], values]).ravel() for s, values in found])

    return Contender(call, answer, remark="from CSV of the same, without checks")


def read_once(small: bool) -> None:
    """Read the bag, or one of half a second; memory is measured in a process of its own."""
    if not small:
        bags.read(BAG)
        return
    with tempfile.TemporaryDirectory() as folder:
        scenario = dataclasses.replace(SCENARIOS["circle-0.8"], duration=0.5)
        with bags.BagRecorder(Path(folder) / "bag", scenario.metadata()) as recorder:
            fly(scenario, recorder)
        bags.read(Path(folder) / "bag")


def size(flight: Flight) -> int:
    """Bytes of all arrays of a flight."""
    signals = [getattr(flight, role) for role in SIGNALS]
    arrays = [value for signal in signals for value in vars(signal).values() if isinstance(value, np.ndarray)]
    return sum(array.nbytes for array in arrays)


def measure(quick: bool) -> list[Row]:
    """Reading whole, and the peak of memory over the size of the arrays."""
    flight = bags.read(BAG)
    messages = sum(len(getattr(flight, role).stamp) for role in SIGNALS)
    with tempfile.TemporaryDirectory() as folder:
        rows = compare(
            TOPIC,
            "bag to arrays",
            Contender(lambda _: bags.read(BAG), tables, 0.0, f"{messages} messages, all checks"),
            {
                "rosbags AnyReader": lambda: any_reader(BAG),
                "mcap-ros2-support": lambda: mcap_ros2(BAG),
                "pandas": lambda: pandas(flight, Path(folder)),
            },
            [None] * (3 if quick else 15),
            budget=2.0 if quick else 20.0,
            checks=1,
            block=1,
        )
    remark = "peak of resident memory over the bytes of the arrays"
    return [*rows, rate(TOPIC, "memory, bag to arrays", "fip", peak_memory(read_once) * 2**20 / size(flight), remark)]


if __name__ == "__main__":
    main(TOPIC, measure, __doc__)
