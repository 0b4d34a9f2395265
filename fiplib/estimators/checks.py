"""What keeps an estimator from an answer that means nothing: implausible flights before it, its residuals after it."""

from fiplib.recording import Flight


def why_no_length(flight: Flight, commands: bool = False) -> str | None:
    """Return why no length of this flight would mean anything, in one sentence; None if nothing speaks against it.

    With ``commands``, for estimators that need them, the commands are checked, too.
    """
    from fiplib.bags.checks import findings

    names = ("commands",) if commands else ()
    against = (finding.sentence for finding in findings(flight) if finding.refuses or finding.name in names)
    return next(against, None)


def tracked(flight: Flight) -> Flight:
    """Return the flight without the poses of bodies that were not tracked, as ``bags.tracking`` finds them."""
    from fiplib.bags import tracking

    return tracking.tracked(flight)
