"""Why a known seat costs the paper's estimator accuracy: the one-step error of its model, and noise recomputed from it.

A case is one simulated flight of the 0.4 m circle with a uniform rod of known length, the seat at the tracked frame or
8 cm above it; the pilot knows which. The prediction model describes the motion of a seat at the centre of mass. How far
one sample after another is from it, is measured on the true states; Q_e should be the variance of that error. Every
window is searched exhaustively with the default Q_e and with the variances found on the same flight. About a minute.
"""

import numpy as np
from numpy.typing import NDArray

from fiplib.dynamics import prediction_model, rk4
from fiplib.estimators.grid import best_length
from fiplib.params import A, B, Params, X, Y
from fiplib.recording import Flight
from fiplib.references import Circle
from fiplib.reproduction.measures import rms
from fiplib.reproduction.sources import Rows
from fiplib.reproduction.tables import Facts
from fiplib.simulate import Scenario
from fiplib.studies.batch import fly_many
from fiplib.studies.estimators import DURATION, windows_of

KEYS = ("seat", "seed")

SEATS, SEEDS = (0.0, 0.08), range(20)
"""Height of the seat above the vehicle's tracked frame, m."""

CIRCLE = Circle(0.4, 8.0)

NOISES = ("default", "recomputed")
"""Where Q_e is from."""


def cases() -> list[dict]:
    """Both seats, over ``SEEDS``."""
    return [{"seat": seat, "seed": seed} for seat in SEATS for seed in SEEDS]


def run(case: dict) -> dict[str, float | int]:
    """Fly the case and search its windows.

    Returns:
        position and offset, the mean square of the one-step errors over their default Q_e, mean of x and y, and of a
        and b; n, the number of windows; for each of ``NOISES`` bias and rms, mean and root mean square error of the
        best length, m.
    """
    params = Params().replace(vehicle__seat_height=case["seat"], piloting__seat_height=case["seat"])
    scenario = Scenario("step errors", "", DURATION, CIRCLE, params=params, seed=90_000 + int(case["seed"]))
    [flight] = fly_many([scenario])
    found = one_step_errors(flight).var(axis=0)
    ratio = found / np.array(params.estimation.process_noise)
    _, windows = windows_of(flight)["states"]
    row: dict[str, float | int] = {
        "position": float(ratio[[X, Y]].mean()), "offset": float(ratio[[A, B]].mean()), "n": len(windows),
    }  # fmt: skip
    recomputed = params.replace(estimation__process_noise=tuple(found.tolist()))
    for noise, chosen in zip(NOISES, (params, recomputed), strict=True):
        errors = [best_length(window, chosen) - params.pendulum.length for _, window in windows]
        row |= {f"bias_{noise}": float(np.mean(errors)), f"rms_{noise}": rms(errors)}
    return row


def true_states(flight: Flight) -> NDArray:
    """Return the true state (n, 10) of the moment at which each recorded state was seen; of a simulated flight."""
    exposed = flight.time(flight.state) - flight.params.simulation.mocap_latency
    return flight.truth_state.values[np.searchsorted(flight.time(flight.truth_state), exposed - 1e-6), :10]


def one_step_errors(flight: Flight) -> NDArray:
    """Return by how much the prediction model is wrong after each sample of the estimator's window, (n, 10).

    It starts from the true state and is given the mean of the rates commanded since.
    """
    params, true, rates = flight.params, true_states(flight), flight.command.values[:, :2]
    ticks = round(params.estimation.sample_period * params.piloting.control_rate)
    model = rk4(prediction_model(), params.estimation.sample_period)
    return np.array([
        true[start + ticks]
        - np.array(model(true[start], rates[start : start + ticks].mean(0), params.pendulum.length)).ravel()
        for start in range(0, len(true) - ticks, ticks)
    ])  # fmt: skip


def facts(rows: Rows) -> Facts:
    """Return what the report states: how much larger the errors are than Q_e, and of each Q_e bias and RMS error."""
    found: Facts = {("flights",): f"{len(SEEDS)}"}
    for seat, word in zip(SEATS, ("frame", "raised"), strict=True):
        some = [row for row in rows if row["seat"] == seat]
        weights = np.array([row["n"] for row in some])
        for name in ("position", "offset"):
            values = [row[name] for row in some]
            found |= {
                (word, name): f"{np.mean(values):.1f}",
                (word, name, "least"): f"{min(values):.1f}",
                (word, name, "most"): f"{max(values):.1f}",
            }
        for noise in NOISES:
            bias, error = (np.array([row[f"{column}_{noise}"] for row in some]) for column in ("bias", "rms"))
            found |= {
                (word, noise, "bias"): f"{1e3 * (weights @ bias) / weights.sum():.0f}",
                (word, noise, "rms"): f"{1e3 * np.sqrt(weights @ error**2 / weights.sum()):.0f}",
            }
    return found
