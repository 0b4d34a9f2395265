"""ROS 2 bags: a flight written to one, read from one, cut and exported, saved from a damaged one."""

from fiplib.bags.cutting import cut
from fiplib.bags.reader import read
from fiplib.bags.recovery import recover
from fiplib.bags.tables import export, to_dataframe
from fiplib.bags.writer import BagRecorder
from fiplib.recording import BagError

__all__ = ["BagError", "BagRecorder", "cut", "export", "read", "recover", "to_dataframe"]
