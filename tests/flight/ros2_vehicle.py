"""A simulated vehicle behind ROS 2 topics, in real time: for the tests, and to try ``--link ros2`` without hardware.

    python tests/flight/ros2_vehicle.py
    python scripts/fly.py --scenario estimate-1.4 --link ros2 --ros2-origin simulated

Publishes the poses of vehicle and pendulum and the true state, obeys TwistStamped commands, and holds the vehicle in
place until the first one with thrust. Ends when its standard input does (Ctrl-D), and prints what happened as JSON.
``--dds cyclonedds`` speaks through Eclipse Cyclone DDS alone, without ROS: an independent judge of names, types, bytes.
"""

import argparse
import ast
import dataclasses
import json
import math
import os
import select
import sys
import time
from collections.abc import Iterator
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from fiplib.flight.links.ros2 import urgent_threads
from fiplib.flight.links.simulated import HeldVehicle
from fiplib.flight.sender import urgent
from fiplib.flight.setpoint import Mode, Setpoint
from fiplib.params import NANO
from fiplib.recording import ROLES, Measurement
from fiplib.simulate import SCENARIOS, Scenario

BODIES = ("vehicle", "pendulum")


class Peer(Protocol):
    """A way into DDS; ``told`` is what else it has heard."""

    told: dict[str, float | int | None]

    def publish(self, frame: Measurement, truth: NDArray) -> None: ...

    def commands(self, timeout: float) -> Iterator[tuple[tuple[float, float, float], float]]:
        """Body rates in rad/s and normalised thrust of what has come within ``timeout`` s, or has waited."""
        ...

    def close(self) -> None: ...


class Ros:
    """Through rclpy."""

    def __init__(self, topics: dict[str, str], reliable: bool) -> None:
        import rclpy
        from geometry_msgs.msg import PointStamped, PoseStamped, TwistStamped
        from rclpy.executors import SingleThreadedExecutor
        from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy, qos_profile_sensor_data
        from sensor_msgs.msg import JointState

        rclpy.init(args=[])
        self._rclpy, self._message = rclpy, PoseStamped()
        self._node = rclpy.create_node("fip_simulated_vehicle")
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self._node)
        reliability = ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT
        qos = QoSProfile(depth=5, reliability=reliability)
        self._bodies = [self._node.create_publisher(PoseStamped, topics[body], qos) for body in BODIES]
        self._truth = self._node.create_publisher(JointState, ROLES["truth_state"].topic, qos_profile_sensor_data)
        self._state = JointState(name=list(ROLES["truth_state"].names))
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self.told = {"states": 0, "length": None}
        self._node.create_subscription(JointState, ROLES["state"].topic, self._see_state, qos_profile_sensor_data)
        self._node.create_subscription(PointStamped, ROLES["length"].topic, self._see_length, latched)
        self._heard: list[tuple[tuple[float, float, float], float]] = []
        self._node.create_subscription(TwistStamped, topics["command"], self._hear, qos_profile_sensor_data)

    def _see_state(self, message) -> None:
        self.told["states"] += list(message.name) == list(ROLES["state"].names) and len(message.position) == 10

    def _see_length(self, message) -> None:
        self.told["length"] = message.point.x

    def _hear(self, message) -> None:
        rate = message.twist.angular
        self._heard.append(((rate.x, rate.y, rate.z), message.twist.linear.z))

    def publish(self, frame: Measurement, truth: NDArray) -> None:
        message, numbers = self._message, np.concatenate(frame[1:]).reshape(2, 7).tolist()
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(frame.stamp, NANO)
        message.header.frame_id = "world"
        for publisher, (x, y, z, qx, qy, qz, qw) in zip(self._bodies, numbers, strict=True):
            position, attitude = message.pose.position, message.pose.orientation
            position.x, position.y, position.z = x, y, z
            attitude.x, attitude.y, attitude.z, attitude.w = qx, qy, qz, qw
            publisher.publish(message)
        self._state.header, self._state.position = message.header, truth.tolist()
        self._truth.publish(self._state)

    def commands(self, timeout: float) -> Iterator[tuple[tuple[float, float, float], float]]:
        self._executor.spin_once(timeout_sec=timeout)
        heard, self._heard = self._heard, []
        yield from heard

    def close(self) -> None:
        self._rclpy.shutdown()


def cyclone(topics: dict[str, str], reliable: bool) -> Peer:
    from tests.flight.ros2_cyclone import Cyclone

    return Cyclone(topics, reliable)


PEERS = {"rclpy": Ros, "cyclonedds": cyclone}


def fly(scenario: Scenario, peer: Peer) -> dict[str, float | int | None]:
    """Until standard input ends: a frame at every period, delivered after motion capture's latency.

    Returns:
        What happened: frames published; of these since let go; late by a frame or more in flight, and the worst, s;
        commands taken, refused (not finite, thrust outside [0, 1]), and without thrust after the first with; seconds of
        flight until the first such, and until rod or vehicle had fallen; greatest lean of both until then, m and rad.
        Through ROS also: states heard, and the newest length in use.
    """
    vehicle, params = HeldVehicle(scenario), scenario.params
    rate, simulation = params.piloting.mocap_rate, params.simulation
    latency = round(simulation.mocap_latency * NANO)
    late = commands = refused = disarms = 0
    fell = stopped = None
    most_tilt = most_lean = worst = 0.0
    offset = time.time_ns() - time.monotonic_ns()
    start, held, index, ended = time.monotonic_ns(), 0, 0, False
    while not ended:
        exposure = start + round(index * NANO / rate)
        while True:
            left = (exposure + latency - time.monotonic_ns()) / NANO
            for rates, thrust in peer.commands(max(0.0, left)):
                if not np.isfinite((*rates, thrust)).all() or not 0.0 <= thrust <= 1.0:
                    refused += 1
                    continue
                commands += 1
                if vehicle.flown is None:
                    held = exposure
                elif thrust == 0.0:
                    stopped = vehicle.flown / rate if stopped is None else stopped
                    disarms += 1
                # as links.sim: the plant's clock started when the vehicle was let go
                since = (time.monotonic_ns() - held) / NANO + simulation.rate_delay
                setpoint = Setpoint(0, thrust > 0.0, Mode.FLYING, np.array(rates), thrust)
                vehicle.command(setpoint, round(since * simulation.plant_rate))
            if left <= 0.0:
                break
        if vehicle.flown is not None and stopped is None:
            late += left < -1.0 / rate
            worst = max(worst, -left)
        peer.publish(vehicle.measure(exposure + offset), vehicle.plant.truth())
        vehicle.advance()
        if vehicle.flown is not None and fell is None:
            if vehicle.plant.fallen:
                fell = vehicle.flown / rate
            elif stopped is None:
                truth = vehicle.plant.truth()
                most_lean = max(most_lean, math.hypot(truth[4], truth[6]))
                most_tilt = max(most_tilt, math.hypot(truth[8], truth[9]))
        index += 1
        if index % 24 == 0 and select.select([sys.stdin], [], [], 0.0)[0]:
            ended = not os.read(sys.stdin.fileno(), 1024)
    return {
        **peer.told,
        "frames": index,
        "flown": vehicle.flown,
        "late": late,
        "worst": worst,
        "commands": commands,
        "refused": refused,
        "disarms": disarms,
        "fell": fell,
        "stopped": stopped,
        "most_lean": most_lean,
        "most_tilt": most_tilt,
    }


def main() -> None:
    description, _, rest = (__doc__ or "").partition("\n\n")
    parser = argparse.ArgumentParser(
        description=description, epilog=rest, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--scenario", default="estimate-1.4", choices=SCENARIOS, help="whose start and pushes")
    parser.add_argument("--set", action="append", default=[], metavar="GROUP.NAME=VALUE", help="as fly.py's")
    parser.add_argument("--dds", choices=PEERS, default="rclpy", help="which DDS to speak through")
    parser.add_argument("--reliable", action="store_true", help="publish poses reliably, not best effort")
    for name, role in (("vehicle", "vehicle"), ("pendulum", "pendulum"), ("command", "command")):
        parser.add_argument(f"--{name}-topic", default=ROLES[role].topic, metavar="TOPIC")
    options = parser.parse_args()
    scenario = SCENARIOS[options.scenario]
    changes = dict(item.split("=", 1) for item in options.set)
    params = scenario.params.replace(**{k.replace(".", "__", 1): ast.literal_eval(v) for k, v in changes.items()})
    topics = {name: getattr(options, f"{name}_topic") for name in (*BODIES, "command")}
    with urgent_threads(2):
        peer = PEERS[options.dds](topics, options.reliable)
    urgent(2)
    print("ready; Ctrl-D ends", flush=True)
    try:
        print(json.dumps(fly(dataclasses.replace(scenario, params=params), peer)), flush=True)
    finally:
        peer.close()


if __name__ == "__main__":
    main()
