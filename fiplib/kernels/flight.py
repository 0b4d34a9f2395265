"""A whole flight: what ``simulate.fly`` does frame by frame."""

import numpy as np
from numpy.typing import NDArray

from fiplib.kernels.compiling import compiled
from fiplib.kernels.control import solve
from fiplib.kernels.observing import observe
from fiplib.kernels.piloting import answer
from fiplib.kernels.poses import expose, true_state
from fiplib.kernels.vehicle import advance, fallen


@compiled(
    "i8(i8, i8, f8[::1], f8[::1], f8[:,::1], f8[:,::1], f8[:,::1], i8[::1], i8[::1], f8[::1], f8[::1], f8[:,:,::1],"
    " f8, f8[::1], f8[::1], f8[::1], f8[::1],"
    " f8[:,::1], f8[:,:,::1], f8[:,:,::1], f8[:,:,::1], f8[:,::1], f8, f8, f8[:,::1],"
    " f8[:,::1], f8[:,::1], f8[:,::1], f8[:,::1], i8[::1])"
)
def fly(
    first: int,
    last: int,
    x: NDArray,
    about: NDArray,
    schedule: NDArray,
    noise: NDArray,
    forces: NDArray,
    ticks: NDArray,
    acts: NDArray,
    elapsed: NDArray,
    tick_elapsed: NDArray,
    references: NDArray,
    length: float,
    observer: NDArray,
    memory: NDArray,
    pilot: NDArray,
    integrals: NDArray,
    model: NDArray,
    feedback: NDArray,
    q: NDArray,
    p: NDArray,
    bounds: NDArray,
    soft: float,
    tolerance: float,
    work: NDArray,
    frames: NDArray,
    truths: NDArray,
    states: NDArray,
    commands: NDArray,
    statuses: NDArray,
) -> int:
    """Fly the frames ``first`` to ``last`` - 1 of a flight of F frames and T control ticks; ``batch`` has them.

    Args:
        x, about: state and constants of the plant, as in ``advance``.
        schedule: (substeps, 4), scratch; its last row holds the command in force.
        noise, forces: for each frame, as in ``expose`` and ``advance``.
        ticks: number of the control tick of each frame, -1 where there is none, (F,).
        acts: substep at which the command of each tick begins to act, (T,).
        elapsed: since the frame before, in s, (F,); ``tick_elapsed``: since the tick before, (T,).
        references: (T, N + 1, 10).
        length, observer, memory: as in ``observe``, with the observer's constants.
        pilot, integrals: as in ``answer``.
        model to work: as in ``solve``.
        frames, truths, states, commands, statuses: what is written: (F, 14), (F, 11), (T, 10), (T, 4), (T,).

    Returns:
        The frame after which rod or vehicle had fallen, or ``last``.
    """
    substeps, nodes = len(schedule), feedback.shape[1]
    observed, plan, inputs = np.empty(13), np.empty((nodes + 1, 10)), np.empty((nodes, 2))
    given = 0
    for index in range(first):
        given = max(given, ticks[index] + 1)
    acting = 0
    while acting < given and acts[acting] < first * substeps:
        acting += 1
    for index in range(first, last):
        expose(x, about[2], about[8], noise[index], frames[index])
        true_state(x, about[2], truths[index])
        observe(frames[index], length, elapsed[index], observer, memory, observed)
        tick = ticks[index]
        if tick >= 0:
            states[tick] = observed[:10]
            statuses[tick] = solve(
                states[tick], references[tick], model, feedback, q, p, bounds, soft, tolerance, work, plan, inputs
            )
            answer(
                observed[8],
                observed[9],
                observed[10],
                observed[11],
                observed[12],
                inputs[0, 0],
                inputs[0, 1],
                tick_elapsed[tick],
                pilot,
                integrals,
                commands[tick],
            )
            given = tick + 1
        for row in range(substeps):
            schedule[row] = schedule[row - 1 if row > 0 else substeps - 1]
            while acting < given and acts[acting] <= index * substeps + row:
                schedule[row, :3] = commands[acting, :3]
                schedule[row, 3] = commands[acting, 3] * pilot[2]
                acting += 1
        advance(x, schedule, forces[index], about)
        if fallen(x):
            return index
    return last
