"""The Cramer-Rao bound: what must hold of any bound, and that an efficient estimator really scatters like it."""

import dataclasses
from functools import cache

import numpy as np
import pytest

from fiplib.dynamics import coupled_plant, rk4
from fiplib.estimators import cramer_rao as bound
from fiplib.estimators.cramer_rao import CALIBRATION, NUISANCES, Motion, cramer_rao, motion
from fiplib.params import NANO, Params
from fiplib.recording import BagError, Flight
from fiplib.references import Circle, Hover
from fiplib.simulate import Scenario, fly
from fiplib.studies import bounds

PARAMS = Params()
NO_SEAT = PARAMS.replace(vehicle__seat_height=0.0, piloting__seat_height=0.0)
"""What ``likelihood`` models: it knows nothing of a seat above the vehicle's centre of mass."""


@cache
def flown(kind: str = "circle", seconds: float = 7.0, params: Params = PARAMS) -> Flight:
    reference = {"circle": Circle(0.4, 8.0, ramp=2.0), "wide": Circle(0.8, 9.0, ramp=2.0), "hover": Hover()}[kind]
    flight = fly(Scenario(kind, "", seconds, reference, params=params, seed=11))
    assert flight.survived
    return flight


def stretch(kind: str = "circle", start: float = 4.0, seconds: float = 2.5) -> Motion:
    flight = flown(kind)
    first = flight.start_ns + round(start * NANO)
    return motion(flight, first, first + round(seconds * NANO))


def test_the_reconstructed_motion_obeys_the_plant() -> None:
    """Truth is recorded in ten states; what the bound adds to them (quaternion, rates, thrust) must fit together."""
    whole = motion(flown(), flown().start_ns + NANO)
    step = rk4(coupled_plant(PARAMS), whole.period).map(len(whole.states) - 1)
    after = np.array(step(whole.states[:-1].T, whole.commands[:-1].T, np.zeros((3, len(whole.states) - 1)))).T
    errors = np.abs(after - whole.states[1:])
    # x, y and the rod are exact but for the yaw, taken as zero: it turns a tilt of 0.1 rad by some mrad
    assert errors[:, [0, 1, 10, 11]].max() < 1e-5
    assert errors[:, [3, 4, 13, 14]].max() < 2e-4
    assert errors[:, 6:8].max() < 1e-4
    # rates and thrust: RK4 at 1/240 s against the exact lag, (0.28)^5 / 120 = 1e-5 of a step of the command
    assert errors[:, 16:].max() < 1e-3


def test_longer_windows_less_noise_and_more_excitation_lower_the_bound() -> None:
    limit = cramer_rao(stretch(), PARAMS)
    known = np.isfinite(limit)
    assert known[-590:].all() and (np.diff(limit[known]) <= 1e-12).all()
    louder = PARAMS.replace(simulation__position_noise=0.4e-3, simulation__attitude_noise=2e-3)
    # the information goes with 1/variance when all noise is scaled: exactly twice, up to rounding
    assert cramer_rao(stretch(), louder)[-1] == pytest.approx(2 * limit[-1], rel=1e-6)
    ends = [cramer_rao(stretch(kind), PARAMS)[-1] for kind in ("wide", "circle", "hover")]
    assert ends == sorted(ends) and ends[2] > 3 * ends[1]


def test_what_is_unknown_too_can_only_raise_the_bound() -> None:
    rod, plant = ("inertia_factor",), ("inertia_factor", "rate_lag")
    unknown = ((), rod, plant, (CALIBRATION,), NUISANCES)
    known, inertia, both, calibration, everything = (cramer_rao(stretch(), PARAMS, names)[-1] for names in unknown)
    # 1e-9: rounding, where a nuisance costs nothing
    assert known <= inertia * (1 + 1e-9) and inertia <= both * (1 + 1e-9) and calibration <= everything * (1 + 1e-9)
    assert both < 2 * known, "on the circle, inertia and lag can be told apart from the length"
    assert 2 * known < calibration < everything < 10 * known, "where the markers sit is worth most of what one knows"


def test_offsets_that_are_known_to_be_small_are_as_good_as_known() -> None:
    """The unknown offsets of the calibration, seen once more to 1 nm and 1 nrad, raise the bound no longer."""
    true = stretch()
    rows = bound._measured(true.states, PARAMS, False)

    def seen(*arguments: object) -> np.ndarray:
        known = np.zeros((len(rows), bound.OFFSETS, rows.shape[2]))
        known[0, range(bound.OFFSETS), range(21, 25)] = 1e9
        return np.concatenate([rows, known], axis=1)

    known = cramer_rao(true, PARAMS)[-1]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(bound, "_measured", seen)
        assert cramer_rao(true, PARAMS, (CALIBRATION,))[-1] == pytest.approx(known, rel=1e-4)  # (1 nm / 15 um)^2


def test_the_height_of_the_pendulum_gives_its_length_away() -> None:
    """Height difference r of two points, n times, each to sigma sqrt(2): l = 2 r to 2 sigma sqrt(2/n)."""
    found = cramer_rao(stretch(), PARAMS, pendulum_height=True)
    expected = 2 * PARAMS.simulation.position_noise * np.sqrt(2 / len(found))
    # the vertical motion smooths the vehicle's height a little, and the swinging adds 0.05 % of information
    assert found[-1] == pytest.approx(expected, rel=0.5) and found[-1] < expected * 1.001
    assert found[-1] < cramer_rao(stretch(), PARAMS)[-1] / 20


def test_the_bound_does_not_depend_on_how_its_unknowns_are_exchanged(monkeypatch: pytest.MonkeyPatch) -> None:
    reference = cramer_rao(stretch(), PARAMS)[-1]
    for frames in (6, 10_000):
        monkeypatch.setattr("fiplib.estimators.cramer_rao.REBASE", frames)
        # without any exchange the sensitivities reach e^10: ten digits are left
        assert cramer_rao(stretch(), PARAMS)[-1] == pytest.approx(reference, rel=1e-6)


def test_what_the_bound_cannot_be_computed_for_is_refused_clearly() -> None:
    with pytest.raises(ValueError, match="unknown nuisance wind; there are calibration, inertia_factor, rate_lag"):
        cramer_rao(stretch(), PARAMS, ("wind",))
    with pytest.raises(ValueError, match="noise of position and attitude to be positive"):
        cramer_rao(stretch(), PARAMS.replace(simulation__position_noise=0.0))
    with pytest.raises(BagError, match="true states and the commands"):
        motion(dataclasses.replace(flown(), truth_state=None))


def test_the_study_of_the_bound_falls_with_the_window_and_grows_with_the_noise_of_positions(monkeypatch):
    monkeypatch.setattr(bounds, "WINDOWS", (0.5, 1.0, 2.0))
    monkeypatch.setattr(bounds, "STARTS", (6.0,))
    case = {"excitation": "circle 0.4 m / 8 s", "rod": "uniform", "noise": "default", "knowledge": "plant known"}
    case["seed"] = 1
    assert case in bounds.cases()
    usual, noisy, tall = (
        list(bounds.run(case | changes).values())
        for changes in ({}, {"noise": "positions x 5"}, {"knowledge": "height measured"})
    )
    assert usual == sorted(usual, reverse=True) and min(usual) > 0
    # nearly in proportion: a little of the information is in the attitude, whose noise stays
    assert np.divide(noisy, usual) == pytest.approx([5.0] * 3, rel=0.05)
    assert max(tall) < 0.1 * min(usual), "the height of the centre of mass is half the length"
    bounds.flown.cache_clear()  # its flights were cut to these windows
