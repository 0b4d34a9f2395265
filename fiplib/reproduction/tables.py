"""Tables as text, and those of the paper: from the parameters and from recorded flights."""

import re
from typing import NamedTuple

import numpy as np

from fiplib.params import STATES, Params
from fiplib.recording import Flight
from fiplib.reproduction import claims, measures
from fiplib.reproduction.sources import csv_text

NONE = "--"
"""A cell without a value."""

STACKED = 15
"""Characters of a column's name above which LaTeX sets it in two lines, if its cells are shorter: so wide tables keep a
readable size."""

Facts = dict[tuple[str, ...], str]
"""Numbers as the report prints them, by the words of their names."""


class Table(NamedTuple):
    """A table as text: ``header`` and ``rows`` go to CSV, without markup, and with ``alignment`` to a LaTeX tabular."""

    header: tuple[str, ...]
    rows: list[tuple[str, ...]]
    alignment: str

    def csv(self, command: str) -> str:
        """As CSV; a last column holds the command that computes the rows from the beginning."""
        rows = [(*self.header, "Command"), *((*row, command) for row in self.rows)]
        return csv_text([plain(cell) for cell in row] for row in rows)

    def _repr_markdown_(self) -> str:
        """As a notebook shows it."""
        lines = [self.header, ["---"] * len(self.header), *self.rows]
        return "\n".join(f"| {' | '.join(line)} |" for line in lines).replace(r"\,", " ")

    def latex(self) -> str:
        widths = [max(len(plain(cell)) for cell in cells) for cells in zip(*self.rows, strict=True)] or [0] * len(
            self.header
        )
        sides = columns(self.alignment)
        names = tuple(stacked(*column) for column in zip(self.header, sides, widths, strict=True))
        lines = [" & ".join(row) + r" \\" for row in (names, *self.rows)]
        body = "\n".join([r"\toprule", lines[0], r"\midrule", *lines[1:], r"\bottomrule"])
        return f"\\begin{{tabular}}{{{self.alignment}}}\n{body}\n\\end{{tabular}}\n"


def columns(alignment: str) -> list[str]:
    """Return the letters of a LaTeX tabular's columns: ``@{}lr`` has l and r."""
    return re.findall("[lrc]", re.sub(r"@\{[^}]*\}", "", alignment))


def stacked(name: str, side: str, width: int = 0) -> str:
    """A column's name for LaTeX: a long one in two lines, broken at the space nearest to its middle, in no formula.

    ``side`` is its column's letter, ``width`` the characters of the column's longest cell.
    """
    spaces = [at for at, letter in enumerate(name) if letter == " " and name[:at].count("$") % 2 == 0]
    if len(plain(name)) <= max(STACKED, width) or not spaces:
        return name
    at = min(spaces, key=lambda at: abs(len(plain(name[:at])) - len(plain(name[at:]))))
    return rf"\shortstack[{side}]{{{name[:at]}\\{name[at + 1 :]}}}"


def number(value: float, decimals: int) -> str:
    """A cell with a number, which may be negative."""
    return f"{value:.{decimals}f}".replace("-", "$-$")


def plain(cell: str) -> str:
    """A cell without LaTeX markup: ``$-$0.5`` is -0.5, ``$l_0$`` is l_0."""
    cell = re.sub(r"\\shortstack\[\w\]\{(.*)\}", r"\1", cell).replace(r"\\", " ")
    for markup, text in {r"\,": " ", r"\%": "%", r"\times": "*", r"\pm": "+-", "$": ""}.items():
        cell = cell.replace(markup, text)
    cell = re.sub(r"\\dot (\w)", r"\1_dot", cell)
    cell = re.sub(r"\\math\w+\{(\w+)\}", r"\1", cell)
    return re.sub(r"\\([a-z]+)", r"\1", cell)


def table1_parameters() -> Table:
    """Table 1: the paper's parameters of quadcopter and pendulum."""
    vehicle, rod = Params().vehicle, Params().pendulum
    return Table(
        ("Symbol", "Definition", "Value", "Unit"),
        [
            ("$m$", "Mass of the quadcopter", f"{vehicle.mass:g}", "kg"),
            ("$m_p$", "Mass of the pendulum", f"{rod.mass:g}", "kg"),
            ("$l$", "Length of the pendulum", f"{rod.length:.1f}", "m"),
            (r"$\omega_\mathrm{body}$", "Largest body rate", f"{np.degrees(vehicle.max_body_rate):g}", "deg/s"),
        ],
        "llrl",
    )


def table2_software() -> Table:
    """Table 2: the paper's software parameters, and below them those that it leaves open, with our choice."""
    control, estimation = Params().control, Params().estimation
    paper = [
        ("$N$", "MPC horizon nodes", f"{control.nodes}", ""),
        ("$t_f$", "MPC time frame", f"{control.horizon:g}", "s"),
        ("$t_w$", "GA window size", f"{estimation.window}", "samples"),
        (r"$l_\mathrm{min}$", "Minimum pendulum length", f"{estimation.length_min:.1f}", "m"),
        (r"$l_\mathrm{max}$", "Maximum pendulum length", f"{estimation.length_max:.1f}", "m"),
        ("$r_p$", "Share of the best kept by the GA", f"{estimation.elite_fraction:g}", ""),
        ("$r_m$", "Bit-flip mutation rate of the GA", f"{estimation.mutation_rate:g}", ""),
    ]
    ours = [
        ("$N_c$", "Candidates of the GA", f"{estimation.population}", ""),
        ("", "Generations a run", f"{estimation.generations}", ""),
        ("", "Period of the window's samples", f"{estimation.sample_period:g}", "s"),
        ("", "Period of the GA's runs", f"{estimation.run_period:g}", "s"),
        ("", "Runs in the median filter", f"{estimation.median_length}", ""),
        *((f"$Q$, {signal.label}", f"Weight of {signal.label}", f"{weight:g}", "")
          for signal, weight in zip(STATES, control.state_weights, strict=True)),
        ("$R$", "Weight of each body rate", f"{control.input_weights[0]:g}", ""),
        ("$P$", "Terminal weight, in units of $Q$", f"{control.terminal_factor:g}", ""),
    ]  # fmt: skip
    rows = [(*row, source) for rows, source in ((paper, "paper"), (ours, "our choice")) for row in rows]
    return Table(("Symbol", "Definition", "Value", "Unit", "Source"), rows, "llrll")


def table3_convergence(*flights: Flight) -> Table:
    """Table 3: convergence time and error from three first lengths: the paper's, and ours of the recorded flights.

    One simulated flight from each first length, a rod of 1 m: converged from the time on from which the length in use
    stays within 5 cm of the final one, the median of the last 5 s. Table 5 and Fig. 6 have the spread over many.
    """
    rows = []
    for flight, claim in zip(flights, ("G1", "G2", "G3"), strict=True):
        converged = measures.convergence(flight)
        rows.append((
            f"{flight.params.piloting.initial_length:.1f}",
            f"{claims.PAPER[f'{claim}.time']:.2f}", f"{converged.time:.2f}",
            f"{claims.PAPER[f'{claim}.error']:.3f}", f"{converged.error:.3f}",
        ))  # fmt: skip
    return Table(
        ("$l_0$ (m)", "time, paper (s)", "time, simulated (s)", "error, paper (m)", "error, simulated (m)"),
        rows,
        "rrrrr",
    )
