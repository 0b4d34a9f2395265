"""The yardstick of the campaign: a controller with perfect information, with the same gaps or without.

It is the pilot without failsafe that is given true states without noise and the true length. Where it loses the rod,
no failsafe could have kept it.
"""

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from fiplib.flight.limits import Limits
from fiplib.flight.links.simulated import VirtualLink
from fiplib.flight.setpoint import Mode, Setpoint
from fiplib.params import NANO
from fiplib.pilot import Pilot
from fiplib.recording import EPOCH
from fiplib.simulate import Scenario

NEVER = (math.inf, math.inf)
"""(start, end) of a gap that does not come, s after take-off."""


def balances(
    scenario: Scenario,
    blind: tuple[float, float] = NEVER,
    deaf: tuple[float, float] = NEVER,
    sent: Mapping[int, Setpoint] | None = None,
) -> bool:
    """Return whether the controller keeps the rod up in a scenario, without noise and with the true length.

    ``blind`` and ``deaf`` are (start, end) in s after take-off: meanwhile it flies the plan that it had, by time, or no
    command gets through, and the last one is held. On the setpoints ``sent``, by time in ns, it flies until it goes
    deaf; then the controller takes over.
    """
    params = scenario.params.replace(
        simulation__position_noise=0.0,
        simulation__attitude_noise=0.0,
        piloting__initial_length=scenario.params.pendulum.length,
        piloting__estimate=False,
    )
    link, pilot = VirtualLink(replace(scenario, params=params)), Pilot(params, scenario.reference)
    now, frame = link.receive(0.0) or (EPOCH, None)
    plan: tuple[int, NDArray] | None = None
    thrust, last = 0.0, -math.inf
    while (at := (link.vehicle.flown or 0) / params.piloting.mocap_rate) < scenario.duration:
        setpoint = None
        tick = None if blind[0] <= at < blind[1] else pilot.observe(now, frame)
        if sent and at < deaf[0]:
            setpoint = sent.get(now)
        elif tick is not None:
            solution = pilot.solve(tick)
            command = pilot.answer(tick, solution.input, solution.status)
            plan, thrust, last = (now, solution.inputs), command.thrust, now
            setpoint = Setpoint(now, True, Mode.FLYING, command.body_rate, command.thrust)
        elif plan is not None and now - last >= NANO / params.piloting.control_rate - 1:
            node = min(int((now - plan[0]) / NANO / params.control.step), len(plan[1]) - 1)
            setpoint, last = Setpoint(now, True, Mode.FLYING, np.array([*plan[1][node], 0.0]), thrust), now
        if setpoint is not None and not deaf[0] <= at < deaf[1]:
            link.send(setpoint)
        now, frame = link.receive(0.0) or (now, frame)
        outside = np.abs(link.vehicle.plant.x[:3]) > Limits().safety.fence
        if link.vehicle.plant.fallen or outside.any():
            return False
    return True
