"""The contents of any ROS 2 bag, whether it holds a flight or not: topics, rates, stamps, frames."""

from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fiplib.bags.decoding import store_of
from fiplib.bags.motion import arm, distance_of
from fiplib.bags.sources import Block, Source, Stored, opened
from fiplib.params import NANO
from fiplib.recording import BagError, Flight

_HEAVY = 16_384  # bytes of a message from which on its stamps are not looked at: pictures, clouds of points
_GAP = 5.0  # periods without a message that count as a gap


class Stamps(NamedTuple):
    """The stamps of one topic; times in s."""

    rate: float
    """Messages per s."""
    jitter: float
    """95 % of the steps from one stamp to the next differ from the median step by less."""
    gaps: int
    """Steps of more than five median steps."""
    longest: float
    """Longest step."""
    twice: int
    """Stamps that repeat the one before."""
    back: int
    """Stamps that lie before the one before."""
    late: tuple[float, float]
    """Log time minus stamp: the median, and the width of the middle 90 %."""
    frame: str
    """As the first message names it."""

    @classmethod
    def of(cls, stamp: NDArray, received: NDArray, frame: str) -> "Stamps":
        """Describe stamps and log times (n,) in ns, n > 1."""
        steps = np.diff(stamp) / NANO
        usual = float(np.median(steps))
        low, middle, high = np.quantile((received - stamp) / NANO, [0.05, 0.5, 0.95])
        span = float(stamp[-1] - stamp[0]) / NANO
        return cls(
            rate=len(steps) / span if span > 0.0 else 0.0,
            jitter=float(np.quantile(np.abs(steps - usual), 0.95)),
            gaps=int((steps > _GAP * usual).sum()) if usual > 0.0 else 0,
            longest=float(steps.max()),
            twice=int((steps == 0.0).sum()),
            back=int((steps < 0.0).sum()),
            late=(float(middle), float(high - low)),
            frame=frame,
        )


def survey(path: Path) -> str:
    """Return two tables of the topics of a bag: what they are, and how they are stamped. Raises BagError."""
    try:
        with opened(path) as source:
            found = _stamps(source)
            topics = dict(source.topics)
            rows = [("topic", "type", "messages")]
            rows += [(name, stored.type, str(stored.count)) for name, stored in sorted(topics.items())]
            return "\n".join([*_aligned(rows), "", *stamps_of(found)])
    except BagError:
        raise
    except Exception as error:  # the libraries raise a dozen kinds on damage
        raise BagError(f"{path}: cannot be surveyed ({' '.join(str(error).split())[:200]})") from error


def stamps(path: Path) -> list[str]:
    """Return the lines of a table of the stamps of a bag's topics."""
    with opened(path) as source:
        return stamps_of(_stamps(source))


def stamps_of(found: Mapping[str, Stamps]) -> list[str]:
    """Return the table of these topics."""
    head = ("stamps of", "Hz", "jitter ms", "gaps", "longest s", "twice", "back", "log - stamp s", "+-", "frame")
    rows = [head] + [
        (
            topic,
            f"{one.rate:.1f}",
            f"{1e3 * one.jitter:.2f}",
            str(one.gaps),
            f"{one.longest:.3f}",
            str(one.twice),
            str(one.back),
            f"{one.late[0]:.4g}",
            f"{one.late[1] / 2:.4f}",
            one.frame or "-",
        )
        for topic, one in sorted(found.items())
    ]
    return _aligned(rows)


def bodies(flight: Flight) -> list[str]:
    """Return what the two bodies say together: distance of their stamps, distance of their tracked points."""
    vehicle, rod = flight.vehicle, flight.pendulum
    after = np.clip(np.searchsorted(vehicle.stamp, rod.stamp), 1, max(len(vehicle.stamp) - 1, 1))
    if len(vehicle.stamp) < 2:
        return []
    apart = np.minimum(np.abs(vehicle.stamp[after] - rod.stamp), np.abs(rod.stamp - vehicle.stamp[after - 1])) / 1e6
    lines = [
        f"{'pairing':<10} a pose of the rod lies {np.median(apart):.3f} ms from the vehicle's next in time, "
        f"{apart.max():.3f} ms at most"
    ]
    reach = arm(vehicle, rod)
    lengths = np.linalg.norm(reach[np.isfinite(reach).all(axis=1)], axis=1)
    if len(lengths):
        distance, spread = distance_of(reach), float(np.subtract(*np.quantile(lengths, [0.95, 0.05]))) / 2
        lines.append(
            f"{'distance':<10} the tracked points are {distance:.4f} +- {spread:.4f} m apart: the rod is "
            f"{2 * distance:.3f} m long, if the vehicle is tracked at the seat and the rod at its middle"
        )
    return lines


def _stamps(source: Source) -> dict[str, Stamps]:
    wanted = {topic for topic, stored in source.topics.items() if stored.count > 1 and _has_header(stored)}
    found: dict[str, list[NDArray]] = {topic: [] for topic in wanted}
    frames: dict[str, str] = {}
    for block in source.blocks(wanted):
        if len(block.content) > _HEAVY * len(block.start) and int((block.end - block.start).max()) > _HEAVY:
            continue
        found[block.topic].append(np.stack([_header_stamps(block), block.received]))
        if block.topic not in frames:
            frames[block.topic] = _frame(block.message(0))
    joined = {topic: np.concatenate(parts, axis=1) for topic, parts in found.items() if parts}
    return {
        topic: Stamps.of(*both, frames[topic]) for topic, both in joined.items() if both.shape[1] > 1
    }  # fmt: skip


def _has_header(stored: Stored) -> bool:
    """Return whether messages begin with a header, by their definition."""
    store = store_of(stored)
    fields = store.fielddefs[stored.type][1] if store and stored.type in store.fielddefs else []
    return bool(fields) and fields[0][1][1] == "std_msgs/msg/Header"


def _header_stamps(block: Block) -> NDArray:
    """The stamps (n,) in ns of messages that begin with a header: seconds and nanoseconds after four bytes of CDR."""
    content = np.frombuffer(block.content, np.uint8)
    at = block.start[:, None] + np.arange(4, 12)
    little = content[block.start[0] + 1] == 1
    parts = np.ascontiguousarray(content[at]).view("<u4" if little else ">u4")
    return parts[:, 0].astype(np.int64) * NANO + parts[:, 1]


def _frame(message: bytes) -> str:
    size = int.from_bytes(message[12:16], "little" if message[1] == 1 else "big")
    return message[16 : 16 + max(size - 1, 0)][:64].decode(errors="replace")


def _aligned(rows: list[tuple[str, ...]]) -> list[str]:
    """Return the cells of a table in columns: words to the left, numbers to the right."""
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    numbers = [
        all(row[column][:1].isdigit() or row[column][:1] in "-+" for row in rows[1:]) for column in range(len(widths))
    ]
    return [
        "  ".join(
            cell.rjust(width) if number else cell.ljust(width)
            for cell, width, number in zip(row, widths, numbers, strict=True)
        ).rstrip()
        for row in rows
    ]
