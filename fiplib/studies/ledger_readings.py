"""The estimator's rows of the ledger under other readings of the paper, and under the remedy that it names.

The variants of ``ledger_seeds`` that change the estimator; columns and measures are the same. 40 rows.
"""

from fiplib.studies import ledger_seeds

KEYS = ledger_seeds.KEYS
run = ledger_seeds.run


def cases() -> list[dict]:
    """Each variant of the estimator from either side of the truth, over its seeds."""
    return ledger_seeds.cases_of(ledger_seeds.ESTIMATOR)
