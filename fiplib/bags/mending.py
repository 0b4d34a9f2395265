"""Repairs of a bag's poses: stamps missing or out of order, frames sent twice, frames without a pose.

Each repair is reported once, with its count; the bag itself is not changed. A fault with two possible causes is not
repaired.
"""

import numpy as np

FEW = 0.01
"""Share of frames that may be out of order: more are two publishers on one topic, or a clock that was set."""


def mended(
    body: str, stamp: np.ndarray, received: np.ndarray, values: np.ndarray, notes: list[str]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mend the poses of a body.

    Args:
        body: its name, for the notes.
        stamp, received: (n,) in ns.
        values: (n, 7), position and quaternion.
        notes: one sentence is added for each repair.

    Returns:
        The same three, of the frames that hold a pose.
    """
    count = len(stamp)
    if count > 1 and not stamp.any():
        stamp = received
        notes.append(f"{body}: no message has a stamp: the times at which they were logged stand for them")
    backwards = int((np.diff(stamp) < 0).sum())
    if 0 < backwards <= FEW * count:
        order = np.argsort(stamp, kind="stable")
        stamp, received, values = stamp[order], np.maximum.accumulate(received[order]), values[order]
        notes.append(f"{body}: {backwards} of {count} messages came out of order: sorted by their stamps")
    again = np.zeros(count, bool)
    again[1:] = (np.diff(stamp) == 0) & (values[1:] == values[:-1]).all(axis=1)
    # trackers mark a lost body by nan, or by a quaternion that is none
    lost = ~np.isfinite(values).all(axis=1) | ~values[:, 3:].any(axis=1)
    if again.any():
        notes.append(f"{body}: {int(again.sum())} of {count} messages were sent twice: one of each is used")
    if (without := lost & ~again).any():
        notes.append(f"{body}: {int(without.sum())} of {count} messages hold no pose: they are left out")
    keep = ~again & ~lost
    return stamp[keep], received[keep], values[keep]
