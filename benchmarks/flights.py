"""Simulated flights and the plant alone, and their rivals: ``python -m benchmarks.flights``.

The same pilot flies the same scenario on plants that others integrate: MuJoCo with a model of vehicle and rod, and
SciPy's ``solve_ivp`` on the equations of ``dynamics.coupled_plant``. Then one frame of the plant alone, beside MuJoCo,
CasADi's interpreter and the C code that CasADi generates. Agreement is that of the true states, in SI units.

What ``make figures`` takes when everything is made anew is a command and not a rival: ``time make -B figures``.
"""

import shutil
import subprocess
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from benchmarks.harness import Absent, Contender, Row, compare, main, needs, rate
from fiplib.dynamics import PLANT, coupled_plant, projected, rk4
from fiplib.params import GRAVITY, Params
from fiplib.recording import Flight
from fiplib.references import Circle
from fiplib.simulate import Plant, Scenario, fly

TOPIC = "flights"
FRAMES = 240
"""Frames of the plant alone in one call: a second."""


def scenario(duration: float, seed: int = 1) -> Scenario:
    """A circle without estimator."""
    return Scenario("circle", "", duration, Circle(radius=0.8, period=9.0), seed=seed)


def truth(flight: Flight) -> NDArray:
    """The true states of a flight."""
    return flight.truth_state.values


# --- plants of others


def model(params: Params) -> str:
    """Vehicle and rod for MuJoCo, equivalent to ``dynamics.coupled_plant``.

    The vehicle is a ball whose rates follow the commands with the lag of the inner loop: a torque proportional to what
    is missing, without gyroscopic terms. Its inertia is so large that the rod, on its seat above the centre of mass,
    does not turn it: the lag stands for a loop that holds the rates whatever the rod does.
    """
    vehicle, rod, lags = params.vehicle, params.pendulum, params.simulation
    inertia, half = 1e6, rod.length / 2
    turn = rod.mass * rod.gyration_ratio * rod.length**2
    rates = "".join(
        f'<general site="hub" gear="0 0 0 {axis}" gainprm="{inertia / lags.rate_lag}" biastype="affine" '
        f'biasprm="0 0 {-inertia / lags.rate_lag}"/>'
        for axis in ("1 0 0", "0 1 0", "0 0 1")
    )
    return f"""<mujoco>
  <option timestep="{1 / lags.plant_rate!r}" integrator="RK4" gravity="0 0 {-GRAVITY}">
    <flag contact="disable" constraint="disable"/></option>
  <worldbody><body name="vehicle"><freejoint/><site name="hub"/>
    <inertial pos="0 0 0" mass="{vehicle.mass}" diaginertia="{inertia} {inertia} {inertia}"/>
    <body name="rod" pos="0 0 {vehicle.seat_height}"><joint type="ball"/>
      <inertial pos="0 0 {half}" mass="{rod.mass}" diaginertia="{turn} {turn} {turn * 1e-3}"/></body></body></worldbody>
  <actuator>{rates}
    <general site="hub" gear="0 0 1 0 0 0" dyntype="filter" dynprm="{lags.thrust_lag}"/></actuator>
</mujoco>"""


class ForeignPlant(Plant):
    """A plant that something else integrates: commands act after the same delay."""

    def __init__(self, params: Params, position: ArrayLike, lean: ArrayLike = (0.0, 0.0)) -> None:
        super().__init__(params, position, lean)
        simulation = params.simulation
        self.step = 1.0 / simulation.plant_rate
        self.delay = round((simulation.mocap_latency + simulation.rate_delay) * simulation.plant_rate)
        self.waiting: list[tuple[int, NDArray]] = []
        self.held, self.now = np.array([0.0, 0.0, 0.0, self.x[19]]), 0

    def command(self, body_rate: ArrayLike, thrust: float, at: int | None = None) -> None:
        self.waiting.append((self.now + self.delay if at is None else at, np.array([*body_rate, thrust])))

    def advance(self, force: ArrayLike = (0.0, 0.0, 0.0)) -> None:
        due = 0
        while due < self.substeps:  # in as few pieces as commands change
            while self.waiting and self.waiting[0][0] <= self.now + due:
                self.held = self.waiting.pop(0)[1]
            ahead = self.waiting[0][0] - self.now if self.waiting else self.substeps
            until = min(self.substeps, ahead)
            self.integrate(until - due, self.held, np.asarray(force, dtype=float))
            due = until
        self.finish()
        self.now += self.substeps

    def integrate(self, substeps: int, command: NDArray, force: NDArray) -> None:
        """Substeps further, command (4,) and force (3,) being constant."""
        raise NotImplementedError

    def finish(self) -> None:
        """Bring ``x`` up to date after a frame."""


class MuJoCoPlant(ForeignPlant):
    """The plant as MuJoCo integrates ``model``, by RK4 in the same substeps."""

    def __init__(self, params: Params, position: ArrayLike, lean: ArrayLike = (0.0, 0.0)) -> None:
        super().__init__(params, position, lean)
        (self.mujoco,) = needs("mujoco")
        self.model = self.mujoco.MjModel.from_xml_string(model(params))
        self.data = data = self.mujoco.MjData(self.model)
        q = self.x[PLANT["direction"]]
        self.seat = np.array([0.0, 0.0, params.vehicle.seat_height])
        data.qpos[:3] = self.x[PLANT["position"]] - self.seat  # level at the start
        data.qpos[3:7] = np.roll(self.x[PLANT["attitude"]], 1)
        data.qpos[7:11] = np.array([1.0 + q[2], -q[1], q[0], 0.0]) / np.sqrt(2.0 * (1.0 + q[2]))
        data.act[0] = self.x[19]
        self.rod = self.model.body("rod").id
        self.middle = np.array([0.0, 0.0, params.pendulum.length / 2])

    def integrate(self, substeps: int, command: NDArray, force: NDArray) -> None:
        self.data.ctrl[:] = command
        self.data.xfrc_applied[self.rod, :3] = force  # acts on the rod's centre of mass
        self.mujoco.mj_step(self.model, self.data, nstep=substeps)

    def finish(self) -> None:
        data, x = self.data, self.x
        attitude, rod, spin = np.empty(4), np.empty(4), np.empty(3)
        attitude[:] = data.qpos[3:7]
        self.mujoco.mju_mulQuat(rod, attitude, data.qpos[7:11])
        seat, moved = np.empty(3), np.empty(3)
        self.mujoco.mju_rotVecQuat(seat, self.seat, attitude)
        self.mujoco.mju_rotVecQuat(moved, np.cross(data.qvel[3:6], self.seat), attitude)
        x[0:3], x[3:6], x[6:9], x[9] = data.qpos[:3] + seat, data.qvel[:3] + moved, attitude[1:], attitude[0]
        self.mujoco.mju_rotVecQuat(x[10:13], np.array([0.0, 0.0, 1.0]), rod)
        self.mujoco.mju_rotVecQuat(spin, data.qvel[6:9], rod)
        turn = np.empty(3)
        self.mujoco.mju_rotVecQuat(turn, data.qvel[3:6], attitude)
        x[13:16] = np.cross(spin + turn, x[10:13])
        x[16:19], x[19] = data.qvel[3:6], data.act[0]


class ScipyPlant(ForeignPlant):
    """The plant as ``solve_ivp`` integrates it, adaptively."""

    def __init__(self, params: Params, position: ArrayLike, lean: ArrayLike = (0.0, 0.0)) -> None:
        super().__init__(params, position, lean)
        (self.scipy,) = needs("scipy.integrate")
        self.right_hand_side = coupled_plant(params)

    def integrate(self, substeps: int, command: NDArray, force: NDArray) -> None:
        def rhs(_: float, x: NDArray) -> NDArray:
            return self.right_hand_side(x, command, force).full().ravel()

        self.x[:] = self.scipy.solve_ivp(rhs, (0.0, substeps * self.step), self.x, rtol=1e-8, atol=1e-10).y[:, -1]

    def finish(self) -> None:
        # as the other plants do: quaternion and direction of unit length, or the error grows like the falling rod
        attitude, q, q_dot = (self.x[PLANT[name]] for name in ("attitude", "direction", "direction_rate"))
        attitude /= np.linalg.norm(attitude)
        q /= np.linalg.norm(q)
        q_dot -= q * (q @ q_dot)


class CasadiPlant(ForeignPlant):
    """The plant by RK4 as CasADi's interpreter runs it, or from a library of C code that it generates."""

    library: Path | None = None

    def __init__(self, params: Params, position: ArrayLike, lean: ArrayLike = (0.0, 0.0)) -> None:
        super().__init__(params, position, lean)
        function = substep(params) if self.library is None else ca.external("substep", str(self.library))
        self.arguments, self.after = (self.x, np.zeros(4), np.zeros(3)), np.zeros(20)
        self.buffer, self.run = function.buffer()
        for index, array in enumerate(self.arguments):
            self.buffer.set_arg(index, memoryview(array))
        self.buffer.set_res(0, memoryview(self.after))

    def integrate(self, substeps: int, command: NDArray, force: NDArray) -> None:
        self.arguments[1][:], self.arguments[2][:] = command, force
        for _ in range(substeps):
            self.run()
            self.x[:] = self.after


def substep(params: Params) -> ca.Function:
    """One RK4 step of the plant, then the projection onto unit quaternion and direction."""
    x, command, force = ca.SX.sym("x", 20), ca.SX.sym("command", 4), ca.SX.sym("force", 3)
    after = rk4(coupled_plant(params), 1.0 / params.simulation.plant_rate)(x, command, force)
    return ca.Function("substep", [x, command, force], [projected(after)])


def generated(folder: Path, params: Params) -> type[CasadiPlant]:
    """The plant in C, compiled with -O2."""
    compiler = shutil.which("gcc") or shutil.which("cc")
    if compiler is None:
        raise Absent("not installed: a C compiler")
    source = ca.CodeGenerator("substep.c")
    source.add(substep(params))
    source.generate(f"{folder}/")
    library = folder / "substep.so"
    command = [compiler, "-O2", "-fPIC", "-shared", str(folder / "substep.c"), "-o", str(library), "-lm"]
    subprocess.run(command, check=True)
    return type("GeneratedPlant", (CasadiPlant,), {"library": library})


# --- measured


def flown(duration: float, vehicle: Callable[..., Plant]) -> Contender:
    """A flight on a plant; the argument is its seed."""
    return Contender(lambda seed: fly(scenario(duration, seed), vehicle=vehicle), truth, 1e-4)


def advanced(params: Params, vehicle: Callable[..., Plant]) -> Contender:
    """A second of the plant alone, from hover with a lean; the argument is the body rate that is commanded."""
    weight = (params.vehicle.mass + params.pendulum.mass) * GRAVITY

    def call(body_rate: float) -> NDArray:
        plant = vehicle(params, (0.0, 0.0, 1.3), (0.005, -0.003))
        for frame in range(FRAMES):
            if frame % 2 == 0:
                plant.command((body_rate, -body_rate, 0.1), weight)
            plant.advance()
        return plant.x.copy()

    return Contender(call, tolerance=1e-6, remark=f"{FRAMES} frames, commands every other frame")


def measure(quick: bool) -> list[Row]:
    """Flights one by one, flights in a batch, plant alone."""
    duration, seeds, params = (2.0 if quick else 10.0), range(2 if quick else 8), Params()
    needs("scipy.integrate")
    with tempfile.TemporaryDirectory() as folder:
        in_c: list[type[CasadiPlant]] = []

        def c() -> type[CasadiPlant]:
            if not in_c:
                in_c.append(generated(Path(folder), params))
            return in_c[0]

        def mujoco() -> type[MuJoCoPlant]:
            needs("mujoco")
            return MuJoCoPlant

        plants: dict[str, Callable[[], Callable[..., Plant]]] = {
            "MuJoCo": mujoco,
            "SciPy RK45": lambda: ScipyPlant,
            "CasADi interpreter": lambda: CasadiPlant,
            "CasADi generated C": c,
        }
        work, budget = f"flight of {duration:g} s, one by one", 2.0 if quick else 30.0
        others: dict[str, Any] = {name: lambda make=make: flown(duration, make()) for name, make in plants.items()}
        rows = compare(TOPIC, work, flown(duration, Plant), others, list(seeds), budget=budget, checks=1, block=2)
        others = {name: lambda make=make: advanced(params, make()) for name, make in plants.items()}
        bodies = list(np.linspace(0.01, 0.05, 4 if quick else 40))
        rows += compare(TOPIC, "plant alone, 1 s", advanced(params, Plant), others, bodies, budget=budget / 4, block=2)
    rows += batch(duration, list(seeds))
    remark = "simulated seconds per second of one core"
    for row in list(rows):
        if row.work.startswith("flight") and row.calls:
            per_flight = row.p50_us / 1e6 / (len(seeds) if "batch" in row.work else 1)
            rows.append(rate(TOPIC, f"real-time factor, {row.work}", row.contender, duration / per_flight, remark))
    return rows


def batch(duration: float, seeds: list[int]) -> list[Row]:
    """All flights in one compiled batch, beside one by one."""
    from fiplib.studies.batch import fly_many

    scenarios = [scenario(duration, seed) for seed in seeds]

    def answer(flights: list[Flight]) -> NDArray:
        return np.stack([truth(flight) for flight in flights])

    together = Contender(lambda _: list(fly_many(scenarios)), answer, 0.0)
    others = {"fip, one by one": lambda: Contender(lambda _: [fly(one) for one in scenarios], answer, 0.0)}
    work = f"flight of {duration:g} s, batch of {len(seeds)}"
    return compare(TOPIC, work, together, others, [None] * 3, budget=60.0, checks=1, block=1)


if __name__ == "__main__":
    main(TOPIC, measure, __doc__)
