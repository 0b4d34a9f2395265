"""Figures and ledger from bags that lack our topics or metadata: a sentence for what cannot be made, the rest is."""

import dataclasses
import functools
from pathlib import Path

import pytest

from fiplib import bags, products, replay
from fiplib.products import PRODUCTS
from fiplib.recording import BagError, Flight, Series
from fiplib.reproduction import evidence, ledger, quantities
from fiplib.reproduction.claims import CLAIMS
from fiplib.reproduction.sources import read
from fiplib.reproduction.style import styled

DATA = Path(__file__).parents[2] / "data"
ROLES = ("state", "command", "reference", "length", "truth_state", "truth_length")
DRAWN = [name for name, product in PRODUCTS.items() if product.bags and not product.studies]


@functools.cache
def flight(name: str) -> Flight:
    return bags.read(DATA / name)


def first(series: Series, count: int) -> Series:
    return Series(series.stamp[:count], series.values[:count], series.names, series.units)


def without(whole: Flight) -> dict[str, Flight]:
    """The same flight as others may have recorded it, by what it lacks."""
    bare = {"origin": "unknown"}
    found = {role: dataclasses.replace(whole, **{role: None}) for role in ROLES}
    found["everything but poses"] = dataclasses.replace(whole, **dict.fromkeys(ROLES), events=(), metadata=bare)
    found["metadata"] = dataclasses.replace(whole, metadata=bare)
    found["events"] = dataclasses.replace(whole, events=())
    found["a reference that is a word"] = dataclasses.replace(whole, metadata={**bare, "reference": "circle"})
    for role in ROLES:
        if (series := getattr(whole, role)) is not None:
            found[f"all but one {role}"] = dataclasses.replace(whole, **{role: first(series, 1)})
            found[f"the end of {role}"] = dataclasses.replace(
                whole, **{role: first(series, max(1, len(series.stamp) // 2))}
            )
    state = whole.reference
    still = Series(state.stamp, state.values * 0.0, state.names, state.units)
    found["movement"] = dataclasses.replace(whole, reference=still)
    return found


@pytest.mark.parametrize("name", DRAWN)
def test_a_figure_is_made_or_refused_in_one_sentence_that_names_the_bag(name):
    flights = [flight(bag) for bag in PRODUCTS[name].bags]
    made = 0
    for lack, stripped in without(flights[-1]).items():
        if name == "fig10-intervals" and lack not in ("everything but poses", "command", "truth_length", "length"):
            continue  # each takes seconds
        with styled():
            try:
                PRODUCTS[name].load()(*flights[:-1], stripped)
                made += 1
            except BagError as error:
                assert str(stripped.path) in str(error) and "\n" not in str(error), lack
    assert made > 0  # without the truth, say


@pytest.mark.parametrize("claim", [claim for claim in CLAIMS if claim.bags], ids=lambda claim: claim.id)
def test_a_claim_is_judged_or_refused_in_one_sentence_that_names_the_bag(claim, monkeypatch):
    monkeypatch.setattr(replay, "STRIDE", 1000)
    flights = [flight(bag) for bag in claim.bags]
    refused = 0
    tables = [read(study, DATA) for study in claim.studies]
    refits = claim.measure is quantities.printed_best or claim.gather in (evidence.search, evidence.remedy)
    for lack, stripped in without(flights[-1]).items():
        if refits and lack not in ("everything but poses", "command", "all but one state"):
            continue  # each refit takes seconds
        quantities.search_gaps.cache_clear()
        try:
            ledger.judged(claim, [*flights[:-1], stripped, *tables])
        except BagError as error:
            refused += 1
            assert str(stripped.path) in str(error) and "\n" not in str(error), lack
    assert refused > 0


def test_the_ledger_leaves_open_what_a_bag_cannot_say_and_judges_the_rest(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(replay, "STRIDE", 1000)
    data = tmp_path / "data"
    data.mkdir()
    for path in DATA.iterdir():
        (data / path.name).symlink_to(path)
    (data / "push-hover").unlink()
    failures: list[str] = []
    rows = {row.id: row for row in ledger.evaluate(data, failures=failures)}
    assert len(failures) == 1 and "push-hover" in failures[0]
    assert rows["D1"].verdict == "open" and "push-hover: no such file" in rows["D1"].reading
    assert rows["C2.delay"].verdict != "open" and rows["G1.length"].ours
    monkeypatch.setattr(ledger, "evaluate", lambda *_: failures_of(_))
    with pytest.raises(products.FipError, match="written, with claims that cannot be judged: lost"):
        products.write_ledger(data, tmp_path / "figures", tmp_path / "generated")
    assert (tmp_path / "figures/claims.csv").exists()


def failures_of(arguments: tuple) -> list:
    arguments[2].append("lost")
    return []
