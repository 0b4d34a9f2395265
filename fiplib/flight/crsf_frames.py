"""Setpoints as CRSF frames (RC_CHANNELS_PACKED), as an ExpressLRS module takes them and Betaflight understands them.

Pure: bytes out, no port, no clock. A frame is ``C8 18 16``, sixteen channels of 11 bits each, lowest bits first, and a
CRC over type and channels (https://github.com/crsf-wg/crsf/wiki/CRSF_FRAMETYPE_RC_CHANNELS_PACKED). Betaflight reads a
channel as microseconds, 0.62477 times its value + 881, and takes 1500 us for a centred stick: 991, not the 992 that the
protocol calls the centre. Not tried on hardware; docs/radio.md has the settings that must go with it.

``python -m fiplib.flight.crsf_frames`` prints Betaflight's part of these settings.
"""

import math
from collections.abc import Sequence

import numpy as np

from fiplib.flight.limits import Limits, Radio
from fiplib.flight.setpoint import Setpoint
from fiplib.params import NANO, Params, Vehicle

BAUDS = (400000, 115200, 5250000, 3750000, 1870000, 921600, 2250000)
"""Bits per second at which an ExpressLRS module looks for its host (its CRSFHandset.cpp, ``TxToHandsetBauds``)."""
CHANNELS = 16
HEADER = bytes((0xC8, 0x18, 0x16))
"""Address (flight controller), number of bytes that follow, type (RC_CHANNELS_PACKED)."""
FRAME_BYTES = 26

CENTRE, TRAVEL = 1500.0, 500.0
"""Pulse length of a centred stick at Betaflight, and its change at full deflection, us."""
LOW, HIGH = CENTRE - TRAVEL, CENTRE + TRAVEL
US_PER_COUNT = (2012.0 - 988.0) / (1811.0 - 172.0)
"""Change of Betaflight's pulse length per count of a channel, us (its rx/crsf.c)."""
US_OFFSET = 881.0
"""Pulse length that Betaflight assigns to a channel of 0, us (its rx/crsf.c)."""


def crc8(data: bytes) -> int:
    """CRC-8 with polynomial 0xD5 (DVB-S2), starting from 0."""
    crc = 0
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = (crc << 1 ^ 0xD5) & 0xFF if crc & 0x80 else crc << 1
    return crc


def pack(channels: Sequence[int]) -> bytes:
    """Return the frame (26 bytes) that carries 16 channels, each 0 to 2047. Raises ValueError for anything else."""
    if len(channels) != CHANNELS or not all(0 <= value < 2048 for value in channels):
        raise ValueError(f"a frame carries {CHANNELS} channels of 0 to 2047, not {list(channels)}")
    bits = sum(int(value) << 11 * index for index, value in enumerate(channels))
    body = HEADER[2:] + bits.to_bytes(22, "little")
    return HEADER[:2] + body + bytes((crc8(body),))


def count(microseconds: float) -> int:
    """Return the channel's value that Betaflight reads as nearest to these microseconds."""
    return round((microseconds - US_OFFSET) / US_PER_COUNT)


class Encoder:
    """Makes frames of setpoints.

    Disarmed: sticks centred, throttle lowest, arm switch off. Once armed, the same with the switch on for
    ``radio.arm_time``, as Betaflight does not arm while the throttle is up; then rates and thrust. A setpoint that is
    armed from the very first is encoded as it is: a port was opened again in flight.

    Raises:
        ValueError: ``limits.radio`` makes no sense.
    """

    def __init__(self, params: Params, limits: Limits) -> None:
        radio = limits.radio
        if radio.baud not in BAUDS:
            raise ValueError(f"radio.baud must be one of {', '.join(map(str, sorted(BAUDS)))}, not {radio.baud}")
        if sorted(radio.channels) != sorted("AETR"):
            raise ValueError(f"radio.channels must order the letters A, E, T, R, not {radio.channels!r}")
        if not 5 <= radio.arm_channel <= CHANNELS:
            raise ValueError(f"radio.arm_channel must be 5 to {CHANNELS}, not {radio.arm_channel}")
        if not LOW < radio.throttle_low < HIGH or radio.motor_idle >= 1.0 or radio.thrust_curve > 1.0:
            raise ValueError(
                f"radio.throttle_low must lie between {LOW:g} and {HIGH:g} us, motor_idle below 1, "
                "thrust_curve at 1 or below"
            )
        self._limit, self._limits = params.vehicle.max_body_rate, limits
        self._places = [radio.channels.index(letter) for letter in "AETR"]
        self._ready: int | None = 0
        """From when on, ns, an armed setpoint is encoded as it is; ``None`` after a disarmed one."""

    def frame(self, now: int, setpoint: Setpoint) -> bytes:
        """Return the frame to send at ``now`` ns. Raises ValueError for an armed setpoint that is not finite."""
        return pack(self.channels(now, setpoint))

    def channels(self, now: int, setpoint: Setpoint) -> list[int]:
        """Return the 16 channels to send at ``now`` ns; raises as ``frame``."""
        radio = self._limits.radio
        if setpoint.armed and not (np.isfinite(setpoint.body_rate).all() and math.isfinite(setpoint.thrust)):
            raise ValueError("an armed setpoint that is not finite")
        if not setpoint.armed:
            self._ready = None
        elif self._ready is None:
            self._ready = now + round(radio.arm_time * NANO)
        values = [count(LOW)] * CHANNELS  # a switch that is not used is off
        sticks = [CENTRE, CENTRE, LOW, CENTRE]
        if setpoint.armed and self._ready is not None and now >= self._ready:
            # our axes are forward, left, up; its sticks roll right, pitch nose-down and yaw right
            share = np.clip(setpoint.body_rate, -self._limit, self._limit) / self._limit * (1.0, 1.0, -1.0)
            roll, pitch, yaw = (CENTRE + TRAVEL * share).tolist()
            thrust = min(max(setpoint.thrust, 0.0), self._limits.safety.max_thrust)
            sticks = [roll, pitch, radio.throttle_low + throttle(radio, thrust) * (HIGH - radio.throttle_low), yaw]
        for place, stick in zip(self._places, sticks, strict=True):
            values[place] = count(stick)
        values[radio.arm_channel - 1] = count(HIGH if setpoint.armed else LOW)
        return values


def throttle(radio: Radio, thrust: float) -> float:
    """Return Betaflight's throttle, 0 to 1, for a thrust normalised to [0, 1].

    The motors are given ``d = idle + (1 - idle) * throttle``, and pull ``c d^2 + (1 - c) d`` of their most, where ``c``
    is ``radio.thrust_curve``.
    """
    idle, curve = radio.motor_idle, radio.thrust_curve
    linear = 1.0 - curve
    # the root of the quadratic in a form that holds for c = 0 too
    drive = 2.0 * thrust / (linear + math.sqrt(linear**2 + 4.0 * curve * thrust)) if thrust > 0.0 else 0.0
    return min(max((drive - idle) / (1.0 - idle), 0.0), 1.0)


def betaflight_settings(vehicle: Vehicle, radio: Radio) -> list[str]:
    """Return the lines for Betaflight's command line that make it understand these frames; see docs/radio.md.

    Raises:
        ValueError: Betaflight cannot be given ``vehicle.max_body_rate``, which it takes in tens of deg/s.
    """
    degrees = math.degrees(vehicle.max_body_rate)
    tens = round(degrees / 10.0)
    if abs(degrees - 10.0 * tens) > 1e-6 or not 1 <= tens <= 200:
        raise ValueError(f"vehicle.max_body_rate is {degrees:g} deg/s: Betaflight takes 10, 20, ... 2000 deg/s")
    rates = []
    for axis in ("roll", "pitch", "yaw"):
        rates += [f"set {axis}_rc_rate = {tens}", f"set {axis}_srate = {tens}", f"set {axis}_expo = 0"]
    return [
        "set serialrx_provider = CRSF",
        "set serialrx_inverted = OFF",
        "set serialrx_halfduplex = OFF",
        f"map {radio.channels}1234",
        f"aux 0 0 {radio.arm_channel - 5} 1700 2100 0 0",
        "set mid_rc = 1500",
        f"set min_check = {radio.throttle_low:.0f}",
        "set deadband = 0",
        "set yaw_deadband = 0",
        "set yaw_control_reversed = OFF",
        "set failsafe_procedure = DROP",
        "set failsafe_delay = 5",
        f"set motor_idle = {1e4 * radio.motor_idle:.0f}",
        "feature AIRMODE",
        "feature -MOTOR_STOP",
        "set throttle_boost = 0",
        "set thrust_linear = 0",
        "set rates_type = ACTUAL",
        *rates,
        "set thr_mid = 50",
        "set thr_expo = 0",
        "set throttle_limit_type = OFF",
        "set rc_smoothing = OFF",
        "set simplified_feedforward_gain = 0",
        "simplified_tuning apply",
        "save",
    ]


if __name__ == "__main__":
    print("\n".join(betaflight_settings(Vehicle(), Radio())))
