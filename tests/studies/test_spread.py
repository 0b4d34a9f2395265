"""The spread over seeds: its rows are flights like those that ``data/`` records, and its bands are quantiles."""

import math
from pathlib import Path

import numpy as np
import pytest

from fiplib import bags
from fiplib.reproduction import bands, measures, sources
from fiplib.studies import spread

DATA = Path(__file__).parents[2] / "data"


@pytest.mark.parametrize(("scenario", "seed"), list(zip(spread.STARTS, (1, 2, 3), strict=True)))
def test_the_recorded_flight_is_one_of_those_in_the_table(scenario, seed):
    [row] = [row for row in sources.read("spread", DATA) if (row["scenario"], row["seed"]) == (scenario, seed)]
    flight = bags.read(DATA / scenario)
    times, used = measures.used_length(flight)
    recorded = used[np.searchsorted(times, bands.TIMES, side="right") - 1]
    # rounded to 10 um
    assert np.abs(bands.values([row], "used")[0] - recorded).max() < 1e-5
    assert row["survived"] == 1 and row["flown"] == 25.0


def test_a_row_is_that_of_the_committed_table():
    [known] = [row for row in sources.read("spread", DATA) if (row["scenario"], row["seed"]) == ("estimate-1.2", 2)]
    row = spread.run({"scenario": "estimate-1.2", "seed": 2})
    assert {**known} == pytest.approx({"scenario": "estimate-1.2", "seed": 2} | row, abs=2e-5, nan_ok=True)
    assert math.isnan(row["estimate_5.01"]) and 0.8 < row["estimate_6.01"] < 1.0  # the first window is full at 5.5 s
    assert math.isnan(row["pose_length_2.01"]) and abs(row["pose_length_3.01"] - 1.0) < 0.03


def test_a_band_holds_the_quantiles_of_those_that_have_a_value_where_most_do():
    found = np.full((20, len(bands.TIMES)), math.nan)
    found[:, 5:] = np.arange(20.0)[:, None]
    found[:15, 7] = math.nan
    band = bands.band(found)
    assert list(band.time[:3]) == [bands.TIMES[5], bands.TIMES[6], bands.TIMES[8]]
    assert (band.low[0], band.middle[0], band.high[0]) == pytest.approx((0.95, 9.5, 18.05))
