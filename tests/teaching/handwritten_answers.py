"""Wrong and right answers written by hand, as students write them.

Of the 159 ``WRONG`` ones 108 were named in words when they were written; the grader was then extended until 155 were.
``FRESH`` and ``LATER`` were each written after that, and the grader extended again. ``RIGHT`` are right in other ways.
"""

import math
from collections.abc import Callable

import numpy as np

G = 9.81


def _nis(y, s, k):
    return y[k] @ np.linalg.inv(s[k]) @ y[k]


def _likelihood(y, s, half=0.5, constant=1.8378770664093453, size=None):
    total = 0.0
    for k in range(len(y)):
        determinant = np.linalg.slogdet(s[k])[1]
        total -= half * (_nis(y, s, k) + determinant + (size or y.shape[1]) * constant)
    return total


def _weights(fitness):
    finite = np.isfinite(fitness)
    return finite, np.where(finite, np.max(fitness[finite]) - fitness, 0.0)


def _settled(time, offset, band, plus=1):
    outside = np.flatnonzero(np.abs(offset) > band)
    if not len(outside):
        return time[0]
    return time[outside[-1] + plus] if outside[-1] + plus < len(time) else np.inf


def _axis(l, f, **entries):
    a = np.zeros((5, 5))
    a[0, 1] = a[2, 3] = 1
    a[1, 4], a[3, 2], a[3, 4] = G, 2 * f * G / l, -f * G
    for place, value in entries.items():
        a[int(place[1]), int(place[2])] = value
    return a


def _gain(a, b, r, p):
    return np.linalg.inv(r + b.T @ p @ b) @ b.T @ p @ a


def _steps(a, b, x, sent):
    for u in sent:
        x = a @ x + b @ u
    return x


def _diversity(bits, pairs=None):
    n = len(bits)
    total = sum(int(np.sum(bits[i] != bits[j])) for i in range(n) for j in range(i))
    return total / (pairs or n * (n - 1) / 2)


WRONG: dict[str, list[Callable]] = {
    "growth_rate": [
        lambda l, k2: np.sqrt(2 * G / l) / (1 + 4 * k2),  # the root of lambda forgotten
        lambda l, k2: np.sqrt(2 * G / l * (1 + 4 * k2)),  # lambda upside down
        lambda l, k2: np.sqrt(2 * G / l / (1 + k2)),  # four forgotten
        lambda l, k2: np.sqrt(2 * G / l / (1 + 2 * k2)),
        lambda l, k2: np.sqrt(2 * G / l / (1 + 4 * k2**2)),
        lambda l, k2: np.sqrt(2 * G / l / (1 + 4 * k2 / l**2)),  # a radius, not a ratio
        lambda l, k2: math.sqrt(l / (2 * G) * (1 + 4 * k2)),  # a time
        lambda l, k2: np.sqrt(2 * G * l / (1 + 4 * k2)),
        lambda l, k2: math.sqrt(2 * G / l * 0.75),  # a uniform rod
        lambda l, k2: np.sqrt(2 / l / (1 + 4 * k2)),  # g forgotten
        lambda l, k2: [np.sqrt(2 * G / l / (1 + 4 * k2)), -np.sqrt(2 * G / l / (1 + 4 * k2))],
        lambda l, k2: np.sqrt(2 * G / l / (1 - 4 * k2)),
    ],
    "axis_matrix": [
        lambda l, f: _axis(l, f, _14=-G),
        lambda l, f: _axis(l, f, _34=-G, _32=2 * G / l),
        lambda l, f: _axis(l, f, _32=2 * f * G / l**2),
        lambda l, f: _axis(l, f, _44=1),
        lambda l, f: np.array(_axis(l, f)[[0, 2, 1, 3, 4]]),
        lambda l, f: _axis(l, f, _32=f * G * l / 2),
        lambda l, f: _axis(l, f, _01=0, _10=1),
        lambda l, f: _axis(l, f, _14=1),
        lambda l, f: _axis(l, f)[:4, :4],
        lambda l, f: _axis(l, f) + np.eye(5),
    ],
    "steady_lean": [
        lambda r, t, l: -r * (w := 2 * np.pi / t) / (w + 2 * G / l),
        lambda r, t, l: -r * (w := 2 * np.pi / t) ** 2 / (w**2 - 2 * G / l),
        lambda r, t, l: -((w := 2 * np.pi / t) ** 2) / (w**2 + 2 * G / l),
        lambda r, t, l: -r * (w := 2 * np.pi * t) ** 2 / (w**2 + 2 * G / l),
        lambda r, t, l: -r * (w := 2 * np.pi / t) ** 2 / (w**2 + 2 * G * l),
        lambda r, t, l: math.atan((2 * np.pi / t) ** 2 * r / G),  # the vehicle's tilt
        lambda r, t, l: -r * (w := 360 / t) ** 2 / (w**2 + 2 * G / l),
        lambda r, t, l: -r * 2 * G / l / ((2 * np.pi / t) ** 2 + 2 * G / l),
        lambda r, t, l: r - r * (w := 2 * np.pi / t) ** 2 / (w**2 + 2 * G / l),
    ],
    "controllable_states": [
        lambda first, second: 6,
        lambda first, second: 5 if abs(first - second) > 0.01 else 7,
        lambda first, second: 7 if first < second else 6,
        lambda first, second: [7],
        lambda first, second: first != second,
    ],
    "riccati_step": [
        lambda a, b, q, r, p: q + a.T @ p @ (a + b @ _gain(a, b, r, p)),
        lambda a, b, q, r, p: q + a.T @ p @ a - _gain(a, b, r, p).T @ r @ _gain(a, b, r, p),
        lambda a, b, q, r, p: q + a @ p @ a.T - a @ p @ b @ np.linalg.inv(r + b.T @ p @ b) @ b.T @ p @ a.T,
        lambda a, b, q, r, p: q + (c := a - b @ _gain(a, b, r, p)).T @ p @ c,  # the cost of u is missing
        lambda a, b, q, r, p: _gain(a, b, r, p),
        lambda a, b, q, r, p: q + a.T @ q @ a - a.T @ q @ b @ np.linalg.inv(r + b.T @ q @ b) @ b.T @ q @ a,
        lambda a, b, q, r, p: p + a.T @ p @ a - a.T @ p @ b @ np.linalg.inv(r + b.T @ p @ b) @ b.T @ p @ a,
        lambda a, b, q, r, p: q + a.T * p * a,
    ],
    "growths": [
        lambda a, b, k, n: (np.linalg.norm(a, 2) ** n, np.linalg.norm(a - b @ k, 2) ** n),
        lambda a, b, k, n: tuple(max(abs(np.linalg.eigvals(np.linalg.matrix_power(m, n)))) for m in (a, a - b @ k)),
        lambda a, b, k, n: tuple(np.linalg.norm(np.linalg.matrix_power(m, n + 1), 2) for m in (a, a - b @ k)),
        lambda a, b, k, n: tuple(np.linalg.norm(np.linalg.matrix_power(m, n - 1), 2) for m in (a, a - b @ k)),
        lambda a, b, k, n: tuple(np.abs(np.linalg.matrix_power(m, n)).max() for m in (a, a - b @ k)),
        lambda a, b, k, n: tuple(np.linalg.norm(np.linalg.matrix_power(m, n), 1) for m in (a, a - b @ k)),
        lambda a, b, k, n: np.linalg.norm(np.linalg.matrix_power(a - b @ k, n), 2),
        lambda a, b, k, n: (np.linalg.norm(np.linalg.matrix_power(a, n), 2),) * 2,
    ],
    "state_when_it_acts": [
        lambda a, b, x, sent: a @ x + b @ sent[-1],
        lambda a, b, x, sent: a @ a @ a @ x,
        lambda a, b, x, sent: _steps(a, b, x, sent[:-1]),
        lambda a, b, x, sent: _steps(a, b, x, sent[1:]),
        lambda a, b, x, sent: _steps(a.T, b, x, sent),
        lambda a, b, x, sent: _steps(a, b, x, np.vstack([sent, 0 * sent[:1]])),
        lambda a, b, x, sent: sum(a @ x + b @ u for u in sent),
        lambda a, b, x, sent: _steps(a, -b, x, sent),
    ],
    "predict_covariance": [
        lambda j, p, q, step: (f := np.eye(4) + step * j) @ p @ f + q,
        lambda j, p, q, step: (f := np.eye(4) + step * j) @ p @ f.T + step * q,
        lambda j, p, q, step: p + step * (j @ p + p @ j.T) + q,  # to first order
        lambda j, p, q, step: (f := np.eye(4) - step * j) @ p @ f.T + q,
        lambda j, p, q, step: (f := 1 + step * j) @ p @ f.T + q,
        lambda j, p, q, step: (f := np.eye(4) + step * j) @ (p + q) @ f.T,
        lambda j, p, q, step: (f := np.eye(4) + step * j) @ p @ f.T - q,
        lambda j, p, q, step: (np.eye(4) + step * j) @ p + q,
    ],
    "normalised_innovations": [
        lambda y, s: [np.sqrt(_nis(y, s, k)) for k in range(len(y))],
        lambda y, s: [_nis(y, s, k) / y.shape[1] for k in range(len(y))],
        lambda y, s: sum(_nis(y, s, k) for k in range(len(y))),
        lambda y, s: [_nis(y, s, 0)] + [_nis(y, s, k - 1) for k in range(1, len(y))],
        lambda y, s: [y[k] @ np.linalg.inv(s[0]) @ y[k] for k in range(len(y))],
        lambda y, s: [y[k] @ s[k] @ y[k] for k in range(len(y))],
        lambda y, s: [_nis(y, s, k) for k in range(len(y) - 1)],
        lambda y, s: [y[k] @ y[k] / np.linalg.det(s[k]) for k in range(len(y))],
    ],
    "log_likelihood": [
        lambda y, s: _likelihood(y, s, half=1.0),
        lambda y, s: _likelihood(y, s, constant=math.log(math.pi)),
        lambda y, s: _likelihood(y, s, size=1),
        lambda y, s: np.exp(_likelihood(y, s)),
        lambda y, s: _likelihood(y, s) / len(y),
        lambda y, s: -0.5 * sum(_nis(y, s, k) for k in range(len(y))),
        lambda y, s: _likelihood(y[:-1], s[:-1]),
        lambda y, s: [_likelihood(y[k : k + 1], s[k : k + 1]) for k in range(len(y))],
        lambda y, s: _likelihood(y, s, constant=math.log10(2 * math.pi)),
    ],
    "decode": [
        lambda bits, low, step: low + step * (bits @ 2 ** np.arange(15, 0, -1)),
        lambda bits, low, step: low * (bits @ 2 ** np.arange(14, -1, -1)) + step,
        lambda bits, low, step: low + step * (bits @ 2 ** np.arange(14, -1, -1) + 1),
        lambda bits, low, step: low - step * (bits @ 2 ** np.arange(14, -1, -1)),
        lambda bits, low, step: (low + bits @ 2 ** np.arange(14, -1, -1)) * step,
        lambda bits, low, step: low + step * (bits[:, 1:] @ 2 ** np.arange(13, -1, -1)),
        lambda bits, low, step: low + (bits @ 2 ** np.arange(14, -1, -1)) / step,
        lambda bits, low, step: low + step * (~bits @ 2 ** np.arange(14, -1, -1)),
        lambda bits, low, step: low + step * (bits @ np.arange(15, 0, -1) ** 2),
    ],
    "roulette_probabilities": [
        lambda f: (w := _weights(f))[1] / w[0].sum(),
        lambda f: (w := _weights(f)[1]) / w.max(),
        lambda f: np.where(np.isfinite(f), 1 / np.isfinite(f).sum(), 0.0),
        lambda f: (w := _weights(f)[1])[w > 0] / w.sum(),
        lambda f: (w := _weights(f)[1] ** 2) / w.sum(),
        lambda f: (w := np.where(np.isfinite(f), -f, 0.0)) / w.sum(),
        lambda f: (w := np.where(np.isfinite(f), np.abs(f), 0.0)) / w.sum(),
        lambda f: np.cumsum((w := _weights(f)[1]) / w.sum()),
    ],
    "diversity": [
        lambda bits: _diversity(bits, len(bits)),
        lambda bits: _diversity(bits, len(bits) ** 2),
        lambda bits: bits.shape[1] - _diversity(bits),
        lambda bits: np.mean([np.sum(bits[k] != bits[k + 1]) for k in range(len(bits) - 1)]),
        lambda bits: len({tuple(row) for row in bits}),
        lambda bits: np.mean([np.sum(row != bits[0]) for row in bits[1:]]),
        lambda bits: sum(bits[:, k].std() for k in range(bits.shape[1])),
        lambda bits: _diversity(bits.T),
    ],
    "settling_time": [
        lambda time, offset, band: _settled(time, offset, band) - time[0],
        lambda time, offset, band: _settled(time, offset, band, 0),
        lambda time, offset, band: _settled(time, offset, 2 * band),
        lambda time, offset, band: _settled(time, offset, band / 2),
        lambda time, offset, band: time[-1] if np.isinf(t := _settled(time, offset, band)) else t,
        lambda time, offset, band: np.flatnonzero(np.abs(offset) > band)[-1],
        lambda time, offset, band: _settled(time, offset * (offset < 0), band),
        lambda time, offset, band: 0.0 if (t := _settled(time, offset, band)) == time[0] else t,
        lambda time, offset, band: time[np.argmax(np.abs(offset))],
    ],
    "fuse": [
        lambda l1, s1, l2, s2, w: ((1 - w) * l1 + w * l2, (1 - w) * s1 + w * s2),
        lambda l1, s1, l2, s2, w: ((1 - w) * l1 + w * l2, np.sqrt((1 - w) * s1**2 + w * s2**2)),
        lambda l1, s1, l2, s2, w: (
            (l1 / s1**2 + l2 / s2**2) / (1 / s1**2 + 1 / s2**2),
            ((1 - w) / s1**2 + w / s2**2) ** -0.5,
        ),
        lambda l1, s1, l2, s2, w: (
            ((1 - w) * l1 / s1**2 + w * l2 / s2**2) / ((1 - w) / s1**2 + w / s2**2),
            ((1 - w) / s1**2 + w / s2**2) ** 0.5,
        ),
        lambda l1, s1, l2, s2, w: (
            ((1 - w) * l1 / s1**2 + w * l2 / s2**2),
            ((1 - w) / s1**2 + w / s2**2) ** -0.5,
        ),
        lambda l1, s1, l2, s2, w: (
            ((1 - w) * l1 / s1**2 + w * l2 / s2**2) / ((1 - w) / s1**2 + w / s2**2),
            (1 / s1**2 + 1 / s2**2) ** -0.5,
        ),
        lambda l1, s1, l2, s2, w: (l2, s2),
    ],
    "cautious_length": [
        lambda l, s, c: 1 / (1 / l + s / l**2),
        lambda l, s, c: 1 / (1 / l + c * s / l),
        lambda l, s, c: 1 / l - c * s / l**2,
        lambda l, s, c: 1 / (1 / l + c * np.sqrt(s) / l**2),
        lambda l, s, c: l * np.exp(-c * s / l),
        lambda l, s, c: l / (l + s),
        lambda l, s, c: 1 / (1 / l + c / s),
        lambda l, s, c: 1 / (1 / l + c * s**2 / l**2),
    ],
    "velocities": [
        lambda t, p: np.diff(p, axis=0) / (np.diff(t)[:, None] / 1e6),
        lambda t, p: np.gradient(p, axis=0) / np.gradient(t / 1e9)[:, None],
        lambda t, p: np.diff(p, axis=0),
        lambda t, p: np.diff(t)[:, None] / 1e9 / np.diff(p, axis=0),
        lambda t, p: np.linalg.norm(np.diff(p, axis=0), axis=1) / (np.diff(t) / 1e9),
        lambda t, p: (np.diff(p, axis=0) / (np.diff(t)[:, None] / 1e9)).T,
        lambda t, p: p[1:] / (np.diff(t)[:, None] / 1e9),
        lambda t, p: (p[2:] - p[:-2]) / ((t[2:] - t[:-2])[:, None] / 1e9),
    ],
    "length_from_lean": [
        lambda d, tilt: 2 * np.polyfit(tilt, d, 1)[0] + 0.01,
        lambda d, tilt: np.mean(d) / np.mean(tilt),
        lambda d, tilt: 2 * np.sum(d * tilt),
        lambda d, tilt: 2 * np.median(d / tilt),
        lambda d, tilt: 2 * np.linalg.norm(d) / np.linalg.norm(tilt),
        lambda d, tilt: 2 * d / tilt,
        lambda d, tilt: 4 * np.sum(d * tilt) / np.sum(tilt**2),
        lambda d, tilt: 2 * np.sum(d * tilt) / np.sum(tilt) ** 2,
        lambda d, tilt: 2 * G * np.sum(d * tilt) / np.sum(tilt**2),
    ],
    "fresh": [
        lambda t, p: np.append(True, (np.diff(t) > 0) | (np.diff(p, axis=0) != 0).any(axis=1)),
        lambda t, p: np.append(False, (np.diff(t) > 0) & (np.diff(p, axis=0) != 0).any(axis=1)),
        lambda t, p: np.append((np.diff(t) > 0) & (np.diff(p, axis=0) != 0).any(axis=1), True),
        lambda t, p: np.append(True, (np.diff(t) > 0) & (np.diff(p[:, 0]) != 0)),
        lambda t, p: np.flatnonzero(np.append(True, (np.diff(t) > 0) & (np.diff(p, axis=0) != 0).any(axis=1))),
        lambda t, p: np.full(len(t), True),
        lambda t, p: (
            np.append(True, np.linalg.norm(np.diff(p, axis=0), axis=1) > 1e-3) & np.append(True, np.diff(t) > 0)
        ),
        lambda t, p: np.append(True, (np.diff(t) < 0) & (np.diff(p, axis=0) != 0).any(axis=1)),
    ],
}


FRESH: dict[str, list[Callable]] = {
    "growth_rate": [
        lambda l, k2: np.sqrt(12 * G / l / (1 + 4 * k2)),
        lambda l, k2: 2 * np.sqrt(G / l / (1 + 4 * k2)),
        lambda l, k2: np.sqrt(2 * G / l) - np.sqrt(k2),
        lambda l, k2: np.sqrt(2 * G / l / (0.25 + k2)),
        lambda l, k2: np.sqrt(3 * G / (2 * l)),
        lambda l, k2: np.sqrt(2 * G / (l * 1 + 4 * k2)),  # brackets
    ],
    "axis_matrix": [
        lambda l, f: _axis(l, f, _14=9.81 * f),
        lambda l, f: _axis(l, f, _32=f * G / l, _34=-G * f),
        lambda l, f: _axis(l, f)[:, ::-1],
        lambda l, f: _axis(l, f, _34=0, _14=0),
        lambda l, f: _axis(l, f, _32=2 * G / (f * l)),
        lambda l, f: _axis(l, f, _23=0, _22=1),
    ],
    "steady_lean": [
        lambda r, t, l: -r * (w := 2 * np.pi / t) ** 2 / (w**2 + G / l) / 2,
        lambda r, t, l: -r * (w := 4 * np.pi / t) ** 2 / (w**2 + 2 * G / l),
        lambda r, t, l: -r / (1 + 2 * G / l),
        lambda r, t, l: -((r * 2 * np.pi / t) ** 2) / ((2 * np.pi / t) ** 2 + 2 * G / l),
        lambda r, t, l: np.degrees(-r * (w := 2 * np.pi / t) ** 2 / (w**2 + 2 * G / l)),
        lambda r, t, l: -r * (2 * np.pi / t) ** 2 / (2 * G / l),
    ],
    "controllable_states": [
        lambda first, second: 4 if first == second else 6,
        lambda first, second: 7 if first != second else 3,
        lambda first, second: 7 if second > 0.8 else 5,
        lambda first, second: (5, 7),
    ],
    "riccati_step": [
        lambda a, b, q, r, p: q - a.T @ p @ a + a.T @ p @ b @ np.linalg.inv(r + b.T @ p @ b) @ b.T @ p @ a,
        lambda a, b, q, r, p: q + a.T @ p @ a - a.T @ p @ b @ (r + b.T @ p @ b) @ b.T @ p @ a,
        lambda a, b, q, r, p: q + (k := _gain(a, b, r, p)).T @ r @ k + (a + b @ k).T @ p @ (a + b @ k),
        lambda a, b, q, r, p: (q + a.T @ p @ (a - b @ _gain(a, b, r, p))) / 2,
        lambda a, b, q, r, p: np.diag(q + a.T @ p @ (a - b @ _gain(a, b, r, p))),
        lambda a, b, q, r, p: q + a.T @ p @ a - a.T @ p @ b @ np.linalg.inv(b.T @ p @ b) @ b.T @ p @ a,
    ],
    "growths": [
        lambda a, b, k, n: tuple(np.linalg.norm(np.linalg.matrix_power(m, n)) for m in (a, a - b @ k)),
        lambda a, b, k, n: (np.linalg.norm(a @ a, 2), np.linalg.norm((a - b @ k) @ (a - b @ k), 2)),
        lambda a, b, k, n: tuple(np.linalg.norm(np.linalg.matrix_power(m, n), -2) for m in (a, a - b @ k)),
        lambda a, b, k, n: tuple(np.log(np.linalg.norm(np.linalg.matrix_power(m, n), 2)) for m in (a, a - b @ k)),
        lambda a, b, k, n: tuple(np.linalg.norm(np.linalg.matrix_power(m, n), 2) ** 2 for m in (a, a - b @ k)),
        lambda a, b, k, n: tuple(np.linalg.norm(np.linalg.matrix_power(m, n), 2) for m in (a, -b @ k)),
    ],
    "state_when_it_acts": [
        lambda a, b, x, sent: x + a @ x + b @ sent[0],
        lambda a, b, x, sent: np.linalg.matrix_power(a, 3) @ x + b @ sent.sum(axis=0),
        lambda a, b, x, sent: _steps(a, b, 0 * x, sent),
        lambda a, b, x, sent: a @ _steps(a, b, x, sent),
        lambda a, b, x, sent: _steps(a, b, x, sent / 2),
        lambda a, b, x, sent: [_steps(a, b, x, sent[: k + 1]) for k in range(len(sent))],
    ],
    "predict_covariance": [
        lambda j, p, q, step: (f := np.eye(4) + step * j) * p * f.T + q,
        lambda j, p, q, step: (f := np.eye(4) + step**2 * j) @ p @ f.T + q,
        lambda j, p, q, step: p + step * j @ p @ j.T + q,
        lambda j, p, q, step: (f := np.eye(4) + step * j) @ p @ f.T + q**2,
        lambda j, p, q, step: (f := np.eye(4) + step * j) @ p @ np.linalg.inv(f) + q,
        lambda j, p, q, step: (f := np.eye(4) + step * j) @ q @ f.T + p,
    ],
    "normalised_innovations": [
        lambda y, s: [y[k] @ np.linalg.inv(s[k]) for k in range(len(y))],
        lambda y, s: [_nis(y, s, k) for k in range(len(y))][::-1],
        lambda y, s: [(y[k] @ y[k]) / np.trace(s[k]) for k in range(len(y))],
        lambda y, s: np.cumsum([_nis(y, s, k) for k in range(len(y))]),
        lambda y, s: [abs(y[k]) @ np.linalg.inv(s[k]) @ abs(y[k]) for k in range(len(y))],
        lambda y, s: [_nis(y, s, k) / 2 for k in range(len(y))],
    ],
    "log_likelihood": [
        lambda y, s: _likelihood(y, s) / math.log(10),
        lambda y, s: _likelihood(y, s) + 0.5 * sum(_nis(y, s, k) for k in range(len(y))),
        lambda y, s: -0.5 * sum(_nis(y, s, k) - np.log(np.linalg.det(s[k])) for k in range(len(y))),
        lambda y, s: _likelihood(y, s, half=0.25),
        lambda y, s: sum(np.log(np.linalg.det(s[k])) for k in range(len(y))),
        lambda y, s: np.log(-_likelihood(y, s)),
    ],
    "decode": [
        lambda bits, low, step: low + step * (bits @ 2 ** np.arange(15)) / 2,
        lambda bits, low, step: low + step * (bits @ 10.0 ** np.arange(14, -1, -1)),
        lambda bits, low, step: bits @ 2 ** np.arange(14, -1, -1),
        lambda bits, low, step: low + (bits @ 2 ** np.arange(14, -1, -1)) / 2**15,
        lambda bits, low, step: low + step * (bits @ 2 ** np.arange(14, -1, -1) - 1),
        lambda bits, low, step: sum(low + step * (bits @ 2 ** np.arange(14, -1, -1))),
    ],
    "roulette_probabilities": [
        lambda f: _weights(f)[1] / len(f),
        lambda f: 1 - (w := _weights(f)[1]) / w.sum(),
        lambda f: (w := np.where(np.isfinite(f), np.exp(-f / 200), 0)) / w.sum(),
        lambda f: (w := np.where(np.isfinite(f), f[np.isfinite(f)].mean() - f, 0)) / w.sum(),
        lambda f: np.sort((w := _weights(f)[1]) / w.sum()),
        lambda f: (w := np.argsort(np.argsort(-f))) / w.sum(),
    ],
    "diversity": [
        lambda bits: 2 * _diversity(bits) / bits.shape[1],
        lambda bits: _diversity(bits, 1) / len(bits) * 2,
        lambda bits: _diversity(bits) ** 2,
        lambda bits: np.mean([np.sum(a & b) for k, a in enumerate(bits) for b in bits[:k]]),
        lambda bits: bits.sum(axis=1).mean(),
        lambda bits: max(np.sum(a != b) for a in bits for b in bits),
    ],
    "settling_time": [
        lambda time, offset, band: next((t for t, d in zip(time, offset, strict=True) if abs(d) > band), np.inf),
        lambda time, offset, band: _settled(time, offset, band, 2),
        lambda time, offset, band: _settled(time, offset**2, band),
        lambda time, offset, band: np.nan if np.isinf(t := _settled(time, offset, band)) else t,
        lambda time, offset, band: len(time) if np.isinf(t := _settled(time, offset, band)) else t,
        lambda time, offset, band: 0.01 * np.argmin(np.abs(time - _settled(time, offset, band))),
    ],
    "fuse": [
        lambda l1, s1, l2, s2, w: ((l1 + l2) / 2, (s1 + s2) / 2),
        lambda l1, s1, l2, s2, w: (
            (w * l1 / s1**2 + (1 - w) * l2 / s2**2) / (w / s1**2 + (1 - w) / s2**2),
            ((1 - w) / s1**2 + w / s2**2) ** -0.5,
        ),
        lambda l1, s1, l2, s2, w: (
            (l1 / s1**2 + w * l2 / s2**2) / (1 / s1**2 + w / s2**2),
            (1 / s1**2 + w / s2**2) ** -0.5,
        ),
        lambda l1, s1, l2, s2, w: (
            ((1 - w) * l1 * s1**2 + w * l2 * s2**2) / ((1 - w) * s1**2 + w * s2**2),
            ((1 - w) * s1**2 + w * s2**2) ** 0.5,
        ),
        lambda l1, s1, l2, s2, w: (
            ((1 - w) * l1 / s1**2 + w * l2 / s2**2) / ((1 - w) / s1**2 + w / s2**2),
            (1 - w) / s1**2 + w / s2**2,
        ),
        lambda l1, s1, l2, s2, w: l1 + w * (l2 - l1),
    ],
    "cautious_length": [
        lambda l, s, c: l - c * s / l**2,
        lambda l, s, c: 1 / (1 / l + c * s / l**3),
        lambda l, s, c: 1 / (1 / l + 2 * c * s / l**2),
        lambda l, s, c: l / (1 + c * s),
        lambda l, s, c: 1 / (l + c * s),
        lambda l, s, c: max(l - s, 0.0),
    ],
    "velocities": [
        lambda t, p: np.diff(p, axis=0) / (np.diff(t)[:, None] * 1e9),
        lambda t, p: np.diff(p, axis=1) / (t[1] - t[0]) * 1e9,
        lambda t, p: np.diff(p, axis=0) / (np.diff(t.astype(np.float32))[:, None] / 1e9),
        lambda t, p: (p[1:] + p[:-1]) / 2 / (np.diff(t)[:, None] / 1e9),
        lambda t, p: np.abs(np.diff(p, axis=0)) / (np.diff(t)[:, None] / 1e9),
        lambda t, p: np.diff(p, axis=0) / (t[1:, None] / 1e9),
    ],
    "length_from_lean": [
        lambda d, tilt: 2 * np.sum(d / tilt),
        lambda d, tilt: np.sum(d * tilt) / np.sum(tilt**2) / 2,
        lambda d, tilt: 2 * np.sum(d * np.sin(np.radians(tilt))) / np.sum(np.sin(np.radians(tilt)) ** 2),
        lambda d, tilt: 2 * np.corrcoef(d, tilt)[0, 1],
        lambda d, tilt: 2 * np.std(d) / np.std(tilt),
        lambda d, tilt: 2 * np.max(d) / np.max(tilt),
    ],
    "fresh": [
        lambda t, p: np.append(True, (np.diff(t) >= 0) & (np.diff(p, axis=0) != 0).any(axis=1)),
        lambda t, p: np.append(True, (np.diff(t) > 0) & (np.diff(p.sum(axis=1)) > 0)),
        lambda t, p: np.append(True, (np.diff(t) > 0))[:, None] & np.vstack([[True] * 3, np.diff(p, axis=0) != 0]),
        lambda t, p: np.append(False, (np.diff(t) == 0) | (np.diff(p, axis=0) == 0).all(axis=1)),
        lambda t, p: np.append(True, np.diff(t) > 4_000_000),
        lambda t, p: np.append(True, (np.diff(t) > 0) & (np.diff(p, axis=0) != 0).any(axis=1)).sum(),
    ],
}

LATER: dict[str, list[Callable]] = {
    "growth_rate": [
        lambda l, k2: np.sqrt(G / (2 * l) / (1 + 4 * k2)),
        lambda l, k2: np.sqrt(2 * G / l) * 4 * k2,
        lambda l, k2: np.sqrt(2 * G / l / (1 + 16 * k2)),
        lambda l, k2: np.sqrt(2 * 9.0 / l / (1 + 4 * k2)),
    ],
    "axis_matrix": [
        lambda l, f: _axis(l, f, _14=0, _41=G),
        lambda l, f: _axis(l, f, _32=-_axis(l, f)[3, 4], _34=-_axis(l, f)[3, 2]),
        lambda l, f: _axis(l, f)[:-1],
        lambda l, f: _axis(l, f, _32=np.sqrt(2 * f * G / l)),
        lambda l, f: np.hstack([_axis(l, f), np.eye(5)[:, 4:]]),
    ],
    "steady_lean": [
        lambda r, t, l: r,
        lambda r, t, l: -r * 4 * np.pi / t**2 / (4 * np.pi / t**2 + 2 * G / l),
        lambda r, t, l: -r * (w := 2 * np.pi / t) ** 2 / (w**2 + 2 * G / l) - r,
        lambda r, t, l: -2 * r * (w := 2 * np.pi / t) ** 2 / (w**2 + 2 * G / l) / l,  # as an angle
        lambda r, t, l: -l / 2 * math.sin(math.atan(r * (2 * np.pi / t) ** 2 / G)),
    ],
    "controllable_states": [
        lambda first, second: 7 if first == second else 7 - 1,
        lambda first, second: 5 if round(first, 1) == round(second, 1) else 7,
        lambda first, second: 2,
        lambda first, second: 7 * first / second,
    ],
    "riccati_step": [
        lambda a, b, q, r, p: q + a.T @ p @ (a - b @ _gain(a, b, r, p).conj()) + r[0, 0],
        lambda a, b, q, r, p: q + a.T @ p @ a - a.T @ p @ b @ np.linalg.inv(r + b.T @ b) @ b.T @ p @ a,
        lambda a, b, q, r, p: q + a.T @ p @ a - a.T @ p @ b @ np.linalg.inv(r + b.T @ q @ b) @ b.T @ p @ a,
        lambda a, b, q, r, p: q + a.T @ (p - p @ b @ np.linalg.inv(r + b.T @ p @ b) @ b.T @ p),
        lambda a, b, q, r, p: q + a.T @ p @ a + r.sum(),
    ],
    "growths": [
        lambda a, b, k, n: tuple(np.linalg.norm(np.linalg.matrix_power(m.T, n) @ m, 2) for m in (a, a - b @ k)),
        lambda a, b, k, n: tuple(n * np.linalg.norm(m, 2) for m in (a, a - b @ k)),
        lambda a, b, k, n: tuple(np.linalg.det(np.linalg.matrix_power(m, n)) for m in (a, a - b @ k)),
        lambda a, b, k, n: tuple(
            np.linalg.norm(sum(np.linalg.matrix_power(m, i) for i in range(n)), 2) for m in (a, a - b @ k)
        ),
        lambda a, b, k, n: tuple(np.linalg.svd(np.linalg.matrix_power(m, n))[1] for m in (a, a - b @ k)),
    ],
    "state_when_it_acts": [
        lambda a, b, x, sent: x + sum(b @ u for u in sent[::-1]) + a @ x,
        lambda a, b, x, sent: np.linalg.matrix_power(a, len(sent)) @ x + b @ sent[0],
        lambda a, b, x, sent: _steps(a, b, a @ x, sent),
        lambda a, b, x, sent: _steps(a, b, x, sent[:, ::-1]),
        lambda a, b, x, sent: np.linalg.norm(_steps(a, b, x, sent)),
    ],
    "predict_covariance": [
        lambda j, p, q, step: (f := step * j) @ p @ f.T + p + q,
        lambda j, p, q, step: (f := np.eye(4) + step * j) @ (f @ p).T @ f + q,
        lambda j, p, q, step: (f := np.exp(step * j)) @ p @ f.T + q,
        lambda j, p, q, step: (f := np.eye(4) + step * j) @ p @ f.T + step**2 * q,
        lambda j, p, q, step: np.diag(np.diag((f := np.eye(4) + step * j) @ p @ f.T + q)),
    ],
    "normalised_innovations": [
        lambda y, s: [y[k] @ np.linalg.inv(s[k]) @ y[k - 1] for k in range(len(y))],
        lambda y, s: [np.linalg.norm(np.linalg.inv(np.linalg.cholesky(s[k])) @ y[k]) for k in range(len(y))],
        lambda y, s: [y[k] @ np.linalg.inv(s.mean(axis=0)) @ y[k] for k in range(len(y))],
        lambda y, s: [np.max(y[k] ** 2 / np.diag(s[k])) for k in range(len(y))],
        lambda y, s: np.mean([_nis(y, s, k) for k in range(len(y))]) * np.ones(len(y)),
    ],
    "log_likelihood": [
        lambda y, s: _likelihood(y, s) * len(y),
        lambda y, s: _likelihood(y, s, constant=0.0) - len(y) * 1.8378770664093453,
        lambda y, s: _likelihood(y, s[:1].repeat(len(y), axis=0)),
        lambda y, s: -(_likelihood(y, s) ** 2),
        lambda y, s: _likelihood(y - y.mean(axis=0), s),
    ],
    "decode": [
        lambda bits, low, step: low + step * (bits @ 2 ** np.arange(15, -1, -1)[:15]),
        lambda bits, low, step: low + step * (bits @ np.arange(14, -1, -1)),
        lambda bits, low, step: low + step * np.round((bits @ 2 ** np.arange(14, -1, -1)) / 10) * 10,
        lambda bits, low, step: low + step * (bits[:, :-1] @ 2 ** np.arange(13, -1, -1)),
        lambda bits, low, step: low * step * (bits @ 2 ** np.arange(14, -1, -1)),
    ],
    "roulette_probabilities": [
        lambda f: (w := np.where(np.isfinite(f), 1000 - f, 0)) / w.sum(),
        lambda f: (w := np.where(np.isfinite(f), f[np.isfinite(f)].max() - f, 1)) / w.sum(),
        lambda f: (f == f.min()) * 1.0,
        lambda f: (w := _weights(f)[1])[::-1] / w.sum(),
        lambda f: 100 * (w := _weights(f)[1]) / w.sum(),
    ],
    "diversity": [
        lambda bits: np.mean([np.sum(a != b) for k, a in enumerate(bits[1:]) for b in bits[: k + 2]]),
        lambda bits: _diversity(bits) - 1,
        lambda bits: np.mean([np.any(a != b) for k, a in enumerate(bits) for b in bits[:k]]),
        lambda bits: np.median([np.sum(a != b) for k, a in enumerate(bits) for b in bits[:k]]),
        lambda bits: _diversity(bits[:-1]),
    ],
    "settling_time": [
        lambda time, offset, band: _settled(time, offset, band * np.abs(offset).max()),
        lambda time, offset, band: time[-1],
        lambda time, offset, band: next((t for t, d in zip(time, offset, strict=True) if d <= band), np.inf),
        lambda time, offset, band: _settled(time, np.degrees(offset), band),
        lambda time, offset, band: [t for t, d in zip(time, offset, strict=True) if abs(d) <= band],
    ],
    "fuse": [
        lambda l1, s1, l2, s2, w: (l1 * (1 - w) / s1 + l2 * w / s2, math.hypot(s1, s2)),
        lambda l1, s1, l2, s2, w: (
            ((1 - w) * l1 / s1**2 + w * l2 / s2**2) / ((1 - w) / s1**2 + w / s2**2),
            math.sqrt((1 - w) * s1**2 + w * s2**2),
        ),
        lambda l1, s1, l2, s2, w: (
            (l1 / s1**2 + l2 / s2**2) / (1 / s1**2 + 1 / s2**2),
            (1 / s1**2 + 1 / s2**2) ** -0.5 / 2,
        ),
        lambda l1, s1, l2, s2, w: (
            ((1 - w) * l1 / s1**2 + w * l2 / s2**2) / ((1 - w) / s1**2 + w / s2**2),
            min(s1, s2),
        ),
        lambda l1, s1, l2, s2, w: (
            ((1 - w) ** 2 * l1 / s1**2 + w**2 * l2 / s2**2) / ((1 - w) ** 2 / s1**2 + w**2 / s2**2),
            ((1 - w) ** 2 / s1**2 + w**2 / s2**2) ** -0.5,
        ),
    ],
    "cautious_length": [
        lambda l, s, c: 1 / (1 / l + c * s**2 / l**4),
        lambda l, s, c: c / (1 / l + s / l**2),
        lambda l, s, c: 1 / (1 / l + c / l**2),
        lambda l, s, c: 1 / l + c * s,
        lambda l, s, c: l * (1 - c * s / l),
    ],
    "velocities": [
        lambda t, p: np.diff(p, axis=0) * np.diff(t)[:, None] / 1e9,
        lambda t, p: np.diff(p, axis=0) / (t[-1] - t[0]) * 1e9,
        lambda t, p: np.diff(p, axis=0)[1:] / (np.diff(t)[1:, None] / 1e9),
        lambda t, p: np.diff(p, axis=0) / (np.median(np.diff(t)) / 1e9),
        lambda t, p: np.diff(p, axis=0) / (np.diff(t)[::-1, None] / 1e9),
    ],
    "length_from_lean": [
        lambda d, tilt: 2 * np.sum(d * tilt) / np.sum(d**2),
        lambda d, tilt: 2 * np.sum(d * tilt) / len(d),
        lambda d, tilt: 2 * np.sum(np.abs(d)) / np.sum(np.abs(tilt)),
        lambda d, tilt: 2 * np.sum(d**2) / np.sum(tilt**2),
        lambda d, tilt: 2 * d[-1] / tilt[-1],
    ],
    "fresh": [
        lambda t, p: np.append(True, (np.diff(t) > 0) & (np.diff(p, axis=0) > 0).any(axis=1)),
        lambda t, p: np.append(True, (np.diff(t) > 0) & (np.diff(p[:, 2]) != 0)),
        lambda t, p: (np.diff(t) > 0) & (np.diff(p, axis=0) != 0).any(axis=1),
        lambda t, p: p[np.append(True, (np.diff(t) > 0) & (np.diff(p, axis=0) != 0).any(axis=1))],
        lambda t, p: np.append(True, (np.diff(t) > 0) ^ (np.diff(p, axis=0) != 0).any(axis=1)),
    ],
}

RIGHT: dict[str, list[Callable]] = {
    "growth_rate": [
        lambda l, k2: (2 * 9.807 / (l * (1 + 4 * k2))) ** 0.5,
        lambda l, k2: np.roots([1, 0, -2 * G / l / (1 + 4 * k2)]).max(),
        lambda l, k2: round(math.sqrt(2 * G / l / (1 + 4 * k2)), 4),
        lambda l, k2: np.linalg.eigvals(np.array([[0, 1], [2 * G / l / (1 + 4 * k2), 0]]) + 0j).max(),
    ],
    "axis_matrix": [lambda l, f: [list(map(float, row)) for row in _axis(l, f)]],
    "steady_lean": [lambda r, t, l: -r / (1 + 2 * G / l / (2 * 3.1416 / t) ** 2)],
    "controllable_states": [
        lambda first, second: 7.0 if first != second else 5.0,
        lambda first, second: np.int8(5 + 2 * (first != second)),
    ],
    "riccati_step": [
        lambda a, b, q, r, p: q + a.T @ np.linalg.inv(np.linalg.inv(p) + b @ np.linalg.inv(r) @ b.T) @ a,
        lambda a, b, q, r, p: q + a.T @ p @ (a - b @ _gain(a, b, r, p)),
    ],
    "growths": [
        lambda a, b, k, n: [np.linalg.svd(np.linalg.matrix_power(m, n), compute_uv=False)[0] for m in (a, a - b @ k)],
    ],
    "state_when_it_acts": [
        lambda a, b, x, sent: a @ (a @ (a @ x + b @ sent[0]) + b @ sent[1]) + b @ sent[2],
        lambda a, b, x, sent: _steps(a, b, x[:, None], sent[:, :, None]),
    ],
    "predict_covariance": [
        lambda j, p, q, step: p + step * (j @ p + p @ j.T) + step**2 * j @ p @ j.T + q,
    ],
    "normalised_innovations": [
        lambda y, s: [_nis(y, s, k) for k in range(len(y))],
        lambda y, s: np.array([[_nis(y, s, k)] for k in range(len(y))]),
    ],
    "log_likelihood": [_likelihood, lambda y, s: [[_likelihood(y, s)]]],
    "decode": [
        lambda bits, low, step: [low + step * int("".join(str(int(bit)) for bit in row), 2) for row in bits],
    ],
    "roulette_probabilities": [lambda f: list((w := _weights(f)[1]) / w.sum())],
    "diversity": [
        _diversity,
        lambda bits: np.mean([np.sum(a != b) for j, a in enumerate(bits) for k, b in enumerate(bits) if j != k]),
    ],
    "settling_time": [_settled, lambda *of: [_settled(*of)]],
    "fuse": [
        lambda l1, s1, l2, s2, w: [
            ((1 - w) * l1 * s2**2 + w * l2 * s1**2) / ((1 - w) * s2**2 + w * s1**2),
            s1 * s2 / math.sqrt((1 - w) * s2**2 + w * s1**2),
        ],
    ],
    "cautious_length": [lambda l, s, c: l**2 / (l + c * s), lambda l, s, c: (l / (1 + c * s / l),)],
    "velocities": [
        lambda t, p: [(p[k + 1] - p[k]) / ((t[k + 1] - t[k]) * 1e-9) for k in range(len(t) - 1)],
        lambda t, p: np.diff(p, axis=0) / np.diff((t - t[0]) / 1e9)[:, None],
    ],
    "length_from_lean": [
        lambda d, tilt: 2 * np.linalg.lstsq(tilt[:, None], d)[0],
        lambda d, tilt: 2 * float(np.dot(d, tilt) / np.dot(tilt, tilt)),
    ],
    "fresh": [
        lambda t, p: [True] + [bool(t[k] > t[k - 1] and (p[k] != p[k - 1]).any()) for k in range(1, len(t))],
        lambda t, p: [1] + [int(t[k] > t[k - 1] and tuple(p[k]) != tuple(p[k - 1])) for k in range(1, len(t))],
    ],
}
