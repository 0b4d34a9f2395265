"""Advice on recording a flight, and an explanation of each finding.

Used by ``fip bag info --explain`` and by docs/your-own-recording.md.
"""

from textwrap import fill

RECORD = {
    "Bodies": "One for the vehicle, one for the rod, each with its orientation, z axis up when vehicle and rod stand "
    "upright. The rod's tracked point belongs on its axis, at least 10 cm from the seat; at its middle is best.",
    "Frames": "World frame with z up, metres, quaternions as x, y, z, w. Another convention is found from the motion "
    "and refused by name; `--up`, `--unit`, `--quaternion` and `--swap` read it.",
    "Stamps": "Each message carries the time of its exposure, by one clock for both bodies. The two bodies need not be "
    "stamped alike, nor arrive in order, nor at the same rate; lost frames do no harm. Stamps that are all zero are "
    "replaced by the times of logging; `--stamps log` does so for others.",
    "Rate and duration": "100 Hz or more. A balanced rod moves enough to be measured: 2.5 s give about 0.5 % of a 1 m "
    "rod, a whole flight less. A circle is more informative than a hover.",
    "No touching": "A push on the rod or the vehicle is a force that the model does not know: leave that stretch out.",
}
"""Advice on what to record."""

EXPLANATIONS = {
    "roles": (
        "Vehicle and rod are two bodies, the rod above the vehicle.",
        "`--swap`, or say which is which: `--topic vehicle=/its/name --topic pendulum=/its/name`",
    ),
    "clocks": (
        "Both bodies are stamped by one clock, within 1.5 ms: the rod's foot goes where the vehicle goes.",
        "`--stamps log` if they were logged as they came; else stamp both by one clock",
    ),
    "tracking": (
        "Both bodies are tracked all the time: no pose repeats the one before in every digit, none lies far from those "
        "around it, no body is lost for more than 1.2 s.",
        "nothing for a few, they are left out; else record again",
    ),
    "frames": (
        "Both bodies are recorded in one frame, which stands still.",
        "record both in the frame of the world, neither relative to the other",
    ),
    "up axis": (
        "The rod stands along z, the world's axis that points up.",
        "`--up y` and the like; `--up=-z` for north-east-down",
    ),
    "quaternion": (
        "Quaternions are x, y, z, w and turn the body into the world: the vehicle accelerates to where it tilts, and "
        "the rod's z axis points from the vehicle to the rod.",
        "`--quaternion wxyz`, or with `-inverse` where they turn the world into the body; `--quaternion "
        "pendulum=wxyz` for one body",
    ),
    "attitude": (
        "Each body has its z axis up when it is upright, in the frame in which positions are, and it turns.",
        "define the bodies anew; record positions and orientations in one right-handed frame",
    ),
    "unit": (
        "Positions are in m: the vehicle accelerates as much as its tilt lets it.",
        "`--unit mm` and the like",
    ),
    "distance": (
        "The distance of the two tracked points stays the same: twice it is the rod's length, if the vehicle is "
        "tracked at the seat and the rod at its middle.",
        "check the topics and the names of the bodies",
    ),
    "rod point": (
        "The rod is tracked at least 10 cm from its seat; at its foot its orientation alone determines the length of a "
        "uniform rod.",
        "track its middle",
    ),
    "rate": ("Poses come at 45 Hz at least.", "record at 100 Hz or more"),
    "commands": (
        "Commands are body rates in rad/s, x forward, y left, z up, by the clock of the poses: the vehicle turns as "
        "they say, within a quarter of a second. The length from poses alone needs none; the genetic algorithm does.",
        "leave them out, or record them in rad/s by the same clock",
    ),
}
"""By name of a check: what it expects of a recording, and what to do if that fails."""


def markdown() -> str:
    """Return what to record, and what each finding means, for the page."""
    lines = ["## What to record", "", *(_bullet(f"**{name}.** {text}") for name, text in RECORD.items())]
    lines += ["", "## What each finding means", "", "| check | what is expected | if not |", "|---|---|---|"]
    lines += [f"| {name} | {expected} | {otherwise} |" for name, (expected, otherwise) in EXPLANATIONS.items()]
    return "\n".join([*lines, ""])


def words() -> str:
    """Return the same for a terminal."""
    lines = ["What to record", ""]
    lines += [fill(f"{name}: {text}", 100, subsequent_indent="  ") for name, text in RECORD.items()]
    lines += ["", "What each finding means", ""]
    for name, (expected, otherwise) in EXPLANATIONS.items():
        lines.append(fill(f"{name}: {expected} If not: {otherwise}.", 100, subsequent_indent="  "))
    return "\n".join(lines).replace("`", "")


def _bullet(text: str) -> str:
    return fill(text, 120, initial_indent="- ", subsequent_indent="  ", break_long_words=False, break_on_hyphens=False)
