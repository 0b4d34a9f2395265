"""From estimates to the length that the MPC uses: as printed, or weighted by the estimates' precision.

A wrong length is not equally wrong on both sides. In simulated flights on the 0.4 m circle a controller that
uses 0.5 m keeps every rod from 0.5 to 2.0 m up, while 1.6 m lets a rod of 0.5 m fall within 1.6 s, before any estimate.
Hence the trusted hand-over starts from the shortest rod to expect, and follows the short side of its belief.
"""

import math

from fiplib.ga import MedianFilter
from fiplib.params import Params


class PrintedHandOver:
    """The paper's: the median of the last runs is taken over at once, or in steps of at most ``length_step``."""

    def __init__(self, params: Params, overlap: float = 1.0) -> None:
        self.used = params.piloting.initial_length
        self._params = params
        self._median = MedianFilter(params.estimation.median_length)

    def update(self, length: float, deviation: float = math.nan) -> float:
        """Take an estimate in m (one that is not finite is ignored; its deviation always is); the length to use."""
        if math.isfinite(length):
            estimation, step = self._params.estimation, self._params.piloting.length_step
            target = max(estimation.length_min, min(estimation.length_max, self._median.push(length)))
            self.used = float(max(self.used - step, min(self.used + step, target)))
        return self.used


class TrustedHandOver:
    """Fusion of successive estimates by their precision; the length in use is a cautious quantile of the posterior.

    The belief is Gaussian in 1/l. The equation of motion is linear in it (a'' = 2 g a / l - ...), so the likelihood of
    a window is nearly Gaussian in 1/l however short the window is, and the belief never reaches a negative length.

    - *Prior.* Rods from ``rod_lengths``, widened to l0, which lie ``caution`` deviations to either side of the mean.
    - *Fusion.* Successive windows share most of their data, so precisions must not be added. The new precision is the
      average of the present one and the estimate's (covariance intersection: consistent whatever the correlation).
      The k-th estimate has the share 1 / (k + 1), but never less than 1 / ``memory``: the belief forgets over as many
      runs as lie within a window, and follows a changed rod. Early estimates of growing windows, being vague, weigh
      little beside later ones.
    - *Outliers.* An estimate beyond ``outlier_gate`` deviations is not used, but the deviation of the belief doubles: a
      single outlier shortens the used length a little, and a changed rod is soon accepted.
    - *Caution.* The used length is ``caution`` deviations on the short side of the belief, grows by a ratio of at most
      ``largest_rise`` per estimate, and falls at once, but not below ``shortest_survivable`` of the believed length.

    Args:
        params: l0, interval of lengths, and the numbers named above.
        overlap: length of a window over the period of the runs; ``memory`` is one more.

    Raises:
        ValueError: ``rod_lengths`` are not in order.
    """

    def __init__(self, params: Params, overlap: float = 1.0) -> None:
        self._piloting, self._estimation = params.piloting, params.estimation
        low, high = self._piloting.rod_lengths
        if not low < high:
            raise ValueError(f"rod_lengths must be the shortest and the longest, not {low} m and {high} m")
        low, high = min(low, self._piloting.initial_length), max(high, self._piloting.initial_length)
        self._mean = (1 / low + 1 / high) / 2  # of 1/l, 1/m
        self._variance = ((1 / low - 1 / high) / 2 / self._piloting.caution) ** 2
        self._memory, self._runs = 1.0 + overlap, 0
        self.used = low

    @property
    def believed(self) -> tuple[float, float]:
        """Mean length of the belief and its standard deviation, m."""
        return 1 / self._mean, math.sqrt(self._variance) / self._mean**2

    def update(self, length: float, deviation: float = math.nan) -> float:
        """Take an estimate and its standard deviation in m; the length to use.

        It is ignored if not finite, or not within (l_min, l_max): the end of a search is no estimate; also if its
        deviation is infinite, zero or negative. A deviation of nan counts as ``default_deviation``.
        """
        piloting, estimation = self._piloting, self._estimation
        deviation = piloting.default_deviation if math.isnan(deviation) else deviation
        if not (estimation.length_min < length < estimation.length_max and 0 < deviation < math.inf):
            return self.used
        self._runs += 1
        inverse, variance = 1 / length, (deviation / length**2) ** 2
        if abs(inverse - self._mean) > piloting.outlier_gate * math.sqrt(self._variance + variance):
            self._variance *= 4.0
        else:
            share = 1 / min(self._runs + 1, self._memory)
            old, new = (1 - share) / self._variance, share / variance
            self._mean, self._variance = (old * self._mean + new * inverse) / (old + new), 1 / (old + new)
        cautious = 1 / (self._mean + piloting.caution * math.sqrt(self._variance))
        target = max(cautious, piloting.shortest_survivable / self._mean)
        target = min(target, piloting.largest_rise * self.used)
        self.used = max(estimation.length_min, min(estimation.length_max, target))
        return self.used


HANDOVERS: dict[str, type[PrintedHandOver] | type[TrustedHandOver]] = {
    "printed": PrintedHandOver,
    "trusted": TrustedHandOver,
}
"""Policies by their name in ``piloting.handover``; each is made of (params, overlap), has ``used``, the length in use
in m, and ``update``, which takes an estimate and gives the new one."""
