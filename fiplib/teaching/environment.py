"""The simulated vehicle and its rod as an environment of reinforcement learning (Gymnasium, extra ``rl``).

    env = gymnasium.make("fiplib.teaching.environment:fip/FlyingPendulum-v0")

Plant, motion capture, observer and the loops of altitude and yaw are those of ``simulate.fly``; the policy takes the
place of the MPC and answers at 120 Hz.

- Observation (10,): the pilot's ten states minus the reference's, in the order and units of ``params.STATES``.
- Action (2,): body rates about x and y, as shares of the largest (``vehicle.max_body_rate``, 100 deg/s), from -1 to 1.
- Reward of a tick, from 0 to 1: max(0, 1 - (x^2 + y^2)/(1 m)^2 - (a^2 + b^2)/(0.2 m)^2 - 0.01 |action|^2), of the true
  state minus the reference's, after the action; 0 after a fall.
- An episode terminates when rod or vehicle fall (60 degrees, or the ground), and is truncated after ``seconds``.
- ``info``: ``length``, the rod's true one in m, and ``seconds`` flown.

``reset(seed=...)`` draws the flight's noise, the rod's first lean and, with ``lengths``, the rod. The MPC is the
baseline: ``mpc_action`` is its action, with the length that the pilot takes the rod to have.
"""

from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from fiplib.mpc import Status
from fiplib.params import NANO, A, B, FipError, Params, X, Y
from fiplib.pilot import Pilot, Tick
from fiplib.recording import EPOCH
from fiplib.references import Hover, Reference
from fiplib.simulate import Scenario, SimulatedVehicle

try:
    import gymnasium
except ImportError as error:
    raise FipError(f"the environment needs gymnasium ({error}); install it with: pip install 'fip[rl]'") from error

ID = "fip/FlyingPendulum-v0"
"""Its name for ``gymnasium.make``, after this module's name and a colon or once this module is imported."""


class FlyingPendulum(gymnasium.Env):
    """A quadcopter that balances a rod, one control tick a step; see the module's text.

    Args:
        params: vehicle, rod, sensors and, with the options of ``simulation``, wind and other disturbances.
        reference: what to follow; by default a hover at (0, 0, 1.3) m.
        seconds: after which an episode is truncated.
        lengths: shortest and longest rod in m, drawn uniformly at each reset; by default always that of ``params``.

    Raises FipError: ``seconds`` or ``lengths`` are no such numbers, or an action is not two finite ones.
    """

    metadata: ClassVar[dict[str, Any]] = {"render_modes": []}

    def __init__(
        self,
        params: Params | None = None,
        reference: Reference | None = None,
        seconds: float = 10.0,
        lengths: tuple[float, float] | None = None,
    ) -> None:
        self._params = params or Params()
        self._reference: Reference = reference or Hover()
        if not 0.0 < seconds < np.inf:
            raise FipError(f"seconds of an episode must be a positive number, not {seconds!r}")
        if lengths is not None and not (np.shape(lengths) == (2,) and 0.0 < lengths[0] <= lengths[1] < np.inf):
            raise FipError(f"lengths must be those of the shortest and the longest rod in m, not {lengths!r}")
        self._advice: NDArray | None = None
        self._frames, self._lengths = round(seconds * self._params.piloting.mocap_rate), lengths
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (10,), np.float64)
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (2,), np.float64)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray, dict[str, float]]:
        """Begin another flight; returns the first observation and ``info``. There are no ``options``."""
        super().reset(seed=seed, options=options)
        params = self._params
        if self._lengths:
            params = params.replace(pendulum__length=float(self.np_random.uniform(*self._lengths)))
        drawn = int(self.np_random.integers(2**31))
        self._length = params.pendulum.length
        self._vehicle = SimulatedVehicle(Scenario("reinforcement", "", 1.0, self._reference, params=params, seed=drawn))
        self._pilot, self._frame = Pilot(params, self._reference), 0
        self._tick, self._advice = self._observed(), None
        return self._observation(), self._info()

    def step(self, action: NDArray) -> tuple[NDArray, float, bool, bool, dict[str, float]]:
        """Fly one control tick with an action (2,); what lies beyond -1 to 1 is cut off."""
        if np.shape(action) != (2,) or not np.isfinite(action).all():
            raise FipError(f"an action must be two finite numbers from -1 to 1, not {action!r}")
        action = np.clip(np.asarray(action, dtype=float), -1.0, 1.0)
        rates = action * self._params.vehicle.max_body_rate
        self._vehicle.command(self._pilot.answer(self._tick, rates, Status.OPTIMAL))
        fallen, truncated = False, False
        while not fallen:
            self._vehicle.advance()
            self._frame += 1
            fallen = bool(self._vehicle.plant.fallen)
            truncated = self._frame >= self._frames
            tick = self._next()
            if tick is not None:
                self._tick, self._advice = tick, None
                break
        reward = 0.0 if fallen else self._reward(action)
        return self._observation(), reward, fallen, truncated and not fallen, self._info()

    def mpc_action(self) -> NDArray:
        """The action (2,) of the MPC, or of another ``piloting.controller``, at the present tick."""
        if self._advice is None:  # once a tick: a controller may remember what it answered
            self._advice = self._pilot.solve(self._tick).input / self._params.vehicle.max_body_rate
        return self._advice.copy()

    def _next(self) -> Tick | None:
        """Take the frame exposed now; at a control tick, what the pilot knows."""
        rate = self._params.piloting.mocap_rate
        stamp = EPOCH + round(self._frame * NANO / rate)
        latency = round(self._params.simulation.mocap_latency * NANO)
        return self._pilot.observe(stamp + latency, self._vehicle.measure(stamp))

    def _observed(self) -> Tick:
        tick = self._next()
        assert tick is not None, "the first frame is a control tick"
        return tick

    def _observation(self) -> NDArray:
        return self._tick.state - self._tick.reference[0]

    def _info(self) -> dict[str, float]:
        return {"length": self._length, "seconds": self._frame / self._params.piloting.mocap_rate}

    def _reward(self, action: NDArray) -> float:
        off = self._vehicle.plant.truth()[:10] - self._tick.reference[0]
        far = off[X] ** 2 + off[Y] ** 2 + (off[A] ** 2 + off[B] ** 2) / 0.2**2
        return max(0.0, 1.0 - float(far) - 0.01 * float(action @ action))


gymnasium.register(ID, entry_point=f"{__name__}:FlyingPendulum")
