"""The estimate from poses in flight: from windows that grow, and then from everything since the first pose."""

import functools
import math
from dataclasses import replace

import numpy as np

from fiplib.estimators.base import Estimate
from fiplib.estimators.poses import checks
from fiplib.estimators.poses.estimate import estimate, problem_of
from fiplib.estimators.poses.filter import LEVER, run
from fiplib.estimators.poses.knowledge import Knowledge, Told
from fiplib.estimators.poses.profile import Profile
from fiplib.estimators.poses.rows import Body, rows_of
from fiplib.estimators.poses.stream import Stream
from fiplib.estimators.windows import RawPoses, RawWindow
from fiplib.params import NANO, Params

NOTHING = Body(np.zeros(0), np.zeros((0, 3)), np.zeros((0, 3)))


def knowledge_in_flight(params: Params) -> Knowledge:
    """Return what ``params`` say, the pilot's seat among it, without the measured distance of the two tracked points.

    Half the length could be read off that distance at once where the seat's height is known, without any motion. The
    paper's states do not hold it, and what the controller needs is the rod that falls as this one does: the length in
    flight comes from motion alone.
    """
    seat = Told(params.piloting.seat_height, params.piloting.seat_tolerance)
    return replace(Knowledge.of(params), seat_height=seat, distance_tolerance=math.inf)


def body_of(poses: RawPoses, origin: int) -> Body:
    """Return poses with their times in s since ``origin`` ns."""
    return Body((poses.stamp - origin) / NANO, poses.position, poses.axis)


def profile_of(window: RawWindow, params: Params, inertia_factor: Told | None = None) -> Profile:
    """Return a window's profile likelihood of the length, with the knowledge in flight or another inertia factor.

    Raises Refusal: too few poses, or bodies that are no vehicle and rod.
    """
    knowledge = replace(knowledge_in_flight(params), inertia_factor=inertia_factor)
    problem = problem_of(*(body_of(poses, int(window.vehicle.stamp[0])) for poses in window), knowledge, [])
    return Profile(problem, (params.estimation.length_min, params.estimation.length_max))


@functools.cache
def load() -> None:
    """Compile the filter, or load what an earlier call has compiled: some 30 s, then half a second, not in flight."""
    still = Body(0.01 * np.arange(8.0), np.zeros((8, 3)), np.tile([0.0, 0.0, 1.0], (8, 1)))
    rows = rows_of(still, still._replace(position=still.position + still.axis))
    run(rows, np.zeros((2, LEVER + 1)), np.ones(1), innovations=True)


class InFlight:
    """The pose estimator for one flight, called with one window after the other: (window, params, rng) -> Estimate.

    A window repeats poses of the one before, so that a lost window loses nothing as long as the next one overlaps;
    poses count once. Until ``raw_window`` s have gathered, each call estimates from all of them (``estimate``); from
    then on a ``Stream`` goes on for as long as the flight does. After a gap, and after something that nothing in the
    model explains (a push, another rod), it begins anew. The first call is what ``estimate`` answers to that window.
    """

    def __init__(self) -> None:
        load()
        self._seen: tuple[int, int] | None = None
        self._begin(0)

    def __call__(self, window: RawWindow, params: Params, rng: np.random.Generator | None = None) -> Estimate:
        """Return the length from all poses so far. Raises ValueError: a window without poses of both bodies."""
        if not all(len(body.stamp) for body in window):
            raise ValueError("a window of raw motion capture needs poses of both bodies")
        if self._seen is None or any(body.stamp[0] > seen for body, seen in zip(window, self._seen, strict=True)):
            self._begin(int(window.vehicle.stamp[0]))
            self._seen = (-1, -1)
        fresh = [self._fresh(body, seen) for body, seen in zip(window, self._seen, strict=True)]
        self._seen = int(window.vehicle.stamp[-1]), int(window.rod.stamp[-1])
        knowledge, span = knowledge_in_flight(params), params.estimation.raw_window
        if self._full and self._stream is None:
            self._stream = Stream(*self._bodies, knowledge)
        if self._stream is not None:
            self._stream.push(*fresh)
            return self._answer(self._stream, knowledge)
        self._bodies = [_joined(*pair) for pair in zip(self._bodies, fresh, strict=True)]
        answer = estimate(*self._bodies, knowledge)
        latest = max(body.time[-1] for body in self._bodies)
        if latest - min(body.time[0] for body in self._bodies) > span - 0.02:
            self._full = answer.reason is None
            if not self._full:
                self._bodies = [body.part(body.time > latest - span) for body in self._bodies]
        return Estimate(answer.length, answer.standard_deviation, answer.reason, answer.assumed)

    def _begin(self, origin: int) -> None:
        self._origin, self._bodies = origin, [NOTHING, NOTHING]
        self._full, self._stream = False, None

    def _fresh(self, body: RawPoses, seen: int) -> Body:
        return body_of(body.part(body.stamp > seen), self._origin)

    def _answer(self, stream: Stream, knowledge: Knowledge) -> Estimate:
        """Return the stream's length, unless something speaks against it."""
        length, deviation = stream.length
        jump = stream.jump
        try:
            if not (math.isfinite(length) and math.isfinite(deviation)):
                raise checks.Refusal(
                    "the likelihood has no maximum: the two bodies do not move as a vehicle and its rod"
                )
            if jump > checks.LARGEST_JUMP:
                raise checks.Refusal(
                    "the rod or the vehicle moved as nothing in the model does (squared innovations "
                    f"{jump:.1f} times as large as expected): the estimate begins anew"
                )
            checks.check_length(length, deviation, knowledge.lengths)
        except checks.Refusal as refusal:
            self._begin(self._origin)
            return Estimate(math.nan, math.nan, str(refusal))
        return Estimate(length, deviation)


def _joined(before: Body, after: Body) -> Body:
    return Body(*(np.concatenate(pair) for pair in zip(before, after, strict=True)))
