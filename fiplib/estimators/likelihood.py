"""The recommended length estimator: maximum likelihood on a window of raw motion capture.

A window is taken for a deterministic trajectory seen through the noise of motion capture; the length that makes the
residuals smallest is the maximum-likelihood estimate. The trajectory comes from the coupled plant
(``dynamics.coupled_plant``) with two exact rearrangements. With u = (F/M) R e3 the specific thrust, M = m + m_p,
mu = m_p / M, r = l/2 and kappa = M / (m + m_p (1 - lambda)):

    common centre of mass:  (p + mu r q)'' = u - g e3                            (no length in it)
    rod:                     q''           = -|q'|^2 q - (lambda kappa / r) (u - q (q . u))

Per axis, with a = r q_x, the rod reads a'' = w^2 a - lambda kappa u_x + d, w^2 = lambda kappa g / r, where d gathers
what is of second order. Three facts make the fit short and fast:

- The tilt follows from the commands through the known delay and lag, the thrust likewise; two unknowns per axis (tilt
  and body rate at the first frame) remain. Both are known so well from the attitude alone that u may be linearised.
- d and the kinematic map need the trajectory only roughly: a local polynomial through the measurements serves. Over
  2.5 s, for which this is made and measured, its error is far below the noise; it does not shrink as windows grow, and
  from 5 s on the stated deviation is too small (notebook 08 shows it).
- Given the length, all else is then linear in a few unknowns per axis, solved by QR (variable projection). The unstable
  mode is integrated backwards in time, so nothing grows: windows of any length are well conditioned.

What no laboratory knows is not taken for known:

- *Calibration.* Where the rod's centre of mass lies beside its markers, and how the vehicle's body frame is turned
  against its thrust, are two constants per axis, fitted too. Taken for exact, a tenth of a millimetre of the first
  would pass for a centimetre of length (the study ``imperfections``).
- *Thrust* is weighed against gravity by how the vehicle rises and sinks: the length goes with it.
- *The inner loop.* Where the noise of motion capture does not explain the window, the tilt may drift from
  the commanded one as a random walk, whose variance is estimated by maximum likelihood (``WindowModel.likely_wander``).
  Commands that come a little late or early do that, and so does real firmware.

The height of the pendulum's centre of mass is not used. Half the length could be read off it at once, in the simulator
as in a laboratory whose motion capture knows where the centre of mass is; the paper's states do not hold it either.
"""

import math
from collections.abc import Sequence
from functools import partial

import numpy as np
import scipy  # its parts are imported when they are first used: they take a second
from numpy.typing import ArrayLike, NDArray

from fiplib.estimators.base import Estimate
from fiplib.estimators.signals import first_order, local_parabola
from fiplib.estimators.windows import LEAD, RawWindow
from fiplib.params import GRAVITY, Params

CALIBRATION = "calibration"
NUISANCES = (CALIBRATION, "inertia_factor", "rate_lag")
"""What may be fitted beside the length: how the markers sit (above), lambda of the rod, and the first-order lag of
the inner loop in s."""

SUBSTEPS = 2
"""Steps of the integration to a frame: with forces linear over 1 ms the trajectory is right to 1e-6 of its size."""

SMOOTHING = 0.1
"""Span in s of the local parabola through measurements, for the terms of second order."""

STARTS = 6
"""Lengths, evenly spread in their logarithm, of which the best starts the search: the likelihood has one broad valley,
but ends of the interval can be flat."""

LARGEST_SPREAD = 0.1
"""Refused above this standard deviation relative to the length: the likelihood is then no longer close to a parabola
over its own width (w goes with l^-1/2, so +-2 sd asks for +-10 % in w), and the stated interval would not hold."""

LARGEST_MISFIT = 4.0
"""Refused above this mean squared residual over the stated noise: the model misses something, a push for example. Pure
noise stays below 1.1 with 3600 residuals; up to here the standard deviation is inflated by the misfit's root."""

BY_CHANCE = 4.0
"""Standard deviations of the mean squared residual within which noise alone explains it: 1.1 with 3600 residuals."""

KNOT = 0.1
"""Steps of the tilt's wandering, s: faster than the rod falls, slower than the attitude is noisy."""

LARGEST_WANDER = 0.1
"""Of the steps, rad: 6 deg in each ``KNOT``, far beyond what an inner loop errs by."""

ASSUMED = (
    "masses, the rod's inertia, noise, delays and lags are those of the flight's parameters, commands acted as sent, "
    "and the rod stands in the vehicle's tracked point"
)
"""What ``maximum_likelihood`` takes for granted, where it is asked."""


def maximum_likelihood(
    window: RawWindow,
    params: Params,
    rng: np.random.Generator | None = None,
    nuisances: tuple[str, ...] = (CALIBRATION,),
) -> Estimate:
    """The length that explains a raw window best, and how sure that is.

    ``params`` give the known vehicle (masses, delay, lags, full thrust), the rod's mass and gyration ratio, the noise
    of motion capture, and the interval of lengths; the rod's length is not read. ``nuisances``, names out of
    ``NUISANCES``, are fitted too, instead of taken from ``params``, or for exact. The standard deviation comes from the
    curvature of the profile likelihood. Raises ValueError: an unknown nuisance, or fewer than 16 frames.
    """
    if unknown := set(nuisances) - set(NUISANCES):
        raise ValueError(f"unknown nuisance {', '.join(sorted(unknown))}; there are {', '.join(NUISANCES)}")
    model = WindowModel(window, params, calibrated=CALIBRATION not in nuisances)
    nuisances = tuple(name for name in nuisances if name != CALIBRATION)
    low, high = model.lengths
    known = {"inertia_factor": params.pendulum.inertia_factor, "rate_lag": params.simulation.rate_lag}

    starts = np.geomspace(low, high, STARTS)
    fit, length, misfit = _fit(model, starts, known, nuisances)
    if misfit > 1 + BY_CHANCE * math.sqrt(2 / len(fit.fun)):
        for again, tolerance in ((starts, 1e-3), ([], 1e-6)):  # the length moves what is left over, and that the length
            model.wander = model.likely_wander(length, **known)
            fit, length, misfit = _fit(model, [*again, length], known, nuisances, tolerance)
    information = fit.jac.T @ fit.jac
    with np.errstate(divide="ignore", invalid="ignore"):
        known_at_all = np.linalg.cond(information) < 1e12 and information[0, 0] > 0
    spread = math.sqrt(np.linalg.inv(information)[0, 0] * max(1.0, misfit)) if known_at_all else math.inf
    if misfit > LARGEST_MISFIT:
        reason = f"the model does not explain the window: residuals are {math.sqrt(misfit):.1f} times the stated noise"
    elif spread > LARGEST_SPREAD:
        found = f"{100 * spread:.0f} %" if spread < 1 else "more than 100 %"
        reason = (
            f"too little information: the standard deviation would be {found} of the length, "
            f"not below {100 * LARGEST_SPREAD:.0f} %"
        )
    elif not low < length < high:
        reason = f"the best length lies at an end of the interval from {low:g} to {high:g} m"
    else:
        return Estimate(length, length * spread)
    return Estimate(math.nan, math.nan, reason)


maximum_likelihood_calibrated = partial(maximum_likelihood, nuisances=())
"""``maximum_likelihood`` that takes the calibration of motion capture for exact."""

maximum_likelihood_free = partial(maximum_likelihood, nuisances=NUISANCES)
"""``maximum_likelihood`` that fits all of ``NUISANCES``."""


def _fit(
    model: "WindowModel",
    starts: Sequence[float],
    known: dict[str, float],
    nuisances: tuple[str, ...],
    tolerance: float = 1e-6,
) -> tuple["scipy.optimize.OptimizeResult", float, float]:
    """The least-squares fit, in logarithms about the best start; its length in m, and its mean squared residual.

    ``tolerance`` is that of the search in these logarithms; the default is a thousandth of any standard deviation.
    """
    first = min(starts, key=lambda start: float(np.sum(model.residuals(start, **known) ** 2)))
    scale = np.array([first, *(known[name] for name in nuisances)])
    low, high = model.lengths

    def residuals(x: NDArray) -> NDArray:
        # logarithms about the start, shifted to 1 as least_squares steps in proportion to x; half of l_min and twice
        # l_max are far enough to see that an optimum lies outside
        values = scale * np.exp(np.clip(x - 1, -20, 3))
        values[0] = min(max(values[0], low / 2), high * 2)
        return model.residuals(values[0], **known | dict(zip(nuisances, values[1:], strict=True)))

    # central differences of 1e-4 in the logarithm: their errors, 1e-8 and 1e-12 / 1e-4, are far below the noise
    fit = scipy.optimize.least_squares(
        residuals, np.ones(len(scale)), method="lm", jac="3-point", diff_step=1e-4, xtol=tolerance
    )
    length = float(first * math.exp(min(fit.x[0] - 1, 3)))
    return fit, length, 2 * fit.cost / (model.measured - model.unknowns - len(fit.x))


class WindowModel:
    """All of a raw window that does not depend on the length, ready for ``residuals``.

    ``params`` give the known vehicle and the noise of motion capture; ``calibrated`` says that markers and body frame
    sit exactly where they are said to.

    Attributes:
        measured, unknowns: how many numbers were measured, and how many linear unknowns there are beside ``wander``'s.
        lengths: the interval of lengths, m.
    """

    def __init__(self, window: RawWindow, params: Params, calibrated: bool = False) -> None:
        frames = len(window.time)
        if frames < 16:
            raise ValueError(f"a window of raw motion capture needs at least 16 frames, got {frames}")
        self._window, self._params = window, params
        simulation = params.simulation
        period = (window.time[-1] - window.time[0]) / (frames - 1)
        self._step = period / SUBSTEPS
        self._time = np.arange((frames - 1) * SUBSTEPS + 1) * self._step
        position = np.clip((window.time - window.time[0]) / self._step, 0, len(self._time) - 1)
        self._index = np.minimum(np.round(position, 9).astype(int), len(self._time) - 2)
        self._part = position - self._index
        # a noise of zero would leave the weights undefined; nothing real is better than a micrometre
        self._weights = 1 / np.maximum([simulation.position_noise, simulation.attitude_noise], 1e-6)

        span = max(5, round(SMOOTHING / period) // 2 * 2 + 1)
        span = min(span, (frames - 1) // 2 * 2 + 1)
        lean = (window.pendulum - window.vehicle)[:, :2]

        def smooth(values: NDArray, derivative: int = 0) -> NDArray:
            smoothed = local_parabola(values, span, period, derivative).T
            return np.array([np.interp(self._time, window.time - window.time[0], row) for row in smoothed])

        self._lean, self._lean_rate = smooth(lean), smooth(lean, 1)
        self._attitude = smooth(window.attitude)
        total = params.vehicle.mass + params.pendulum.mass
        self._share = params.pendulum.mass / total
        scale = params.vehicle.max_thrust / total
        self._thrust = scale * self._lagged(window.command[:, 2], simulation.thrust_lag)[0]
        self._thrust *= self._weighed()
        self._lag: float | None = None
        self.measured, self.unknowns = 6 * frames, 12 if calibrated else 16
        offsets = np.zeros((0 if calibrated else 2, 3, frames))  # columns by what is measured: vehicle, pendulum, tilt
        if not calibrated:
            offsets[0, 1], offsets[1, 2] = self._weights
        self._offsets = offsets.reshape(len(offsets), 3 * frames).T
        self.lengths = params.estimation.length_min, params.estimation.length_max
        self.wander = 0.0

    @property
    def wander(self) -> float:
        """Standard deviation of the tilt's unexplained step in each ``KNOT``, rad; 0: commands explain it all."""
        return self._wander

    @wander.setter
    def wander(self, deviation: float) -> None:
        self._wander, self._lag = deviation, None
        knots = np.arange(0.0, self._time[-1], KNOT) if deviation > 0.0 else np.zeros(0)
        self._ramps = np.clip((self._time - knots[:, None]) / KNOT, 0.0, 1.0)

    def likely_wander(self, length: float, inertia_factor: float, rate_lag: float) -> float:
        """The ``wander`` that makes the errors at this length most likely, every other unknown integrated out."""
        self.wander = LARGEST_WANDER
        self._force(rate_lag)
        shares = []
        for axis in (0, 1):
            design, error = self._system(axis, length, inertia_factor)
            rows, fixed = 3 * len(self._window.time), design.shape[1] - len(self._ramps)
            basis, _ = np.linalg.qr(design[:rows, :fixed])
            left, sizes, _ = np.linalg.svd(
                design[:rows, fixed:] - basis @ (basis.T @ design[:rows, fixed:]), full_matrices=False
            )
            # prior rows: their errors are minus the steps that the attitude alone asks for, over their deviation
            start = design[:rows, fixed:] @ (-LARGEST_WANDER * error[rows:])
            shares.append((sizes**2, (left.T @ (error[:rows] + start)) ** 2))
        sizes, shares = (np.concatenate(parts) for parts in zip(*shares, strict=True))

        def minus_twice_log_likelihood(logarithm: float) -> float:
            grown = 1 + math.exp(2 * logarithm) * sizes
            return float(np.sum(shares / grown + np.log(grown)))

        bounds = math.log(1e-4 * LARGEST_WANDER), math.log(LARGEST_WANDER)
        return math.exp(scipy.optimize.minimize_scalar(minus_twice_log_likelihood, bounds=bounds, method="bounded").x)

    def residuals(self, length: float, inertia_factor: float, rate_lag: float) -> NDArray:
        """Whitened residuals of both axes at the best initial state for this length and these nuisances.

        (6 n,), and with ``wander`` one more for each step of each axis: its size over its standard deviation.
        """
        if self._lag != rate_lag:
            self._lag = rate_lag
            self._force(rate_lag)
        left = []
        for axis in (0, 1):
            design, error = self._system(axis, length, inertia_factor)
            basis, _ = np.linalg.qr(design)
            left.append(error - basis @ (basis.T @ error))
        return np.concatenate(left)

    def _weighed(self) -> float:
        """Real over stated thrust, from how the vehicle rises and sinks.

        Batteries sag and no thrust curve is exact, while the length found goes with the thrust: 1 % of it is 1 %.
        """
        time, (phi, theta, _) = self._window.time - self._window.time[0], self._attitude
        lift = self._sample(_twice_integrated(self._thrust * np.cos(phi) * np.cos(theta), self._step))
        design = np.column_stack([np.ones_like(time), time, lift])
        fallen = self._window.vehicle[:, 2] + GRAVITY / 2 * time**2
        return float(np.linalg.lstsq(design, fallen, rcond=None)[0][2])

    def _lagged(self, command: NDArray, lag: float) -> tuple[NDArray, NDArray]:
        """A command through delay and lag: its value on the grid (n,), and its mean over each step (n - 1,)."""
        before = math.ceil(LEAD / self._step)
        edges = np.arange(-before, len(self._time)) * self._step
        acts = self._window.command_time - self._window.time[0] + self._params.simulation.rate_delay
        held = np.clip(np.searchsorted(acts, edges + 1e-9, side="right") - 1, 0, None)
        # exact integral of the held command, so that edges need not fall on the grid
        integral = np.concatenate([[0.0], np.cumsum(command[:-1] * np.diff(acts))])
        integral = integral[held] + command[held] * (edges - acts[held])
        mean = np.diff(integral) / self._step
        decay = math.exp(-self._step / max(lag, 1e-6))
        value = first_order(mean, 1 - decay, decay, start=decay * mean[0])
        value = np.concatenate([[mean[0]], value])
        # lag * v' = command - v, integrated over a step
        mean = mean - lag * np.diff(value) / self._step
        return value[before:], mean[before:]

    def _force(self, lag: float) -> None:
        """Tilts, and the specific thrust u along x and y, with their sensitivities to the two unknowns of each axis."""
        window, step = self._window, self._step
        roll_rate, pitch_rate = (self._lagged(window.command[:, column], lag)[1] for column in (0, 1))
        phi, theta, psi = ((row[1:] + row[:-1]) / 2 for row in self._attitude)
        # rates of the angles of R = Rx Ry Rz
        speeds = (
            (roll_rate * np.cos(psi) - pitch_rate * np.sin(psi)) / np.cos(theta),
            roll_rate * np.sin(psi) + pitch_rate * np.cos(psi),
        )
        transient = -np.expm1(-self._time / max(lag, 1e-6))
        basis = np.array([np.ones_like(self._time), transient, *self._ramps])
        self._tilt_columns = self._weights[1] * self._sample(basis).T
        prior = np.eye(len(basis))[2:] / max(self._wander, 1e-12)
        tilts, self._tilt_residuals, self._steps = [], [], []
        for axis, speed in enumerate(speeds):
            forced = np.concatenate([[0.0], np.cumsum(speed) * step])
            error = self._weights[1] * (window.attitude[:, axis] - self._sample(forced))
            best, *_ = np.linalg.lstsq(
                np.vstack([self._tilt_columns, prior]), np.concatenate([error, np.zeros(len(prior))]), rcond=None
            )
            tilts.append(forced + best @ basis)
            self._tilt_residuals.append(error - self._tilt_columns @ best)
            self._steps.append(prior @ best)
        self._prior = prior
        phi, theta = tilts
        self._u = self._thrust * np.array([np.sin(theta), -np.sin(phi) * np.cos(theta), np.cos(phi) * np.cos(theta)])
        slopes = self._thrust * np.cos(theta) * np.array([np.ones_like(theta), -np.cos(phi)])
        self._forces = [np.array([self._u[axis], *(slopes[axis] * basis)]) for axis in (0, 1)]
        self._travel = [self._sample(_twice_integrated(force, step)) for force in self._forces]

    def _system(self, axis: int, length: float, inertia_factor: float) -> tuple[NDArray, NDArray]:
        """What is linear in the unknowns of one axis: their whitened columns, and the errors without them.

        Rows are vehicle, pendulum, tilt, steps; axis 0 is x with pitch, 1 is y with roll.
        """
        r, window, step = length / 2, self._window, self._step
        stiff = inertia_factor / (1 - self._share * inertia_factor)  # lambda kappa
        w = math.sqrt(stiff * GRAVITY / r)
        q, q_rate = self._lean / r, self._lean_rate / r
        upright = np.sqrt(np.maximum(1 - np.sum(q**2, axis=0), 0.0))
        along = q[0] * self._u[0] + q[1] * self._u[1] + upright * self._u[2]
        spin = np.sum(q_rate**2, axis=0)  # |q'|^2 up to the fourth order
        source = -stiff * self._forces[axis]
        source[0] += (stiff * (along - GRAVITY) / r - spin) * self._lean[axis]
        response = self._sample(_unstable(source, w, step))
        time = window.time - window.time[0]
        modes = np.array([np.exp(-w * time), np.exp(w * (time - time[-1]))])
        travel = self._travel[axis]
        zero, pair = np.zeros_like(time), np.array([np.ones_like(time), time])
        tilt = axis ^ 1  # the pitch moves x, the roll moves y
        rows, errors = [], []
        for seen, share in ((window.vehicle, -self._share), (window.pendulum, 1 - self._share)):
            rows.append(self._weights[0] * np.vstack([pair, share * modes, travel[1:] + share * response[1:]]).T)
            errors.append(self._weights[0] * (seen[:, axis] - travel[0] - share * response[0]))
        rows.append(np.column_stack([zero, zero, zero, zero, self._tilt_columns]))
        design = np.hstack([self._offsets, np.concatenate(rows)])
        prior = np.zeros((len(self._prior), design.shape[1]))
        prior[:, design.shape[1] - self._prior.shape[1] :] = self._prior
        return np.vstack([design, prior]), np.concatenate([*errors, self._tilt_residuals[tilt], -self._steps[tilt]])

    def _sample(self, values: NDArray) -> NDArray:
        """From the grid (..., n) to the frames."""
        before, after = values[..., self._index], values[..., self._index + 1]
        return before + self._part * (after - before)


def _twice_integrated(force: NDArray, step: float) -> NDArray:
    """x of x'' = force, from rest, for forces (..., n) linear over each step."""
    before, after = force[..., :-1], force[..., 1:]
    speed = np.zeros_like(force)
    speed[..., 1:] = np.cumsum(before + after, axis=-1) * (step / 2)
    travel = np.zeros_like(force)
    travel[..., 1:] = np.cumsum(speed[..., :-1] * step + (2 * before + after) * (step**2 / 6), axis=-1)
    return travel


def _unstable(source: ArrayLike, w: float, step: float) -> NDArray:
    """A solution of a'' = w^2 a + source (..., n), linear over each step, that grows in neither direction of time.

    a = (b - f) / (2 w) with f' = -w f + source, integrated forwards, and b' = w b + source, integrated backwards.
    """
    z = w * step
    decay = math.exp(-z)
    last = (z - 1 + decay) / (w * z)
    before = (1 - decay) / w - last
    forwards = first_order(source, last, decay, before)
    backwards = first_order(np.flip(source, axis=-1), last, decay, before)
    return -(forwards + np.flip(backwards, axis=-1)) / (2 * w)
