"""Estimators of the pendulum's length, one a file, behind one call.

``ESTIMATORS[name].function(window, params, rng) -> Estimate`` is what flies; ``answer``, with the same arguments, is
what may be stated as a result: refused at an end of the search interval, or where the residuals contradict it. An
estimator of kind 'states' takes the paper's window (``kalman.Window``: 55 derived states in steps of 0.1 s) and uses
the paper's model; one of kind 'raw' takes motion capture as measured (``windows.RawWindow``). To add one, write a file
with such a function and a line of ``ESTIMATORS``; it is imported when it is first called.

What they do with the same window:

- ``ga``, ``ga_improved``, ``grid``, ``scalar`` search the same fitness (``kalman.fitness``) by different means.
- ``ga_poses`` searches another fitness by the means of ``ga``: the profile likelihood of the poses as measured.
- ``ekf``, ``ukf`` estimate the states and the length together, forwards in time, the length being one more state.
- ``moving_horizon`` fits all states of the window and the length together, by nonlinear programming.
- ``recursive_least_squares``, ``concurrent_learning`` regress d'' + g tilt = (1/l) 2 g d, with d'' from differences of
  d' over a step. Differencing throws most of the information away: what d' owes to noise is as large as what it owes to
  the length. The price of their simplicity.
- ``poses`` is ours and the recommended one (``poses.in_flight``): maximum a posteriori on the poses of both bodies as
  measured, from nothing but motion. It goes on from window to window: ``function`` gives a new one for each flight.
"""

from fiplib.estimators.base import Estimator

ESTIMATORS = {
    "ga": Estimator("genetic:ga", "states"),
    "ga_improved": Estimator("genetic:ga_improved", "states"),
    "ga_poses": Estimator("genetic:ga_poses", "raw"),
    "grid": Estimator("grid:grid", "states"),
    "scalar": Estimator("brent:scalar", "states"),
    "ekf": Estimator("ekf:ekf", "states"),
    "ukf": Estimator("ukf:ukf", "states"),
    "recursive_least_squares": Estimator("recursive_least_squares:recursive_least_squares", "states"),
    "concurrent_learning": Estimator("concurrent_learning:concurrent_learning", "states"),
    "moving_horizon": Estimator("moving_horizon:moving_horizon", "states"),
    "poses": Estimator("poses.in_flight:InFlight", "raw", streams=True),
}
"""Every estimator by name; ``estimation.estimator`` chooses the one in flight."""
