"""The length of a rod from poses alone: an asynchronous Kalman filter whose likelihood is maximised.

``knowledge`` says what is known beforehand, ``rows`` makes measured rows of the poses of two bodies, ``filter`` is the
model and the compiled recursion, ``fit`` finds the maximum a posteriori, ``checks`` says what speaks against it,
``estimate`` puts the answer together; ``planar`` does the same for carts and arms, ``stream`` for flights that go on,
and ``history`` for recorded ones of any duration.
The modules with compiled code, and those that need them, take half a second to import.
"""
