"""The parameters that only a real vehicle needs: limits of the failsafe and settings of the radio."""

import dataclasses
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, ClassVar

from fiplib.params import Groups, Params, quantity


@dataclass(frozen=True)
class Safety:
    """Limits of the failsafe (``failsafe.Guard``) and of the command sender. None was tried on a real vehicle."""

    pose_flag: float = quantity(0.025, "s", "our choice: age of the newest good pose from which on the plan is flown")
    pose_level: float = quantity(
        0.1, "s", "our choice, as MRS's odometry timeout: age at which to level and descend", above="pose_flag"
    )
    pose_disarm: float = quantity(
        0.5, "s", "our choice, below PX4's 1.0 s without setpoints: age at which to disarm", above="pose_level"
    )
    clock_tolerance: float = quantity(
        0.01, "s", "our choice: stamps may be that much ahead of their arrival's usual delay; else a clock has stepped"
    )
    recovery_frames: int = quantity(12, "frames", "our choice: good frames in a row before poses are used again")
    quaternion_tolerance: float = quantity(1e-3, "1", "our choice: | |q| - 1 |, as for bags")
    jump: float = quantity(0.03, "m", "our choice: distance from the extrapolated position; 0.2 mm is the noise")
    jump_acceleration: float = quantity(30.0, "m/s^2", "our choice: 3 g; what the extrapolation may miss")
    turn: float = quantity(0.17, "rad", "our choice: 10 deg between frames; 1 mrad is the noise")
    turn_rate: float = quantity(8.0, "rad/s", "our choice: on top of it per s between frames; commands reach 1.75")
    arm_time: float = quantity(0.5, "s", "our choice: arm checks must hold that long")
    arm_rate: float = quantity(
        0.8, "1", "our choice: least share of the expected frames that must arrive to arm", within=(0.01, 1)
    )
    arm_speed: float = quantity(0.3, "m/s", "our choice: vehicle and rod must be still to arm")
    arm_tilt: float = quantity(0.17, "rad", "our choice: 10 deg; the vehicle must be level to arm")
    arm_lean: float = quantity(0.1, "rad", "our choice: 5.7 deg; the rod must stand to arm; pushes reach 6.7 deg")
    arm_distance: float = quantity(0.5, "m", "our choice: from where the trajectory starts, horizontally")
    seat_tolerance: float = quantity(
        0.35, "rad", "our choice: 20 deg between the rod's axis and the line from seat to COM; the seat is not exact"
    )
    seat_play: float = quantity(0.1, "m", "our choice: change of the distance from seat to COM: the rod left its seat")
    fallen_lean: float = quantity(0.6, "rad", "our choice: 34 deg; the rod counts as fallen; 0.15 m of lean are 17 deg")
    max_tilt: float = quantity(0.8, "rad", "our choice: 46 deg; bound of the MPC is 23 deg")
    fence: tuple[float, float, float] = quantity(
        (2.5, 2.5, 2.8), "m", "our choice: |x|, |y|, z at most; the flying space of the state bounds"
    )
    floor: float = quantity(0.2, "m", "our choice: z at least; below it a levelled vehicle has landed", zero=True)
    solve_limit: float = quantity(
        1.0 / 120.0, "s", "paper, section 4: 8.33 ms, one control tick; a later solve is late"
    )
    coast_ticks: int = quantity(3, "ticks", "our choice: ticks on the plan's next inputs when a solve is late or fails")
    late_share: float = quantity(
        0.02, "1", "our choice: largest share of late ticks in the self-test that a real vehicle is armed after"
    )
    solver_retry: float = quantity(
        0.25, "s", "our choice: while hovering only, time from one try of the solver to the next"
    )
    hover_time: float = quantity(3.0, "s", "our choice: longest flight without the solver; then level and descend")
    estimate_jump: float = quantity(
        0.6, "m", "our choice: largest change of the length per estimate; 0.6 m at once was survived, 0.85 m was not"
    )
    estimate_silence: float = quantity(5.0, "s", "our choice: an estimator that is silent for longer is reported")
    estimator_timeout: float = quantity(
        10.0, "s", "our choice: an estimator's run that takes longer hangs; the GA takes 0.1 s, on a busy machine 2 s"
    )
    estimator_restarts: int = quantity(
        3, "1", "our choice: times that the estimator's process is started again", within=(1, 1000)
    )
    level_gain: float = quantity(4.0, "1/s", "our choice: body rate per tilt when levelling")
    loop_delay: float = quantity(
        0.03, "s", "Betaflight in the loop: 17 to 23 ms of delay and lag, and the radio; commands not yet seen in poses"
    )
    descent: float = quantity(0.5, "m/s", "our choice: speed of the descent when levelled, poses being good")
    descent_gain: float = quantity(2.0, "1/s", "our choice: vertical acceleration per error of the speed of descent")
    descent_thrust: float = quantity(
        0.93, "1", "our choice: share of the weight carried when descending without poses", within=(0.1, 1)
    )
    level_time: float = quantity(6.0, "s", "our choice: longest descent; then disarm wherever the vehicle is")
    max_thrust: float = quantity(
        0.6, "1", "our choice: largest normalised thrust ever sent; hovering takes 0.18", within=(0.01, 1)
    )
    send_rate: float = quantity(120.0, "Hz", "paper, section 3: the control rate; the sender repeats at this rate")
    leave_time: float = quantity(
        0.6, "s", "our choice: level-and-disarm frames on leaving; ExpressLRS and Betaflight need 0.5"
    )


@dataclass(frozen=True)
class Radio:
    """A CRSF transmitter module and the Betaflight behind it. Not tried on hardware; docs/radio.md."""

    baud: int = quantity(
        921600, "bit/s", "our choice among those that ExpressLRS modules listen at (crsf_frames.BAUDS)"
    )
    channels: str = quantity(
        "AETR", "-", "Betaflight's default map: channels 1 to 4 are roll (A), pitch (E), throttle (T), yaw (R)"
    )
    arm_channel: int = quantity(
        5, "1", "ExpressLRS: channel 5 (AUX1) is the one switch that every packet carries", within=(5, 16)
    )
    arm_time: float = quantity(
        0.2, "s", "our choice: idle so long once armed; Betaflight refuses to arm while the throttle is up", zero=True
    )
    throttle_low: float = quantity(1050.0, "us", "Betaflight's default min_check: at it and below the motors idle")
    motor_idle: float = quantity(0.055, "1", "Betaflight's default idle: share of the motors' range", within=(0, 1))
    thrust_curve: float = quantity(
        0.0,
        "1",
        "our choice, to be measured: share of the thrust that goes with the motor command squared, as PX4's "
        "THR_MDL_FAC; 0 is linear, and sends too little rather than too much",
        within=(0, 1),
    )


@dataclass(frozen=True)
class Limits(Groups):
    """The parameters of a flight behind the failsafe that are not those of the paper's system."""

    ELSEWHERE: ClassVar = frozenset(group.name for group in dataclasses.fields(Params))

    safety: Safety = Safety()
    radio: Radio = Radio()


def changed(params: Params, limits: Limits, changes: Iterable[tuple[str, Any]]) -> tuple[Params, Limits]:
    """Return both with some parameters changed, each a name ``group__field`` and a value; raises as ``replace``."""
    values = dict(changes)
    own = {name: values.pop(name) for name in list(values) if name.partition("__")[0] in Params.ELSEWHERE}
    return params.replace(**values), limits.replace(**own)


def recorded(params: Params, limits: Limits) -> dict[str, dict[str, Any]]:
    """Return what a bag of a flight behind the failsafe carries as ``params``: all groups of both."""
    return {**params.to_dict(), **limits.to_dict()}
