"""Every parameter of the package, once, with its unit and its source.

The paper's Tables 1 and 2 are copied as printed. Where the paper is silent the value is an *interpretation* of its
text or *our choice*, and the reason stands beside it. Nothing else in the package holds a physical number.

State order, names, labels and units are declared here and nowhere else.
"""

import ast
import dataclasses
import math
from dataclasses import dataclass, field
from typing import Any, ClassVar, NamedTuple, Self


class FipError(Exception):
    """A user's mistake, in one sentence that says what to do."""


class Signal(NamedTuple):
    """A named, labelled quantity: ``name`` in bags and tables, ``label`` (mathtext) in figures, ``unit`` in SI."""

    name: str
    label: str
    unit: str


STATES = (
    Signal("x", "$x$", "m"),
    Signal("x_dot", r"$\dot x$", "m/s"),
    Signal("y", "$y$", "m"),
    Signal("y_dot", r"$\dot y$", "m/s"),
    Signal("a", "$a$", "m"),
    Signal("a_dot", r"$\dot a$", "m/s"),
    Signal("b", "$b$", "m"),
    Signal("b_dot", r"$\dot b$", "m/s"),
    Signal("phi", r"$\phi$", "rad"),
    Signal("theta", r"$\theta$", "rad"),
)
"""The ten states of the prediction model, in the paper's order (its state vector, section 2.2)."""

INPUTS = (Signal("omega_x", r"$\omega_x$", "rad/s"), Signal("omega_y", r"$\omega_y$", "rad/s"))
"""The two inputs of the prediction model: body rates about x (roll) and y (pitch)."""

STATE_NAMES = tuple(signal.name for signal in STATES)
X, X_DOT, Y, Y_DOT, A, A_DOT, B, B_DOT, PHI, THETA = range(len(STATES))


class Axis(NamedTuple):
    """One of the two decoupled halves of the prediction model, brought to the common form (s, s', d, d', tilt; rate).

    ``states`` are indices into ``STATES``, ``input`` into ``INPUTS``. A positive pitch accelerates along +x, a
    positive roll along -y: multiplying the tilt and the rate by ``sign`` makes the two halves one and the same system.
    """

    states: tuple[int, ...]
    input: int
    sign: float


AXES = (Axis((X, X_DOT, A, A_DOT, THETA), 1, +1.0), Axis((Y, Y_DOT, B, B_DOT, PHI), 0, -1.0))

GRAVITY = 9.81
"""Standard acceleration of free fall, rounded, m/s^2 (the paper gives no value)."""

NANO = 1_000_000_000
"""Nanoseconds in a second: times are integer nanoseconds, as in ROS messages."""


WITHIN = {"m": (1e-6, 100), "kg": (1e-9, 100), "s": (1e-6, 3600), "Hz": (1, 1e6), "rad": (1e-9, math.pi),
          "rad/s": (0.01, math.inf), "N": (0.01, 1e4), "samples": (2, 1e5), "1": (1e-6, 1e3), "us": (800, 2200),
          "unit of the state": (1e-3, math.inf), "1/unit^2": (1e-9, math.inf)}  # fmt: skip
"""The valid range of a number by its unit, where the parameter itself names none; infinite: no bound."""


def quantity(default: Any, unit: str, source: str, zero: bool = False, within: Any = None, above: str = "",
             before: Any = None) -> Any:  # fmt: skip
    """A dataclass field that carries its unit, its source, its valid range, whether it may be zero although the range
    begins higher, which parameter of its group it must exceed, and what held before there was this parameter."""
    low, high = within or WITHIN.get(unit, (1e-12, 1e12))
    span = (low, math.inf if default == math.inf else high)
    return field(
        default=default, metadata=dict(unit=unit, source=source, zero=zero, within=span, above=above, before=before)
    )


@dataclass(frozen=True)
class Vehicle:
    """The quadcopter."""

    mass: float = quantity(0.569, "kg", "paper, Table 1")
    max_body_rate: float = quantity(math.radians(100.0), "rad/s", "paper, Table 1: 100 deg/s")
    seat_height: float = quantity(0.08, "m", "paper, section 3: of the rod's seat above the frame", zero=True)
    max_thrust: float = quantity(32.0, "N", "our choice: about 8 N a motor (2004, 1800 kV, 6S, 3.5 in); scales thrust")
    wheelbase: float = quantity(0.16, "m", "our choice: motor to motor across a 3.5 in Cinewhoop; only drawn")
    propeller_diameter: float = quantity(0.0889, "m", "paper, section 3: 3.5 in; only drawn")


@dataclass(frozen=True)
class Pendulum:
    """The rod. Its centre of mass lies at half its length, as the paper assumes."""

    mass: float = quantity(0.032, "kg", "paper, Table 1")
    length: float = quantity(1.0, "m", "paper, Table 1", within=(0.05, 20))
    gyration_ratio: float = quantity(
        1.0 / 12.0, "1", "our choice: k^2/l^2 of a uniform rod; in the paper 0, no inertia about the COM", zero=True
    )

    @property
    def inertia_factor(self) -> float:
        """lambda = r^2 / (r^2 + k^2) with r = l/2: 1 for a point mass, 3/4 for a uniform rod."""
        return 0.25 / (0.25 + self.gyration_ratio)


@dataclass(frozen=True)
class Control:
    """The optimal control problem: horizon, weights, bounds. Diagonals in the order of ``STATES`` and ``INPUTS``."""

    nodes: int = quantity(60, "1", "paper, Table 2: N", within=(2, 500))
    horizon: float = quantity(6.0, "s", "paper, Table 2: t_f", within=(0.05, 60))
    state_weights: tuple[float, ...] = quantity(
        (20.0, 5.0, 2.0, 0.5, 1000.0, 50.0, 1000.0, 50.0, 1.0, 1.0),
        "1/unit^2",
        "our choice: Q; heavy on a, b, to tolerate a wrong length; y and y' a tenth of x and x', as the paper's own "
        "weights of y wanted tuning (section 4.2); found by the study 'weights'",
        zero=True,
    )
    input_weights: tuple[float, ...] = quantity((0.5, 0.5), "s^2/rad^2", "our choice: R")
    terminal_factor: float = quantity(10.0, "1", "our choice: P = factor * Q")
    state_bounds: tuple[float, ...] = quantity(
        (2.5, 2.5, 2.5, 2.5, 0.15, 1.0, 0.15, 1.0, 0.4, 0.4),
        "unit of the state",
        "our choice: |x| <= bound; the flying space, and where the linear model still holds",
    )
    slack_weight: float = quantity(1e4, "1/unit^2", "our choice: price of a squared violation of a soft state bound")

    @property
    def step(self) -> float:
        """Prediction step in s: horizon / nodes."""
        return self.horizon / self.nodes


@dataclass(frozen=True)
class Estimation:
    """The length estimator: window, schedule, genetic algorithm, Kalman filter."""

    estimator: str = quantity("ga", "-", "paper, section 2.3: genetic algorithm; a name in estimators.ESTIMATORS")
    window: int = quantity(55, "samples", "paper, Table 2: t_w")
    sample_period: float = quantity(0.1, "s", "interpretation: the MPC's step; with 1/120 s, 0.46 s are too short")
    raw_window: float = quantity(2.5, "s", "our choice: span an estimator of kind 'raw' gets", above="first_raw_window")
    first_raw_window: float = quantity(0.3, "s", "our choice: trusted: span at the first run; less holds no length")
    run_period: float = quantity(0.2, "s", "interpretation of '0.2 Hz': a 0.2 s period; the other is 5.0 s")
    length_min: float = quantity(0.2, "m", "paper, Table 2: l_min", within=(0.01, 20))
    length_max: float = quantity(2.0, "m", "paper, Table 2: l_max", within=(0.01, 20), above="length_min")
    resolution: float = quantity(1e-4, "m", "paper, section 2.3: resolution of the chromosome", within=(1e-5, 1))
    population: int = quantity(60, "1", "our choice: N_c; r_p = 0.167 suggests a multiple of 6", within=(2, 10_000))
    generations: int = quantity(20, "1", "our choice: generations per run", within=(1, 10_000))
    elite_fraction: float = quantity(0.167, "1", "paper, Table 2: r_p", within=(0, 1))
    mutation_rate: float = quantity(0.1, "1", "paper, Table 2: r_m, per bit", within=(0, 1))
    median_length: int = quantity(5, "runs", "our choice: length of the median filter over successive runs")
    fitness: str = quantity("rk4_likelihood", "-", "reading: a name in kalman.READINGS; 'paper' is the printed formula")
    process_noise: tuple[float, ...] = quantity(
        (1e-7, 6e-5, 1e-7, 6e-5, 1e-7, 6e-5, 1e-7, 6e-5, 1e-4, 1e-4),
        "unit^2",
        "our choice: diagonal of Q_e per 0.1 s; the model's one-step error in a simulated flight without a raised seat",
        zero=True,
    )
    measurement_noise: tuple[float, ...] = quantity(
        (4e-8, 5e-4, 4e-8, 5e-4, 8e-8, 1e-3, 8e-8, 1e-3, 1e-6, 1e-6),
        "unit^2",
        "our choice: diagonal of R_e; variance of the states derived from simulated motion capture",
    )


@dataclass(frozen=True)
class Piloting:
    """Everything of the controller around the MPC: rates, filters, PID loops, hand-over of the length."""

    mocap_rate: float = quantity(240.0, "Hz", "paper, section 3")
    control_rate: float = quantity(120.0, "Hz", "paper, section 3")
    initial_length: float = quantity(1.0, "m", "per flight: length l0 that the MPC starts with", within=(0.05, 20))
    estimate: bool = quantity(False, "-", "per flight: whether the length is estimated in flight")
    length_step: float = quantity(math.inf, "m", "largest change a hand-over; infinite as printed, finite as concluded")
    handover: str = quantity("printed", "-", "paper: median, at once; 'trusted' weighs by standard deviation")
    rod_lengths: tuple[float, float] = quantity(
        (0.5, 1.5), "m", "our choice: trusted: shortest and longest rod to expect, `caution` deviations off the middle"
    )
    caution: float = quantity(2.0, "1", "our choice: trusted: deviations to the short side; 1 belief in 44 is shorter")
    outlier_gate: float = quantity(4.0, "1", "our choice: trusted: deviations from the belief that make an outlier")
    default_deviation: float = quantity(0.1, "m", "our choice: trusted: if none is stated; above the GA's 0.08 m rms")
    shortest_survivable: float = quantity(
        0.4, "1", "measured: trusted: least used / believed; 0.2 leaves 4 ms of delay margin (study survival)"
    )
    largest_rise: float = quantity(1.25, "1", "our choice: trusted: used length over the one before; 1.6 was survived")
    seat_height: float = quantity(
        0.08, "m", "paper, section 3: of the seat above the tracked point, as the pilot has it", zero=True, before=0.0
    )
    seat_tolerance: float = quantity(2e-3, "m", "our choice: standard deviation of the stated seat height", zero=True)
    pendulum_measurement: str = quantity("position", "-", "interpretation: 'position' of COM or 'direction' of rod")
    velocity_cutoff: float = quantity(20.0, "Hz", "our choice: low-pass filter of the differentiated positions")
    controller: str = quantity("mpc", "-", "paper, section 2.2; others: controllers.CONTROLLERS", before="mpc")
    observer: str = quantity("differentiate", "-", "paper, section 3; or 'kalman': a name in observers.OBSERVERS")
    measurement_deviations: tuple[float, float] = quantity(
        (0.2e-3, 1e-3), "m, rad", "our choice: kalman: standard deviations of measured positions and attitudes"
    )
    thrust_density: float = quantity(0.05, "m^2/s^5", "our choice: kalman: of the specific thrust's random walk")
    force_density: float = quantity(0.01, "m^2/s^3", "our choice: kalman: of the white specific forces on both bodies")
    altitude_gains: tuple[float, float, float] = quantity(
        (12.0, 4.0, 6.0), "1/s^2, 1/s^3, 1/s", "our choice: P, I and D gain", zero=True
    )
    altitude_integral_limit: float = quantity(2.0, "m/s^2", "our choice: bound of the integral's share", zero=True)
    yaw_gains: tuple[float, float, float] = quantity(
        (2.0, 0.1, 0.0), "1/s, 1/s^2, 1", "our choice: P, I and D gain", zero=True
    )


@dataclass(frozen=True)
class Simulation:
    """Effects of the simulated vehicle and its sensors beyond the rigid-body plant."""

    plant_rate: float = quantity(960.0, "Hz", "our choice: RK4 steps of the plant, four to a mocap frame")
    rate_delay: float = quantity(12.5e-3, "s", "Betaflight's 9 to 12 ms (docs/firmware.md), and the radio's", zero=True)
    rate_lag: float = quantity(15e-3, "s", "our choice: slower than Betaflight's 9, 10, 14 ms in roll, pitch, yaw")
    thrust_lag: float = quantity(30e-3, "s", "our choice: motor and propeller, first order")
    mocap_latency: float = quantity(1.0 / 240.0, "s", "our choice: exposure to delivery, one frame", zero=True)
    estimation_latency: float = quantity(0.1, "s", "our choice: from request to delivery of an estimate", zero=True)
    vehicle_origin: str = quantity(
        "frame", "-", "our choice: the vehicle's tracked point: 'frame', below the seat, or 'seat'", before="seat"
    )
    position_noise: float = quantity(0.2e-3, "m", "our choice: standard deviation per axis of a body", zero=True)
    attitude_noise: float = quantity(1e-3, "rad", "our choice: standard deviation per axis of a body", zero=True)
    initial_lean: float = quantity(3e-3, "m", "our choice: standard deviation of a, b at the start", zero=True)
    # options, off by default: see kernels.disturbance
    wind: tuple[float, float] = quantity((0.0, 0.0), "m/s", "steady wind (x, y)", within=(-20, 20), before=(0.0, 0.0))
    gusts: float = quantity(0.0, "m/s", "standard deviation of the gusts per axis", within=(0, 20), before=0.0)
    drag: tuple[float, float] = quantity(
        (0.26, 8e-3), "N s/m", "of vehicle (Faessler 2018: 0.46/s) and rod (6 mm, 2 m/s) in wind", within=(0, 10),
        before=(0.26, 8e-3),
    )  # fmt: skip
    rotor_loss: float = quantity(0.0, "1", "share that a hindered rotor lacks", within=(0, 1), before=0.0)
    rotor_loss_start: float = quantity(0.0, "s", "time from which on it is hindered", zero=True, before=0.0)
    battery_sag: float = quantity(0.0, "1/s", "share of the thrust lost per second", within=(0, 1), before=0.0)


@dataclass(frozen=True)
class Groups:
    """The base of a frozen dataclass whose fields are groups of parameters, dataclasses themselves.

    A subclass names in ``ELSEWHERE`` the groups of a bag's parameters that are not its own.
    """

    ELSEWHERE: ClassVar[frozenset[str]] = frozenset()

    def replace(self, **changes: Any) -> Self:
        """Return a copy with some fields changed, each named ``group__field``: ``replace(pendulum__length=0.8)``.

        Raises:
            ValueError: a name is not a parameter, or a value is not of its kind; the message says what is.
        """
        groups: dict[str, dict[str, Any]] = {}
        for name, value in changes.items():
            group, _, key = name.partition("__")
            if key not in getattr(getattr(self, group, None), "__dataclass_fields__", ()):
                known = [f"{name}__{key}" for name, keys in self.to_dict(complete=True).items() for key in keys]
                raise ValueError(f"unknown parameter {name!r}; parameters are {', '.join(known)}")
            groups.setdefault(group, {})[key] = _checked(f"{group}.{key}", value, getattr(self, group), key)
        changed = {group: dataclasses.replace(getattr(self, group), **values) for group, values in groups.items()}
        for name, group in changed.items():
            for key, low in ((one.name, one.metadata["above"]) for one in dataclasses.fields(group)):
                if low and not getattr(group, low) < getattr(group, key):
                    numbers = f"{getattr(group, key):g} and {getattr(group, low):g}"
                    raise ValueError(f"{name}.{key} must be above {name}.{low}, not {numbers}")
        return dataclasses.replace(self, **changed)

    def to_dict(self, complete: bool = False) -> dict[str, dict[str, Any]]:
        """Return a plain nested dictionary, ready for JSON (an infinite number becomes the string ``"inf"``).

        Unless ``complete``, a parameter that has the value that held before it existed is absent: a new one changes no
        older flight.
        """

        def plain(value: Any) -> Any:
            if isinstance(value, tuple):
                return [plain(item) for item in value]
            return "inf" if value == math.inf else value

        groups = {group.name: getattr(self, group.name) for group in dataclasses.fields(self)}
        return {
            name: {
                known.name: plain(value)
                for known in dataclasses.fields(group)
                if (value := getattr(group, known.name)) != known.metadata["before"] or complete
            }
            for name, group in groups.items()
        }

    @classmethod
    def from_dict(cls, values: dict[str, dict[str, Any]]) -> Self:
        """Return the inverse of ``to_dict``; parameters that are absent have the value that held before there were any.

        Groups that are absent have their defaults.

        Raises:
            ValueError: a group or field is not known here, and the group not one of ``ELSEWHERE``.
        """
        own = {group: fields for group, fields in values.items() if group not in cls.ELSEWHERE}
        for group in dataclasses.fields(cls):
            older = {f.name: f.metadata["before"] for f in dataclasses.fields(getattr(cls, group.name))}
            if group.name in own:
                own[group.name] = {k: v for k, v in older.items() if v is not None} | own[group.name]
        return cls().replace(
            **{f"{group}__{key}": _parsed(value) for group, fields in own.items() for key, value in fields.items()}
        )


@dataclass(frozen=True)
class Params(Groups):
    """All parameters of the paper's system. ``replace`` changes some of them; ``to_dict`` is what a bag carries.

    A bag of a flight behind the failsafe carries the two groups of ``flight.limits`` beside them.
    """

    ELSEWHERE: ClassVar = frozenset({"safety", "radio"})

    vehicle: Vehicle = Vehicle()
    pendulum: Pendulum = Pendulum()
    control: Control = Control()
    estimation: Estimation = Estimation()
    piloting: Piloting = Piloting()
    simulation: Simulation = Simulation()

    @property
    def seat_above_tracked(self) -> float:
        """Height of the seat above the point that motion capture reports as the vehicle, m: the simulator's truth."""
        origin = self.simulation.vehicle_origin
        if origin not in ("frame", "seat"):
            raise ValueError(f"simulation.vehicle_origin must be 'frame' or 'seat', not {origin!r}")
        return self.vehicle.seat_height if origin == "frame" else 0.0


def _parsed(value: Any) -> Any:
    if isinstance(value, list):
        return tuple(map(_parsed, value))
    return math.inf if value == "inf" else value


def _checked(name: str, value: Any, group: Any, key: str) -> Any:
    """Return the value, if it is of the same kind as the one it replaces; numbers as float, lists as tuple."""
    current, metadata = getattr(group, key), group.__dataclass_fields__[key].metadata

    def number(item: Any, kinds: Any = int | float) -> bool:
        good = isinstance(item, kinds) and not isinstance(item, bool)
        return good and (low <= item <= high or (item == 0 and metadata["zero"]))

    low, high = metadata["within"]
    span = f"from {low:g} to {high:g} ({metadata['unit']}){', or 0' if metadata['zero'] and low > 0 else ''}"
    if isinstance(current, bool | str):
        kind, good = "true or false" if isinstance(current, bool) else "a word", isinstance(value, type(current))
    elif isinstance(current, tuple):
        kind = f"{len(current)} numbers {span}"
        good = isinstance(value, list | tuple) and len(value) == len(current) and all(map(number, value))
        value = tuple(map(float, value)) if good else value
    else:
        kind = f"a {'whole ' if isinstance(current, int) else ''}number {span}"
        good = number(value, int if isinstance(current, int) else int | float)
        value = type(current)(value) if good else value
    if not good:
        raise ValueError(f"{name} must be {kind}, not {value!r}")
    return value


def assignment(text: str) -> tuple[str, Any]:
    """Return ``group.name=value`` as a keyword of ``Groups.replace``; a value that is no Python literal is a string."""
    name, equals, value = text.partition("=")
    if not equals:
        raise ValueError(f"--set {text}: write GROUP.NAME=VALUE, for example pendulum.length=0.8")
    try:
        parsed = ast.literal_eval(value)
    except (ValueError, SyntaxError):
        parsed = float(value) if value in ("inf", "-inf") else value
    return name.replace(".", "__", 1), parsed
