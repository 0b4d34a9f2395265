"""The Monte Carlo studies, one module each: its cases, its run, and the figure, table and facts made from its rows.

``STUDIES`` lists them; ``fip sweep NAME`` runs one over all cores, or a cluster. A study module has

- ``KEYS: tuple[str, ...]``: the columns that identify a case,
- ``cases() -> list[dict]``: the full study in a fixed order, plain str, int and float values,
- ``run(case) -> dict``: the result columns of one case, plain values as well. It is pure: a case carries all that its
  result depends on, its seed included, so that a lost case can be run again, anywhere.

Results land in ``data/sweeps/NAME.csv``, one row per case. ``facts(rows)`` gives the numbers that the report states
outside its tables. A second study in a module is a class with these as static methods.
"""

import pkgutil
from pathlib import Path
from typing import TYPE_CHECKING, Any

from fiplib.reproduction.sources import read
from fiplib.reproduction.stored import JournalError
from fiplib.studies.journal import text

if TYPE_CHECKING:
    from fiplib.recording import Flight
    from fiplib.reproduction.sources import Rows
    from fiplib.reproduction.tables import Facts
    from fiplib.simulate import Scenario

STUDIES = {
    "survival": "fiplib.studies.survival",
    "length_jumps": "fiplib.studies.length_jumps",
    "weights": "fiplib.studies.weights",
    "ledger_seeds": "fiplib.studies.ledger_seeds",
    "ledger_readings": "fiplib.studies.ledger_seeds:Readings",
    "landscapes": "fiplib.studies.landscapes",
    "landscape_curves": "fiplib.studies.landscapes:Curves",
    "bounds": "fiplib.studies.bounds",
    "estimators": "fiplib.studies.estimators",
    "imperfections": "fiplib.studies.imperfections",
    "handover": "fiplib.studies.handover",
    "ablation": "fiplib.studies.ablation",
    "poses": "fiplib.studies.poses",
    "seat": "fiplib.studies.seat",
    "observers": "fiplib.studies.observers",
    "choices": "fiplib.studies.choices",
    "choices_flown": "fiplib.studies.choices_checks:Flown",
    "choices_exploring": "fiplib.studies.choices_checks:Exploring",
    "step_errors": "fiplib.studies.step_errors",
    "spread": "fiplib.studies.spread",
    "flying_pendulum": "fiplib.studies.flying_pendulum",
    "field": "fiplib.studies.field",
    "excitation": "fiplib.studies.excitation",
}
"""Address of each study by name, see ``load``."""


FACTS = (
    *("estimators", "weights", "handover", "length_jumps", "imperfections", "bounds"),
    *("seat", "poses", "observers", "ablation", "step_errors", "field", "flying_pendulum", "excitation"),
    *("choices", "choices_flown", "choices_exploring"),
)
"""The studies whose ``facts`` the report states, in the order of the file that holds them."""


def load(address: str) -> Any:
    """Import the study at ``module`` or ``module:Class``."""
    return pkgutil.resolve_name(address if ":" in address else f"{address}:")


def run(address: str, case: dict) -> dict:
    """Run one case of the study at an address: all that a worker knows of it."""
    return load(address).run(case)


def check(name: str, rows: "Rows") -> None:
    """Raise JournalError unless the rows of a finished table, if there are any, are those of the study's cases."""
    study = load(STUDIES[name])
    wanted = {tuple(text(case[key]) for key in study.KEYS) for case in study.cases()}
    found = [tuple(text(row.get(key, "")) for key in study.KEYS) for row in rows]
    if rows and (len(found) != len(wanted) or set(found) != wanted):
        counts = f"{len(wanted - set(found))} of {len(wanted)} cases are missing"
        counts += f", {len(found) - len(wanted & set(found))} rows are of no case or repeated"
        again = f"make sweep STUDIES='{name} --fresh'"
        raise JournalError(f"the table of the study {name} is not that of its cases ({counts}): make it with: {again}")


def facts(data: Path = Path("data")) -> "Facts":
    """Return what the report states of the studies in ``FACTS``; a study that is not complete has nothing to state."""
    return {
        (study, *words): found
        for study in FACTS
        if (rows := read(study, data))
        for words, found in load(STUDIES[study]).facts(rows).items()
    }


def seconds_flown(flight: "Flight", scenario: "Scenario") -> float:
    """Seconds until the fall, or the whole duration of the scenario."""
    return scenario.duration if flight.survived else flight.duration
