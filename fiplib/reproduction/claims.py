"""The claims of the paper, each with its criterion, its kind and the flights that decide it: the ledger.

A new claim is one entry of ``CLAIMS``: where its evidence comes from, and when a flight agrees with it. What is
measured on a flight stands in ``quantities``, the rule that makes a verdict of many flights in ``verdicts``; how other
evidence is read, in ``evidence``. ``fip claims`` judges all claims and writes the files.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

from fiplib.recording import Flight
from fiplib.reproduction import evidence, quantities
from fiplib.reproduction.evidence import Evidence, flown, paired
from fiplib.reproduction.quantities import EXPLORING, LATE, SETTLED, search_gaps
from fiplib.reproduction.sources import Sources
from fiplib.reproduction.verdicts import HALF, Kind

__all__ = ["BY_ID", "CLAIMS", "EXPLORING", "LATE", "PAPER", "SETTLED", "Claim", "search_gaps"]

ABOUT = 0.25
"""Relative difference within which a number counts as the paper's. It says "approximately", and pushes, period and
noise were other ones than ours: closer agreement would mean nothing."""

LITTLE = 0.1
"""Size that the paper calls minimal (undershoot), slight (delay, in quarter periods) or little (convergence)."""

SLIGHT = LITTLE * 9.0 / 4
"""The same tenth of a quarter period of our circle of 0.8 m, s."""

ACCURACY = 0.029
"""Largest error in the paper's Table 3, m. Its three flights scatter from 0.0 to here: a flight of ours that ends as
close as the worst of them is as good."""

TRUE = 1.0
"""The rod's length in m, in the paper (Table 1) and in every flight that is judged here."""

RAPID = 0.05
"""Change in m from one answer of the estimator to the next that counts as rapid, if one in ten is larger: the band
within which an estimate counts as converged. The paper names none."""

LATE_TICKS = 0.01
"""Share of control ticks that may come late in real time."""

EXCEPTIONS = 0.05
"""Share of the changes below a limit that may still end in a fall: a limit speaks of each of them."""


@dataclass(frozen=True)
class Claim(Sources):
    """A claim of the paper.

    Attributes:
        id: the row's name; a letter and a number for the claim, a word for the part.
        text: the claim in our words.
        paper: its number in ``unit``; None: it states none. Shown with ``decimals``.
        gather: gets what ``Sources.read`` returns and gives the ``Evidence``.
        agrees: whether one flight's value agrees, from (value, paper, tolerance).
        tolerance: of ``agrees``; NaN: the criterion has none.
        kind: whether the claim is tested, fitted or not testable.
        measure: the function of ``quantities`` that gives the value of one flight, if one does.
        late: share of events that may disagree in a claim about each of many events; None: a claim about flights.
        reason: what was fitted, why it cannot be tested, or the unprinted choice that the answer hangs on.
    """

    id: str
    text: str
    paper: float | None
    unit: str
    decimals: int
    gather: Callable[..., Evidence]
    agrees: Callable[[float, float | None, float], bool]
    tolerance: float = math.nan
    kind: Kind = Kind.TESTED
    measure: Callable[[Flight], float] | None = None
    late: float | None = None
    reason: str = ""

    @property
    def of(self) -> tuple[str, ...]:
        """Return the names of what it is read from, in the order in which ``gather`` gets them."""
        return (*self.bags, *self.studies, *self.benchmarks)

    @property
    def criterion(self) -> str:
        """Return the criterion by which a flight agrees, in words; empty where the note has it."""
        words = CRITERIA[self.agrees].format(self.tolerance)
        needed = "" if self.late is None else f"a share of {1 - self.late:.0%} is needed"
        return "; ".join(filter(None, (words, needed)))

    @property
    def unprinted(self) -> bool:
        """Return whether the answer depends on a choice that the paper does not print."""
        return self.kind is Kind.TESTED and bool(self.reason)

    def agree(self, value: float, factor: float = 1.0) -> bool:
        """Return whether a flight with this value agrees, with ``factor`` times the tolerance. NaN never does."""
        return not math.isnan(value) and bool(self.agrees(value, self.paper, factor * self.tolerance))

    def needed(self, factor: float = 1.0) -> float:
        """Return the share of flights, or events, that has to be exceeded."""
        return HALF if self.late is None else 1.0 - factor * self.late


# --- criteria: (value, paper, tolerance) -> whether they agree


def equal(value: float, paper: float, _: float) -> bool:
    return value == paper


def about(value: float, paper: float, tolerance: float) -> bool:
    return abs(value - paper) <= tolerance * abs(paper)


def accurate(value: float, _: float | None, tolerance: float) -> bool:
    return abs(value - TRUE) <= tolerance


def up_to(value: float, _: float | None, tolerance: float) -> bool:
    return value <= tolerance


def above(value: float, _: float | None, tolerance: float) -> bool:
    return value > tolerance


def short_by_little(value: float, _: float | None, tolerance: float) -> bool:
    return 1 - tolerance <= value < 1


def slightly_late(value: float, _: float | None, tolerance: float) -> bool:
    return 0 < value <= tolerance


def smaller(value: float, _: float | None, tolerance: float) -> bool:
    """A ratio that is below 1 by more than the tolerance."""
    return value < 1 - tolerance


def larger(value: float, _: float | None, tolerance: float) -> bool:
    """A ratio that is above 1 by more than the tolerance."""
    return value > 1 + tolerance


def same(value: float, _: float | None, tolerance: float) -> bool:
    """A ratio that is 1 within the tolerance."""
    return abs(value - 1) <= tolerance


def yes(value: float, _: float | None, __: float) -> bool:
    """A flag."""
    return value == 1


def within(value: float, paper: float, _: float) -> bool:
    return value < paper


CRITERIA = {
    equal: "it is the paper's number",
    about: "within {0:.0%} of the paper's number",
    accurate: "within {0:g} m of the rod's length",
    up_to: "at most {0:g}",
    above: "above {0:g}",
    short_by_little: "below 1 by at most {0:.0%}",
    slightly_late: "above 0 and at most {0:.2g} s",
    smaller: "below 1 by more than {0:.0%}",
    larger: "above 1 by more than {0:.0%}",
    same: "1 within {0:.0%}",
    yes: "",
    within: "below the paper's number",
}
"""Each criterion in words, with its tolerance."""


# --- the claims


_PUSH, _CIRCLE, _JUMP, _SEEDS = ("push-hover",), ("circle-0.8",), ("length-jump",), ("ledger_seeds",)
_STARTS = ("estimate-0.8", "estimate-1.2", "estimate-1.4")
_WEIGHTS = "our weights were chosen among those that met this row before the plant had a raised seat (table7-weights)"
_LIGHT = "our weights of y and y' are a tenth of those of x and x', chosen light to meet C2.y"
_CHOICES = "table17-choices and fig20-choices have the answer as a function of them"
_SEARCH = f"population, generations and whether a run starts anew are not printed; {_CHOICES}"
_SCHEDULE = f"'0.2 Hz', the phase of the first run and a window filled before t = 0 are open; {_CHOICES}"


def _flight(id: str, text: str, paper: float | None, unit: str, decimals: int, *judged: Any, **more: Any) -> Claim:
    """A claim whose evidence is a number of each flight; ``judged`` are its measure, its criterion, its tolerance."""
    (measure, *criterion), bags = judged, more["bags"]
    gather = partial(flown, measure, bags=bags, remark=more.pop("remark", ""))
    more = {"measure": measure, "studies": _SEEDS} | more
    return Claim(id, text, paper, unit, decimals, gather, *criterion, **more)


def _estimation(id: str, start: str, length: float, error: float, time: float) -> tuple[Claim, ...]:
    """Return the rows of one of the paper's three estimation flights (its Table 3 and section 4.3)."""
    text, bag, printed = f"From l0 = {start} m:", (f"estimate-{start}",), partial(evidence.printed_error, error)
    return (
        _flight(f"{id}.length", f"{text} length reached", length, "m", 3, quantities.final_length, accurate, ACCURACY,
                bags=bag, remark=printed),
        _flight(f"{id}.time", f"{text} convergence time", time, "s", 2, quantities.converged, about, ABOUT,
                bags=bag, remark=evidence.first_time, reason=_SCHEDULE),
    )  # fmt: skip


CLAIMS = (
    _flight("D1", "Three pushes in hover: balance is kept", 3, "pushes", 0, quantities.kept, equal,
            bags=_PUSH, remark=evidence.when_pushed),
    _flight("D2", "Pushes: largest deviation of a, b", 0.058, "m", 3, quantities.push_lean, about, ABOUT, Kind.FITTED,
            bags=_PUSH, remark=partial(evidence.push_angle, 0.058, 6.67),
            reason="the impulse was chosen to give about this offset: the paper does not state its own"),
    _flight("D3", "Pushes: settling time of a, b", 2.0, "s", 2, quantities.settling, about, ABOUT, Kind.FITTED,
            bags=_PUSH, remark=evidence.band, reason=_WEIGHTS),
    _flight("D4", "Pushes: larger errors in y than in x", None, "1", 2, quantities.pushed_axes, larger, ABOUT,
            Kind.FITTED, bags=_PUSH, remark=evidence.pushed_alike, reason=_LIGHT),
    _flight("C1", "Circle of 0.8 m: largest deviation of a, b", 0.025, "m", 3, quantities.circle_lean, about, ABOUT,
            Kind.FITTED, bags=_CIRCLE, remark=partial(evidence.circle_angle, 0.025, 2.87),
            reason="the lap's period was chosen so that the deviation agrees: the paper states none"),
    _flight("C2.gain", "Circle: minimal undershoot of x", None, "1", 3, quantities.x_gain, short_by_little, LITTLE,
            Kind.FITTED, bags=_CIRCLE, reason=_WEIGHTS,
            remark=f"Minimal: an amplitude short by up to {100 * LITTLE:g} %"),
    _flight("C2.delay", "Circle: slight delay of x", None, "s", 3, quantities.x_delay, slightly_late, SLIGHT,
            bags=_CIRCLE, remark=f"Slight: above 0, up to a tenth of a quarter period, {SLIGHT:.2f} s. A negative "
            "delay is a lead: the MPC sees its reference over the whole horizon"),
    _flight("C2.y", "Circle: largest error of y", 0.2, "m", 3, quantities.y_error, about, ABOUT, Kind.FITTED,
            bags=_CIRCLE, reason=_LIGHT),
    Claim("C3", "Other weights on y and its rate would improve y", None, "1", 2, evidence.heavier_y, smaller, ABOUT,
          Kind.FITTED, studies=_SEEDS, reason=f"{_LIGHT}; this row undoes that choice"),
    *_estimation("G1", "0.8", 0.973, 0.027, 14.68),
    *_estimation("G2", "1.2", 1.029, 0.029, 3.99),
    *_estimation("G3", "1.4", 1.0, 0.0, 12.43),
    _flight("G.literal", "The fitness as printed finds the length", None, "m", 3, quantities.printed_best, accurate,
            ACCURACY, bags=_STARTS, remark=evidence.identity,
            reason="noise covariances are not printed, and they decide"),
    _flight("G4.late", "Little to no convergence after 14 s", None, "1", 2, quantities.late_share, up_to, LITTLE,
            bags=_STARTS, remark=f"Share of the initial error that vanishes after {LATE:g} s. Little: up to {LITTLE:g}",
            reason=_SCHEDULE),
    Claim("G4.search", "The GA explores too little", None, "m", 4, evidence.search, yes, bags=_STARTS, studies=_SEEDS,
          reason=_SEARCH),
    Claim("G4.remedy", "Fewer elites, more mutation would help", None, "m", 4, evidence.remedy, yes, bags=_STARTS,
          studies=_SEEDS, reason=_SEARCH),
    _flight("G5", "Tracking in x improves once the length is updated", None, "1", 2, quantities.x_tracking, smaller,
            LITTLE, bags=("estimate-1.4",), remark="RMS error of x on the arc flown before the first update: in later "
            "laps over in the first lap, which starts from rest. Improves: falls by more than a tenth"),
    _flight("G5.y", "Tracking in y barely improves with it", None, "1", 2, quantities.y_tracking, same, ABOUT,
            bags=("estimate-1.4",), remark="The same of y. Barely: the error keeps its size within a quarter"),
    Claim("G6.safe", "A change of length up to 0.8 m is survived", 0.8, "m", 2, evidence.safe_changes, yes,
          late=EXCEPTIONS, bags=_JUMP, studies=("length_jumps",)),
    Claim("G6.fatal", "A change of length beyond 0.8 m: instability", 0.8, "m", 2, evidence.fatal_changes, yes,
          bags=_JUMP, studies=_SEEDS),
    Claim("G6.long", "Beyond 0.8 m longer: commands fluctuate", None, "1", 2,
          partial(evidence.wild_commands, "outlier"), larger, ABOUT, bags=_JUMP, studies=_SEEDS),
    Claim("G6.short", "Beyond 0.8 m shorter: commands fluctuate", None, "1", 2,
          partial(evidence.wild_commands, "short outlier"), larger, ABOUT, studies=_SEEDS),
    Claim("G6.steps", "Small steps of the length would prevent it", None, "1", 2, evidence.small_steps, yes,
          studies=("ledger_seeds", "length_jumps")),
    _flight("G7", "The estimate fluctuates rapidly", None, "m", 3, quantities.fluctuation, above, RAPID, bags=_STARTS,
            remark=f"Change from one answer to the next that one in ten exceeds. Rapid: above {RAPID:g} m",
            reason=f"the period of runs and the window's sampling are open: table6-readings, and {_CHOICES}"),
    Claim("G8", "The estimator needs an exciting trajectory", None, "1", 2,
          partial(paired, quantities.estimate_error, ("hover", "estimate-1.2"), evidence.hover_exact), larger, ABOUT,
          studies=_SEEDS),
    Claim("M1", "Altitude and yaw do not influence the balance", None, "1", 2,
          partial(paired, quantities.circle_lean, ("swaying", "circle-0.8"), evidence.swayed), same, ABOUT,
          studies=_SEEDS),
    Claim("M2", "m_p << m: the rod does not disturb the vehicle", None, "1", 2,
          partial(paired, quantities.circle_lean, ("massless", "circle-0.8"), evidence.mass_in_length), same, ABOUT,
          studies=_SEEDS),
    Claim("M3", "A terminal constraint costs feasibility", None, "1", 2, evidence.terminal, above, 0.0, studies=_SEEDS),
    Claim("R1.mpc", "MPC in real time at 120 Hz: time of one solve", 8.33, "ms", 2, evidence.solve_time, within,
          late=LATE_TICKS, benchmarks=("solve_times", "deadlines")),
    Claim("R1.ga", "The GA does not stall the MPC: late ticks", None, "%", 3, evidence.late_ticks, yes,
          late=LATE_TICKS, benchmarks=("deadlines",)),
    Claim("V1", "All this on the vehicle, disturbances included", None, "1", 0, evidence.none, yes,
          kind=Kind.NOT_TESTABLE, reason="air drag, rotor wash on the rod, friction and slip of the seat, the battery "
          "and the authors' computer are not in our simulator; nothing of ours has flown"),
)  # fmt: skip
"""The ledger, row by row."""

PRINTED = {"D2.angle": 6.67, "C1.angle": 2.87, "G1.error": 0.027, "G2.error": 0.029, "G3.error": 0.0}
"""Further numbers of the paper that say the same as a row: degrees of its centimetres, errors of its lengths."""

JUDGED = Sources(
    bags=tuple(dict.fromkeys(bag for claim in CLAIMS for bag in claim.bags)),
    studies=tuple(dict.fromkeys(study for claim in CLAIMS for study in claim.studies)),
    benchmarks=tuple(dict.fromkeys(table for claim in CLAIMS for table in claim.benchmarks)),
)
"""All that the claims are read from."""

BY_ID = {claim.id: claim for claim in CLAIMS}
PAPER = {claim.id: claim.paper for claim in CLAIMS if claim.paper is not None} | PRINTED
"""The paper's numbers by id of the claim, each in its claim's unit; and those of ``PRINTED``."""
