"""Wrong and right answers written by hand after the grader was finished, as students write them: nothing was tuned on them.

``test_grading`` reports which share of the wrong ones is named in words.
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
