"""Eclipse Cyclone DDS as a peer without ROS: topics, types and bytes as ROS 2 maps them, written down once more."""

import os
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from cyclonedds.core import InstanceState, Policy, Qos, ReadCondition, SampleState, ViewState, WaitSet
from cyclonedds.domain import DomainParticipant
from cyclonedds.idl import IdlStruct
from cyclonedds.idl.types import float64, int32, uint32
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration
from numpy.typing import NDArray

from fiplib.params import NANO
from fiplib.recording import Measurement

LOOPBACK = """<CycloneDDS><Domain Id="any">
<General><Interfaces><NetworkInterface name="lo" multicast="false"/></Interfaces>
<AllowMulticast>false</AllowMulticast></General>
<Discovery><ParticipantIndex>auto</ParticipantIndex><MaxAutoParticipantIndex>30</MaxAutoParticipantIndex>
<Peers><Peer Address="127.0.0.1"/></Peers></Discovery></Domain></CycloneDDS>"""
"""On the loopback interface only, and known to its peers there as those of ROS are."""


@dataclass
class Time(IdlStruct, typename="builtin_interfaces::msg::dds_::Time_"):
    sec: int32
    nanosec: uint32


@dataclass
class Header(IdlStruct, typename="std_msgs::msg::dds_::Header_"):
    stamp: Time
    frame_id: str


@dataclass
class Point(IdlStruct, typename="geometry_msgs::msg::dds_::Point_"):
    x: float64
    y: float64
    z: float64


@dataclass
class Quaternion(IdlStruct, typename="geometry_msgs::msg::dds_::Quaternion_"):
    x: float64
    y: float64
    z: float64
    w: float64


@dataclass
class Pose(IdlStruct, typename="geometry_msgs::msg::dds_::Pose_"):
    position: Point
    orientation: Quaternion


@dataclass
class PoseStamped(IdlStruct, typename="geometry_msgs::msg::dds_::PoseStamped_"):
    header: Header
    pose: Pose


@dataclass
class Vector3(IdlStruct, typename="geometry_msgs::msg::dds_::Vector3_"):
    x: float64
    y: float64
    z: float64


@dataclass
class Twist(IdlStruct, typename="geometry_msgs::msg::dds_::Twist_"):
    linear: Vector3
    angular: Vector3


@dataclass
class TwistStamped(IdlStruct, typename="geometry_msgs::msg::dds_::TwistStamped_"):
    header: Header
    twist: Twist


class Cyclone:
    """As ``ros2_vehicle.Ros``, without ROS."""

    def __init__(self, topics: dict[str, str], reliable: bool) -> None:
        self.told: dict[str, float | int | None] = {}
        os.environ["CYCLONEDDS_URI"] = LOOPBACK  # read when the participant is made
        best_effort = Policy.Reliability.BestEffort
        reliability = Policy.Reliability.Reliable(duration(milliseconds=1)) if reliable else best_effort
        newest, xcdr1 = Policy.History.KeepLast(5), Policy.DataRepresentation(use_cdrv0_representation=True)
        poses, sensor = Qos(reliability, newest, xcdr1), Qos(best_effort, newest, xcdr1)
        domain = DomainParticipant(int(os.environ.get("ROS_DOMAIN_ID", "0")))
        self._bodies = [
            DataWriter(domain, Topic(domain, f"rt{topics[body]}", PoseStamped), qos=poses)
            for body in ("vehicle", "pendulum")
        ]
        self._reader = DataReader(domain, Topic(domain, f"rt{topics['command']}", TwistStamped), qos=sensor)
        self._waitset = WaitSet(domain)
        self._waitset.attach(ReadCondition(self._reader, SampleState.NotRead | ViewState.Any | InstanceState.Any))

    def publish(self, frame: Measurement, truth: NDArray) -> None:
        header = Header(Time(*divmod(frame.stamp, NANO)), "world")
        numbers = np.concatenate(frame[1:]).reshape(2, 7).tolist()
        for writer, body in zip(self._bodies, numbers, strict=True):
            writer.write(PoseStamped(header, Pose(Point(*body[:3]), Quaternion(*body[3:]))))

    def commands(self, timeout: float) -> Iterator[tuple[tuple[float, float, float], float]]:
        self._waitset.wait(duration(seconds=timeout))
        for sample in self._reader.take(16):
            if isinstance(sample, TwistStamped):  # and not word that a peer has come or gone
                rate = sample.twist.angular
                yield (rate.x, rate.y, rate.z), sample.twist.linear.z

    def close(self) -> None:
        pass
