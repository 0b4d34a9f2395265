"""The exercises of the notebooks: one module a notebook, one ``Exercise`` for each function that a student writes.

The module's ``Exercise`` has the name of the function: ``exercises.growth_rate.check(growth_rate)`` grades the answer.
"""
