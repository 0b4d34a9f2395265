"""``--link ros2``: poses from ROS 2 topics, commands to one.

Two ``geometry_msgs/PoseStamped`` topics carry the bodies, and are read with the QoS of sensor data: best effort, which
matches every publisher, while a reliable subscription never matches a best-effort publisher. Commands leave as
``mavros_msgs/AttitudeTarget``, or as ``geometry_msgs/TwistStamped`` where MAVROS is not installed.

rclpy is imported on entering only. Flown over real DDS with a simulated vehicle, never with hardware; the
AttitudeTarget topic was never tried with a running MAVROS. See docs/ros2.md.
"""

import argparse
import functools
import importlib
import importlib.util
import math
import os
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from fiplib.bags.messages import IGNORE_ATTITUDE
from fiplib.flight.limits import Limits
from fiplib.flight.links import LinkError, PoseSource, RelayLink
from fiplib.flight.sender import urgent
from fiplib.flight.setpoint import Setpoint
from fiplib.params import NANO, STATE_NAMES, Params
from fiplib.pilot import Command
from fiplib.recording import ROLES, Event, Measurement
from fiplib.simulate import Scenario

PRESETS = {
    "fip": "/mocap/{}/pose",
    "vrpn": "/vrpn_mocap/{}/pose",
    "natnet": "/natnet_ros/{}/pose",
    "optitrack": "/{}/pose",
}
"""Topic of a body by driver: our bags' own, vrpn_mocap, natnet_ros2, mocap_optitrack."""
BODIES = ("vehicle", "pendulum")
COMMANDS = {"attitude": ("mavros_msgs.msg", "AttitudeTarget"), "twist": ("geometry_msgs.msg", "TwistStamped")}
"""Module and class of each kind of command message."""
LOOK = NANO // 4
"""The publishers of the poses are counted that often, ns."""
OURS = ("fip_pilot", "fip_sender")
"""The nodes that may publish commands: those of this flight."""
UNPAIRED = 16
"""Poses of one body that wait for the other's, at most."""


class Pairing:
    """Puts the poses of two bodies together by their stamps. Pure.

    Drivers may stamp each body by itself, some ten us apart; frames are 4.2 ms apart at 240 Hz. So two poses belong
    together when their stamps differ by at most ``tolerance`` ns, which is to be less than half a frame; of several
    the nearest. A pose whose partner is lost is dropped as soon as a later pair is complete.

    Attributes:
        nearest: least difference of stamps seen so far among poses that did not match, ns; ``None`` if there was none.
    """

    def __init__(self, tolerance: int) -> None:
        self.tolerance = tolerance
        self._waiting: tuple[deque[tuple[int, NDArray]], ...] = (deque(maxlen=UNPAIRED), deque(maxlen=UNPAIRED))
        self.nearest: int | None = None

    def take(self, body: int, stamp: int, pose: NDArray) -> Measurement | None:
        """A pose (7,) of body 0, the vehicle, or 1, the pendulum; the frame that it completes, stamped by the vehicle.

        Poses are taken as they are: damaged numbers and repeated stamps are for the failsafe to judge.
        """
        own, other = self._waiting[body], self._waiting[1 - body]
        gaps = [abs(stamp - waiting) for waiting, _ in other]
        if not gaps or min(gaps) > self.tolerance:
            self.nearest = min([*gaps, *(() if self.nearest is None else (self.nearest,))], default=None)
            own.append((stamp, pose))
            return None
        for _ in range(gaps.index(min(gaps)) + 1):
            partner = other.popleft()
        own.clear()  # each topic keeps its order: what is older than a pair has no partner any more
        (stamp, vehicle), (_, pendulum) = ((stamp, pose), partner) if body == 0 else (partner, (stamp, pose))
        return Measurement(stamp, vehicle[:3], vehicle[3:], pendulum[:3], pendulum[3:])


@contextmanager
def urgent_threads(level: int) -> Iterator[None]:
    """Real-time scheduling at a level from 1 for the threads that start meanwhile; where it is allowed (Linux)."""

    def threads() -> set[int]:
        with suppress(OSError):
            return {int(name) for name in os.listdir("/proc/self/task")}
        return set()

    before = threads()
    yield
    for thread in threads() - before:
        urgent(level, thread)


class Node:
    """A ROS 2 node with a context of its own, so that no other one's end takes it along.

    The middleware's threads are on the way of every pose and command: they are as urgent as those who wait for them.

    Raises:
        LinkError: ROS 2 is missing or does not start.
    """

    def __init__(self, name: str, level: int = 1) -> None:
        names = ("rclpy", "rclpy.executors", "rclpy.signals", "rclpy.qos", "geometry_msgs.msg", "sensor_msgs.msg")
        try:
            self._rclpy, executors, signals, self.qos, self.geometry, self.sensor = map(importlib.import_module, names)
        except ImportError as error:
            raise LinkError(
                f"--link ros2: ROS 2 is not there ({error}); run 'source /opt/ros/<distribution>/setup.bash' first, "
                "and start it with the Python version that ROS was built for (3.11 or later: ROS 2 Jazzy has 3.12)"
            ) from error
        try:
            with urgent_threads(level):
                self._open(name, executors, signals)
        except Exception as error:  # whatever rclpy raises
            raise LinkError(f"--link ros2: ROS 2 does not start ({type(error).__name__}: {error})") from error

    def _open(self, name: str, executors: Any, signals: Any) -> None:
        # Fast DDS: shared memory left behind by a killed process can keep its successor from being found; UDP cannot
        os.environ.setdefault("FASTDDS_BUILTIN_TRANSPORTS", "UDPv4")
        # Ctrl-C lands the vehicle: ROS must not take the signal and close the topics
        self._context = self._rclpy.Context()
        self._rclpy.init(args=[], context=self._context, signal_handler_options=signals.SignalHandlerOptions.NO)
        self.node = self._rclpy.create_node(
            name, context=self._context, enable_rosout=False, start_parameter_services=False
        )
        self.executor = executors.SingleThreadedExecutor(context=self._context)
        self.executor.add_node(self.node)

    def publisher(self, kind: Any, topic: str, latched: bool = False) -> Any:
        """Reliable, for subscribers of either kind; only the newest message is kept, so that nothing ever waits."""
        policies = self.qos.DurabilityPolicy
        durability = policies.TRANSIENT_LOCAL if latched else policies.VOLATILE
        reliable = self.qos.ReliabilityPolicy.RELIABLE
        profile = self.qos.QoSProfile(depth=1, reliability=reliable, durability=durability)
        return self.node.create_publisher(kind, topic, profile)

    def close(self) -> None:
        with suppress(Exception):  # whatever rclpy raises when it is half gone
            self.executor.shutdown(timeout_sec=0.0)
            self.node.destroy_node()
        with suppress(Exception):
            self._rclpy.shutdown(context=self._context)


class Publisher:
    """Follows one publisher of a topic, whatever else is published there. Pure.

    Attributes:
        followed: the GID of the one whose messages are taken; ``None`` before the first, and where the middleware does
            not say it.
        foreign: how many messages of others were left out.
    """

    def __init__(self) -> None:
        self.followed: bytes | None = None
        self.foreign = 0

    def takes(self, gid: bytes | None) -> bool:
        """Return whether a message of this publisher is to be taken: those of the first that was heard are."""
        if self.followed is None:
            self.followed = gid
        if gid == self.followed:
            return True
        self.foreign += 1
        return False

    def look(self, gids: Sequence[bytes]) -> None:
        """Take the GIDs of all that publish now: one that has ended may be followed by another."""
        if self.followed is not None and gids and self.followed not in gids:
            self.followed = None


class Ros2Poses(PoseSource):
    """Frames from two PoseStamped topics; a context manager. No thread: topics are read within ``receive``.

    Of each topic one publisher is followed, the first that is heard. While there is a second one the vehicle is not
    armed; in flight its poses are left out. Poses in another frame than ``frame`` are ignored.

    Args:
        topics: of vehicle and pendulum.
        tolerance: largest difference of stamps within one frame, s.
        origin: "simulated" or "real", as the operator says.
        patience: longest wait for the first frame, s.
        frame: the ``frame_id`` that poses must carry.

    Attributes:
        frames: those that have come and were not yet received, with their arrivals.
    """

    def __init__(
        self, topics: tuple[str, str], tolerance: float, origin: str, patience: float, frame: str = "world"
    ) -> None:
        self.topics, self.origin, self._patience, self.frame = topics, origin, patience, frame
        self._publishers, self._elsewhere = (Publisher(), Publisher()), ""
        self._looked, self._said = 0, ""
        self.events: deque[Event] = deque()
        self._pairing = Pairing(round(tolerance * NANO))
        self.frames: deque[tuple[int, Measurement]] = deque()
        self._counts, self._paired = [0, 0], False
        self._offset = time.time_ns() - time.monotonic_ns()
        self._fault: str | None = None

    @staticmethod
    def arguments(parser: argparse._ArgumentGroup) -> None:
        """Add the options of the poses, for every link that takes them from ROS 2."""
        add = parser.add_argument
        origin = "whose poses; must be given. A simulated vehicle is armed at once, a real one by the Enter key"
        add("--ros2-origin", choices=("real", "simulated"), help=origin)
        topics = ", ".join(f"{name} {topic.format('BODY')}" for name, topic in PRESETS.items())
        mocap = f"topics named as this driver names them: {topics} (default: %(default)s)"
        add("--ros2-mocap", choices=PRESETS, default="fip", help=mocap)
        for body, name in zip(BODIES, ("quad", "pendulum"), strict=True):
            add(f"--ros2-{body}", default=name, metavar="BODY", help=f"the {body}'s name (default: %(default)s)")
            add(f"--ros2-{body}-topic", metavar="TOPIC", help=f"the {body}'s topic in full, instead of a driver's")
        pairing = "stamps of vehicle and pendulum that differ by less belong to one frame (default: %(default)g ms)"
        add("--ros2-pairing", type=float, default=2.0, metavar="MS", help=pairing)
        frame = "frame_id that poses must carry; z up in it (default: %(default)s)"
        add("--ros2-frame", default="world", metavar="FRAME", help=frame)
        patience = "how long to wait for poses and for a vehicle that listens (default: %(default)g s)"
        add("--ros2-wait", type=float, default=10.0, metavar="S", help=patience)

    @classmethod
    def from_options(cls, options: argparse.Namespace, scenario: Scenario) -> Self:
        """Raises ValueError for options that make no sense."""
        if options.ros2_origin is None:
            raise ValueError("--ros2-origin: say whether the poses are of a 'real' or a 'simulated' vehicle")
        half = 500.0 / scenario.params.piloting.mocap_rate
        if not 0.0 <= options.ros2_pairing < half:
            raise ValueError(
                f"--ros2-pairing {options.ros2_pairing:g}: give milliseconds from 0 to less than half a frame "
                f"({half:.3g} ms)"
            )
        if not 0.0 < options.ros2_wait < math.inf:
            raise ValueError(f"--ros2-wait {options.ros2_wait:g}: give seconds > 0")
        preset = PRESETS[options.ros2_mocap]
        vehicle = options.ros2_vehicle_topic or preset.format(options.ros2_vehicle)
        pendulum = options.ros2_pendulum_topic or preset.format(options.ros2_pendulum)
        if vehicle == pendulum:
            raise ValueError(f"vehicle and pendulum cannot share the topic {vehicle}")
        tolerance, patience = options.ros2_pairing / 1e3, options.ros2_wait
        return cls((vehicle, pendulum), tolerance, options.ros2_origin, patience, options.ros2_frame)

    def __enter__(self) -> Self:
        self.node = Node("fip_pilot")
        try:
            qos, kind = self.node.qos.qos_profile_sensor_data, self.node.geometry.PoseStamped
            for body, topic in enumerate(self.topics):
                take = self.taking(body)
                self.node.node.create_subscription(kind, topic, take, qos)
        except Exception as error:  # rclpy's: a topic's name may be no name
            self.node.close()
            raise LinkError(f"--link ros2: cannot subscribe to {' and '.join(self.topics)} ({error})") from error
        return self

    def __exit__(self, *_: object) -> None:
        SPARE.clear()  # it publishes from this node
        self.node.close()

    def wait(self, listeners: str | None = None) -> None:
        """Return when frames come and somebody subscribes to the topic ``listeners``. Raises LinkError.

        No other node may publish on ``listeners``: the vehicle would obey it.
        """
        end, heard = time.monotonic() + self._patience, False
        while time.monotonic() < end:
            heard = listeners is None or self.node.node.count_subscribers(listeners) > 0
            if self.receive(0.1) is not None and heard:
                break
        else:
            raise LinkError(f"--link ros2: {self._trouble() or f'nobody subscribes to {listeners}'}")
        if self.origin == "real" and (clues := [t for t in ("/clock", ROLES["truth_state"].topic) if self._has(t)]):
            raise LinkError(
                f"--link ros2: --ros2-origin real, but {clues[0]} is published, as by simulators: say 'simulated'"
            )

        if listeners and (others := [name for name, _ in self._publishing(listeners) if name not in OURS]):
            raise LinkError(f"--link ros2: {' and '.join(others)} publishes on {listeners}, too: stop it first")

    def now(self) -> int:
        return time.monotonic_ns() + self._offset

    def receive(self, timeout: float) -> tuple[int, Measurement] | None:
        end, left = time.monotonic() + timeout, max(0.0, timeout)
        while not self.frames and left >= 0.0:
            try:
                self.node.executor.spin_once(timeout_sec=left)
            except Exception as error:  # whatever rclpy raises
                self._fault = f"ROS 2 has failed ({type(error).__name__}: {error})"
                time.sleep(left)
                return None
            left = end - time.monotonic()
        return self.frames.popleft() if self.frames else None

    def fault(self) -> str | None:
        return self._fault

    def doubt(self) -> str | None:
        if (now := self.now()) - self._looked > LOOK:
            self._looked = now
            with suppress(Exception):  # whatever rclpy raises: it is seen where poses are read
                self._said = self._crowd(now)
        return self._said or self._elsewhere or None

    def _crowd(self, now: int) -> str:
        """Count the publishers of each topic; return who they are where there is more than one, else ""."""
        words = []
        for topic, publisher in zip(self.topics, self._publishers, strict=True):
            followed = publisher.followed
            if followed is not None or self.node.node.count_publishers(topic) > 1:
                publishing = self._publishing(topic)
                publisher.look([gid for _, gid in publishing])
                if len(publishing) > 1:
                    names = ", ".join(sorted(name for name, _ in publishing))
                    words.append(f"{len(publishing)} publishers on {topic} ({names})")
            if followed != publisher.followed:
                self.events.append(Event(now, "warn", f"{topic} is published by another node than before"))
        crowd = f"{' and '.join(words)}: stop all but one" if words else ""
        if crowd and not self._said:
            self.events.append(Event(now, "warn", f"{' and '.join(words)}: the first one heard is followed"))
        return crowd

    def _publishing(self, topic: str) -> list[tuple[str, bytes]]:
        """(node's name, GID) of all that publish on a topic."""
        return [
            (info.node_name, bytes(info.endpoint_gid)) for info in self.node.node.get_publishers_info_by_topic(topic)
        ]

    def taking(self, body: int) -> Callable[[Any, Any], None]:
        """Return the callback of a subscription; with two arguments, it is given each message's publisher."""

        def take(message: Any, info: Any) -> None:
            gid = (info.get("publisher_gid") or {}).get("data")  # ROS 2 before Kilted does not say it
            if self._publishers[body].takes(gid):
                self._take(body, message)

        return take

    def _take(self, body: int, message: Any) -> None:
        now, frame_id = self.now(), message.header.frame_id
        self._counts[body] += 1
        if frame_id != self.frame:
            self._elsewhere = (
                f"poses on {self.topics[body]} are given in the frame {frame_id!r}, not {self.frame!r} (--ros2-frame)"
            )
            return
        self._elsewhere = ""
        stamp, position, attitude = message.header.stamp, message.pose.position, message.pose.orientation
        numbers = (position.x, position.y, position.z, attitude.x, attitude.y, attitude.z, attitude.w)
        frame = self._pairing.take(body, stamp.sec * NANO + stamp.nanosec, np.array(numbers))
        if frame is not None:
            self._paired = True
            self.frames.append((now, frame))

    def _has(self, topic: str) -> bool:
        return self.node.node.count_publishers(topic) > 0

    def _trouble(self) -> str | None:
        """Why no frame has come, if so."""
        missing = [topic for topic, count in zip(self.topics, self._counts, strict=True) if not count]
        if missing:
            kind = "geometry_msgs/msg/PoseStamped"
            there = sorted(
                topic
                for topic, kinds in self.node.node.get_topic_names_and_types()
                if kind in kinds and topic not in self.topics and self._has(topic)
            )
            others = f"other PoseStamped topics: {', '.join(there)}" if there else "there is no other PoseStamped topic"
            return (
                f"no poses on {' and '.join(missing)} within {self._patience:g} s ({others}); see --ros2-mocap, and "
                "ROS_DOMAIN_ID"
            )
        if self._fault is not None or self._elsewhere:
            return self._fault or self._elsewhere
        if self._paired:
            return None
        gap = self._pairing.nearest
        nearest = "" if gap is None else f", the nearest are {gap / 1e6:.3g} ms apart"
        return (
            f"poses come on {' and '.join(self.topics)}, but their stamps never agree{nearest}; one clock must stamp "
            f"both (--ros2-pairing {self._pairing.tolerance / 1e6:g})"
        )


class Ros2Link(RelayLink):
    """Poses from ROS 2, commands to it; state and length are published beside them."""

    name = "ros2"
    poses: Ros2Poses

    def __init__(self, poses: Ros2Poses, kind: str | None, topic: str, params: Params, limits: Limits) -> None:
        self._kind = kind or ("attitude" if importlib.util.find_spec("mavros_msgs") else "twist")
        self._topic = topic
        super().__init__(poses, functools.partial(command_sink, self._kind, topic), params, limits)

    @staticmethod
    def arguments(parser: argparse._ArgumentGroup) -> None:
        Ros2Poses.arguments(parser)
        command = (
            "message of the commands: mavros_msgs/AttitudeTarget, or geometry_msgs/TwistStamped with body rates in "
            "angular and thrust in linear.z (default: attitude where mavros_msgs is installed)"
        )
        parser.add_argument("--ros2-command", choices=COMMANDS, help=command)
        topic = "topic of the commands (default: %(default)s; MAVROS listens to /mavros/setpoint_raw/attitude)"
        parser.add_argument("--ros2-command-topic", default=ROLES["command"].topic, metavar="TOPIC", help=topic)

    @classmethod
    def from_options(cls, options: argparse.Namespace, scenario: Scenario, limits: Limits) -> Self:
        poses = Ros2Poses.from_options(options, scenario)
        return cls(poses, options.ros2_command, options.ros2_command_topic, scenario.params, limits)

    def _wait(self) -> None:
        node = self.poses.node
        SPARE[self._kind, self._topic] = Ros2Sink(self._kind, self._topic, node)
        self._state = node.publisher(node.sensor.JointState, ROLES["state"].topic)
        self._state_message = node.sensor.JointState(name=list(STATE_NAMES))
        self._state_message.header.frame_id = ROLES["state"].frame
        self._length = node.publisher(node.geometry.PointStamped, ROLES["length"].topic, latched=True)
        self._published_length = math.nan
        self.poses.wait(self._topic)

    def send(self, setpoint: Setpoint) -> None:
        super().send(setpoint)
        if setpoint.command is not None:
            with suppress(Exception):  # what is shown must not disturb what is flown
                self._show(setpoint.command)

    def _show(self, command: Command) -> None:
        """State and length in use, for displays."""
        stamped(self._state_message.header, command.stamp)
        self._state_message.position = command.state.tolist()
        self._state.publish(self._state_message)
        if command.length != self._published_length:
            self._published_length = command.length
            message = self.poses.node.geometry.PointStamped()
            stamped(message.header, command.stamp)
            message.header.frame_id = ROLES["length"].frame
            message.point.x, message.point.y, message.point.z = command.length, math.nan, math.nan
            self._length.publish(message)


class Ros2Sink:
    """Setpoints onto a topic; opened in the sender's process, with a node of its own that nothing else can stall.

    Neither message can say "disarm": a disarmed setpoint is zero rates and zero thrust. Arming and the offboard mode
    are the operator's, as is the kill switch.

    Args:
        kind: of the message, a key of ``COMMANDS``.
        node: to publish from; by default one of its own.

    Raises:
        LinkError: ROS 2, or the message, is missing, or the topic has no proper name.
    """

    def __init__(self, kind: str, topic: str, node: Node | None = None) -> None:
        module, name = COMMANDS[kind]
        self._shared = node is not None
        self._node = node or Node("fip_sender", 3)
        try:
            message = getattr(importlib.import_module(module), name)
            self._publisher = self._node.publisher(message, topic)
        except ImportError as error:
            self.close()
            raise LinkError(f"--ros2-command {kind}: {module.partition('.')[0]} is not installed ({error})") from error
        except Exception as error:  # rclpy's: a topic's name may be no name
            self.close()
            raise LinkError(f"cannot publish commands on {topic} ({error})") from error
        self._message, self._fill = message(), fill_attitude if kind == "attitude" else fill_twist
        self._message.header.frame_id = ROLES["command"].frame

    def send(self, setpoint: Setpoint) -> None:
        stamped(self._message.header, time.time_ns())  # repeated ones too: a listener sees that the sender lives
        self._fill(self._message, setpoint)
        self._publisher.publish(self._message)

    def close(self) -> None:
        if not self._shared:
            self._node.close()


SPARE: dict[tuple[str, str], Ros2Sink] = {}
"""The pilot's own way out, should the sender's process die: its subscribers are found already, which may take longer
than the level-and-disarm frames last. Empty in the sender's process."""


def command_sink(kind: str, topic: str) -> Ros2Sink:
    """Return the spare sink of this process, or else a new one."""
    return SPARE.pop((kind, topic), None) or Ros2Sink(kind, topic)


def stamped(header: Any, stamp: int) -> None:
    """Put a time in ns into a header."""
    header.stamp.sec, header.stamp.nanosec = divmod(stamp, NANO)


def fill_attitude(message: Any, setpoint: Setpoint) -> None:
    """mavros_msgs/AttitudeTarget: body rates (x forward, y left, z up) and normalised thrust; the attitude ignored."""
    message.type_mask, message.orientation.w, rate = IGNORE_ATTITUDE, 1.0, message.body_rate
    rate.x, rate.y, rate.z = setpoint.body_rate.tolist()
    message.thrust = float(setpoint.thrust)


def fill_twist(message: Any, setpoint: Setpoint) -> None:
    """geometry_msgs/TwistStamped: body rates in ``angular``, normalised thrust in ``linear.z``."""
    rate = message.twist.angular
    rate.x, rate.y, rate.z = setpoint.body_rate.tolist()
    message.twist.linear.z = float(setpoint.thrust)
