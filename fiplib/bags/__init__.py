"""ROS 2 bags: a flight written to one, read from one, saved from a damaged one."""

from fiplib.bags.reader import read
from fiplib.bags.recovery import recover
from fiplib.bags.writer import BagRecorder
from fiplib.recording import BagError

__all__ = ["BagError", "BagRecorder", "read", "recover"]
