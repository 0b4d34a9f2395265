"""The outside check: the turned frame gives the offset that it is computed for, and the table says what is fitted."""

import numpy as np
import pytest

from fiplib.params import X, Y
from fiplib.references import Hover
from fiplib.simulate import Plant, Scenario, fly
from fiplib.studies import flying_pendulum as study


@pytest.mark.parametrize("rod", study.RODS)
def test_the_computed_misalignment_gives_the_reported_offset_in_flight(rod):
    quiet = {f"simulation__{name}": 0.0 for name in ("position_noise", "attitude_noise", "initial_lean")}
    params = study.PARAMS.replace(pendulum__gyration_ratio=study.RODS[rod], **quiet)
    for plant, offset in ((Plant, 0.0), (study.MisalignedPlant, -study.OFFSET)):
        flight = fly(Scenario("", "", 15.0, Hover(), params=params), vehicle=plant)
        # the slowest pole decays with 1.35 1/s; the tangent of 0.4 degrees is its angle to 2e-5
        np.testing.assert_allclose(flight.truth_state.values[-1, [X, Y]], [offset, 0.0], atol=1e-4)


def test_the_offset_grows_with_the_weight_of_the_input():
    """A calmer regulator holds its place less firmly: the same offset needs less misalignment."""
    light, heavy = (study.misalignment(weight) for weight in study.OTHER_WEIGHTS)
    assert light > study.misalignment() > heavy > 0.0


def row(case: dict) -> dict:
    return case | {
        "survived": 1,
        "offset_x": -0.05 - 0.001 * case["seed"],
        "offset_y": 0,
        "error": 0.06,
        "largest": 0.1,
    }


def test_the_table_states_what_is_fitted_and_what_is_tested():
    table = study.table19_flying_pendulum([row(case) for case in study.cases()])
    kinds = {line[0]: line[-1] for line in table.rows}
    assert [name for name, kind in kinds.items() if kind.startswith("fitted")] == [
        *(line[0] for line in table.rows[:3]),
        "Static offset, turned (cm)",
    ]
    assert all(kind == "tested" for name, kind in kinds.items() if "Circle" in name)
    # seeds 0 to 19: mean 5 + 0.95 cm, 1.96 sd / sqrt(20) with sd = 0.1 sqrt(35) cm
    offsets = [line for line in table.rows if line[0] == "Static offset, turned (cm)"]
    assert offsets[0][1:4] == ("about 5", r"6.0 $\pm$ 0.3", r"6.0 $\pm$ 0.3")


def test_a_case_is_pure():
    case = {"rod": "point mass", "misaligned": 1, "period": 3.0, "seed": 5}
    first = study.run(case)
    assert first == study.run(case) and first["survived"] == 1
    assert first["error"] < first["largest"]
