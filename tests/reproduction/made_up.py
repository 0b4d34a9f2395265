"""Small made-up flights whose answer is known."""

from pathlib import Path

import numpy as np

from fiplib.params import STATE_NAMES, Params
from fiplib.recording import Event, Flight, Poses, Series
from fiplib.references import Circle

RATE = 120
TICK = 1 / RATE + 1e-9
"""A time read off sampled states is right to one sample."""


def moments(seconds: float) -> np.ndarray:
    return np.arange(round(seconds * RATE)) / RATE


def series(time: np.ndarray, values: np.ndarray, names: tuple[str, ...]) -> Series:
    return Series(
        np.round(np.asarray(time) * 1e9).astype(np.int64), np.asarray(values, float), names, ("",) * len(names)
    )


def flight(
    seconds: float,
    columns: dict[int, np.ndarray] | None = None,
    reference: np.ndarray | None = None,
    lengths: list[tuple[float, float]] | None = None,
    pushes: tuple[float, ...] = (),
    rates: np.ndarray | None = None,
    params: Params | None = None,
) -> Flight:
    """A flight with zero states but for ``columns``, and (time, used length) pairs."""
    time = moments(seconds)
    values = np.zeros((len(time), 10)) if reference is None else reference.copy()
    for index, column in (columns or {}).items():
        values[:, index] = column
    stamp = np.array([0, round(seconds * 1e9)], np.int64)
    poses = Poses(stamp, stamp, np.zeros((2, 3)), np.tile([0.0, 0.0, 0.0, 1.0], (2, 1)))
    command = np.zeros((len(time), 4))
    if rates is not None:
        command[:, :2] = rates[:, None]
    return Flight(
        path=Path("made-up"),
        metadata={"origin": "simulated", "params": (params or Params()).to_dict()},
        vehicle=poses,
        pendulum=poses,
        state=series(time, values, STATE_NAMES),
        command=series(time, command, ("omega_x", "omega_y", "omega_z", "thrust")),
        reference=series(time, np.zeros((len(time), 10)) if reference is None else reference, STATE_NAMES),
        length=series([t for t, _ in lengths], [[l, l, 0.0] for _, l in lengths], ("used", "estimate", "sd"))
        if lengths
        else None,
        events=tuple(Event(round(push * 1e9), "info", "push of 8 mN s", "push") for push in pushes),
        truth_state=None,
        truth_length=None,
        start_ns=0,
        topics=(),
    )


def bump(time: np.ndarray, start: float, peak: float, decay: float) -> np.ndarray:
    """Zero, and from ``start`` on an exponential that falls from ``peak``."""
    return np.where(time >= start, peak * np.exp(-(time - start) / decay), 0.0)


def circling(columns: dict[int, np.ndarray] | None = None, **more) -> Flight:
    """26 s on the circle of 0.8 m."""
    return flight(26, columns, reference=Circle(radius=0.8, period=9.0).at(moments(26)), **more)


def estimating(lengths: list[tuple[float, float]], **more) -> Flight:
    """25 s on the circle of 0.4 m with lengths that are set in flight."""
    return flight(25, reference=Circle(radius=0.4, period=8.0).at(moments(25)), lengths=lengths, **more)
