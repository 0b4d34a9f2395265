"""Wrong answers written by hand after the grader was extended, in one go, and not changed after its first run on them.

The author of the grader wrote them, without its code at hand, but not without knowing it: other students may do worse.
They are written as different students think: an error of the physics, of numpy, a task misread. Nothing was tuned on
them: of what the grader says about them the test records the share that is named.
"""

import math
from collections.abc import Callable

import numpy as np

G = 9.81


def _axis_with(l: float, f: float, **rows: list[float]) -> np.ndarray:
    a = np.array([[0, 1, 0, 0, 0], [0, 0, 0, 0, G], [0, 0, 0, 1, 0], [0, 0, 2 * f * G / l, 0, -f * G], [0, 0, 0, 0, 0]])
    for row, values in rows.items():
        a[int(row[1:])] = values
    return a


def _point_mass(a, b, va, vb, p, l, spin=True, along=True, scale=1.0):
    r = l / 2
    height = math.sqrt(r**2 - a**2 - b**2)
    q = np.array([a, b, height]) / r
    rate = np.array([va, vb, -(a * va + b * vb) / height]) / r
    alpha = scale * (p + np.array([0, 0, G]))
    across = alpha - q * (q @ alpha) if along else np.cross(q, alpha)
    return (-r * (rate @ rate) * q * spin - across)[:2]


def _pair_differences(bits):
    return [np.sum(bits[i] ^ bits[j]) for i in range(len(bits)) for j in range(i + 1, len(bits))]


def _last_crossing(time, offset, band):
    outside = np.abs(offset) > band
    crossings = np.flatnonzero(outside[:-1] & ~outside[1:])
    return time[crossings[-1] + 1] if len(crossings) else time[0]


FIRST_SEEN: dict[str, list[Callable]] = {
    "height_rate": [
        lambda a, b, va, vb, l: -np.sqrt(va**2 + vb**2) * np.hypot(a, b) / np.sqrt(l**2 / 4 - a**2 - b**2),
        lambda a, b, va, vb, l: -(a * va + b * vb) / np.sqrt(l / 2 - a**2 - b**2),
        lambda a, b, va, vb, l: -(va + vb) / 2 / np.sqrt(l**2 / 4 - a**2 - b**2),
        lambda a, b, va, vb, l: (l - 2 * a * va - 2 * b * vb) / (2 * np.sqrt(l**2 / 4 - a**2 - b**2)),
        lambda a, b, va, vb, l: np.sqrt(l**2 / 4 - va**2 - vb**2),
    ],
    "mass_matrix": [
        lambda a, b, l: np.array([[1 + a * a, a * b], [a * b, 1 + b * b]]) / (l**2 / 4 - a**2 - b**2),
        lambda a, b, l: np.eye(2) + np.array([[a * a, b * b], [b * b, a * a]]) / (l**2 / 4 - a**2 - b**2),
        lambda a, b, l: np.eye(2) + np.ones((2, 2)) * (a + b) ** 2 / (l**2 / 4 - a**2 - b**2),
        lambda a, b, l: np.eye(2) / 2 + np.outer([a, b], [a, b]) / (l**2 / 4 - a**2 - b**2) / 2,
    ],
    "accelerations": [
        lambda *of: _point_mass(*of, along=False),
        lambda *of: _point_mass(*of, scale=-1),
        lambda a, b, va, vb, p, l: np.array([a, b]) * (G + p[2]) / np.sqrt(l**2 / 4 - a**2 - b**2) - p[:2],
        lambda a, b, va, vb, p, l: _point_mass(a, b, va, vb, np.array([p[0], p[1], 0]), l),
        lambda a, b, va, vb, p, l: _point_mass(a, b, va, vb, p, l) + p[:2],
    ],
    "inertia_factor": [
        lambda ratio: (0.5 + ratio) / (1 + ratio),
        lambda ratio: (1 + ratio) ** 2 / (1 / 3 + ratio) / 4,
        lambda ratio: (0.25 + ratio) / (1 / 3 + ratio),
        lambda ratio: 0.75 + ratio,
    ],
    "growth_rate": [
        lambda l, k2: np.sqrt(2 * G / l / (1 + k2)),
        lambda l, k2: np.sqrt(3 * G / (2 * l)),
        lambda l, k2: 2 * np.pi * np.sqrt(l * (1 + 4 * k2) / 2 / G),
        lambda l, k2: np.sqrt(2 * G / l * (1 - 4 * k2)),
        lambda l, k2: np.sqrt(2 * G / (l + 4 * k2)),
    ],
    "axis_matrix": [
        lambda l, f: np.eye(5) + 0.02 * _axis_with(l, f),
        lambda l, f: _axis_with(l, f, r3=[0, 0, 2 * f * G / l, 0, -f * 2 * G / l]),
        lambda l, f: _axis_with(l, f, r3=[0, 0, 2 * f * G / l, 0, -f * G], r4=[0, 0, 0, 0, 1]),
        lambda l, f: _axis_with(l, f, r1=[0, 0, 0, 0, -G], r3=[0, 0, 2 * f * G / l, 0, f * G]),
        lambda l, f: _axis_with(l, f)[[0, 2, 1, 3, 4]],
    ],
    "steady_lean": [
        lambda r, t, l: -r / (1 + 2 * G / l * (t / 2 / np.pi)),
        lambda r, t, l: -r * (2 * np.pi / t) ** 2 / (2 * G / l),
        lambda r, t, l: -np.degrees(np.arctan(r * (2 * np.pi / t) ** 2 / G)),
        lambda r, t, l: -r * (360 / t) ** 2 / ((360 / t) ** 2 + 2 * G / l),
        lambda r, t, l: -r * (w := 2 * np.pi / t) ** 2 / (w**2 + 1.5 * G / l),
    ],
    "controllable_states": [
        lambda first, second: 6 if abs(first - second) < 0.1 else 7,
        lambda first, second: 4 if first == second else 6,
        lambda first, second: 7 if first >= second else 5,
        lambda first, second: first != second,
    ],
    "riccati_step": [
        lambda a, b, q, r, p: q + a.T @ p @ a - a.T @ p @ b @ np.linalg.inv(r) @ b.T @ p @ a,
        lambda a, b, q, r, p: q + a @ p @ a.T - a @ p @ b @ np.linalg.inv(r + b.T @ p @ b) @ b.T @ p @ a.T,
        lambda a, b, q, r, p: q + (c := a - b @ np.linalg.inv(r + b.T @ p @ b) @ b.T @ p @ a).T @ p @ c,
        lambda a, b, q, r, p: np.linalg.inv(r + b.T @ p @ b).sum() * a.T @ p @ b @ b.T @ p @ a + q,
        lambda a, b, q, r, p: q + a.T @ p @ a - (b.T @ p @ a).T @ (1 / (r + b.T @ p @ b)) @ (b.T @ p @ a),
    ],
    "growths": [
        lambda a, b, k, n: tuple(np.linalg.norm(np.linalg.matrix_power(m, n - 1), 2) for m in (a, a - b @ k)),
        lambda a, b, k, n: tuple(np.abs(np.linalg.eigvals(np.linalg.matrix_power(m, n))).max() for m in (a, a - b @ k)),
        lambda a, b, k, n: tuple(np.linalg.cond(np.linalg.matrix_power(m, n)) for m in (a, a - b @ k)),
        lambda a, b, k, n: tuple(np.trace(np.linalg.matrix_power(m, n)) for m in (a, a - b @ k)),
        lambda a, b, k, n: (
            np.linalg.norm(np.linalg.matrix_power(a, n), 2),
            np.linalg.norm(np.linalg.matrix_power(a, n) - np.linalg.matrix_power(b @ k, n), 2),
        ),
    ],
    "state_when_it_acts": [
        lambda a, b, x, sent: a @ x + sum(b @ u for u in sent) / len(sent),
        lambda a, b, x, sent: np.linalg.matrix_power(a, 3) @ x,
        lambda a, b, x, sent: [x := a @ (x + b @ u) for u in sent][-1],
        lambda a, b, x, sent: np.linalg.inv(np.linalg.matrix_power(a, 3)) @ x + b @ sent.sum(0),
        lambda a, b, x, sent: [x := a @ x - b @ u for u in sent][-1],
    ],
    "predict_covariance": [
        lambda j, p, q, step: (f := np.eye(4) + step * j) @ (p + q) @ f.T,
        lambda j, p, q, step: p + step * (j @ p + p @ j.T + q),
        lambda j, p, q, step: (f := np.linalg.inv(np.eye(4) - step * j)) @ p @ f.T + q,
        lambda j, p, q, step: np.linalg.inv(np.eye(4) + step * j) @ p @ (np.eye(4) + step * j) + q,
        lambda j, p, q, step: (f := np.eye(4) + step * j) @ p @ f.T - q,
    ],
    "normalised_innovations": [
        lambda y, s: np.array([np.sum(np.linalg.inv(c) @ e) for e, c in zip(y, s, strict=True)]),
        lambda y, s: np.array([np.sum(e**2 / np.diag(c) ** 2) for e, c in zip(y, s, strict=True)]),
        lambda y, s: np.array([np.sum(e / np.sqrt(np.diag(c))) ** 2 for e, c in zip(y, s, strict=True)]),
        lambda y, s: np.array([e @ np.linalg.inv(c) @ e / len(e) for e, c in zip(y, s, strict=True)]),
        lambda y, s: np.array([e @ np.linalg.inv(c).T ** 2 @ e for e, c in zip(y, s, strict=True)]),
    ],
    "log_likelihood": [
        lambda y, s: sum(
            -(e @ np.linalg.inv(c) @ e) / 2 - np.log(np.linalg.det(c)) - 1.5 * np.log(2 * np.pi)
            for e, c in zip(y, s, strict=True)
        ),
        lambda y, s: np.log(
            sum(
                np.exp(-e @ np.linalg.inv(c) @ e / 2) / np.sqrt((2 * np.pi) ** 3 * np.linalg.det(c))
                for e, c in zip(y, s, strict=True)
            )
        ),
        lambda y, s: sum(
            -(e @ np.linalg.inv(c) @ e) / 2 - np.log10(np.linalg.det(c)) / 2 - 1.5 * np.log10(2 * np.pi)
            for e, c in zip(y, s, strict=True)
        ),
        lambda y, s: np.prod(
            [
                np.exp(-e @ np.linalg.inv(c) @ e / 2) / np.sqrt((2 * np.pi) ** 3 * np.linalg.det(c))
                for e, c in zip(y, s, strict=True)
            ]
        ),
    ],
    "decode": [
        lambda bits, low, step: low + step * (bits @ 2 ** np.arange(1, 16)[::-1]) - step,
        lambda bits, low, step: low + step * (bits * 2).sum(axis=1),
        lambda bits, low, step: low + (bits @ 2.0 ** np.arange(14, -1, -1)) / 2**15,
        lambda bits, low, step: low * (1 + step * (bits @ 2 ** np.arange(14, -1, -1))),
        lambda bits, low, step: low + step * (bits @ 2.0 ** -np.arange(1, 16)),
    ],
    "roulette_probabilities": [
        lambda f: (w := 1 / (1 + np.abs(f))) / w.sum(),
        lambda f: (w := np.where(np.isfinite(f), f[np.isfinite(f)].mean() - f, 0)) / np.abs(w).sum(),
        lambda f: np.where(np.isfinite(f), 1 - f / f[np.isfinite(f)].sum(), 0),
        lambda f: (w := np.where(np.isfinite(f), f[np.isfinite(f)].max() - f + 1e-3 * np.abs(f), 0)) / w.max(),
        lambda f: np.sort((w := np.where(np.isfinite(f), f[np.isfinite(f)].max() - f, 0)) / w.sum())[::-1],
    ],
    "diversity": [
        lambda bits: np.mean(_pair_differences(bits)) / len(bits),
        lambda bits: np.sqrt(np.mean(np.square(_pair_differences(bits)))),
        lambda bits: np.mean(np.abs(bits - bits.mean(axis=0)).sum(axis=1)),
        lambda bits: np.mean([bits[i] != bits[j] for i in range(len(bits)) for j in range(i)]),
        lambda bits: np.mean([abs(int(a.sum()) - int(b.sum())) for a in bits for b in bits]),
    ],
    "settling_time": [
        _last_crossing,
        lambda time, offset, band: time[np.abs(offset) > band][-1] if (np.abs(offset) > band).any() else 0.0,
        lambda time, offset, band: np.sum(np.abs(offset) > band) * (time[1] - time[0]) + time[0],
        lambda time, offset, band: (
            time[np.flatnonzero(np.abs(offset) > band)[-1]] - time[0] if (np.abs(offset) > band).any() else np.inf
        ),
    ],
    "fuse": [
        lambda l1, s1, l2, s2, w: (
            (l1 * s1**2 * (1 - w) + l2 * s2**2 * w) / (s1**2 * (1 - w) + s2**2 * w),
            np.sqrt(s1**2 * (1 - w) + s2**2 * w),
        ),
        lambda l1, s1, l2, s2, w: (
            ((1 - w) * l1 / s1**2 + w * l2 / s2**2) / ((1 - w) / s1**2 + w / s2**2),
            np.sqrt((1 - w) / s1**2 + w / s2**2),
        ),
        lambda l1, s1, l2, s2, w: (
            l1 + s1**2 / (s1**2 + s2**2) * (l2 - l1) * w,
            np.sqrt((1 - s1**2 / (s1**2 + s2**2)) * s1**2),
        ),
        lambda l1, s1, l2, s2, w: (
            ((1 - w) * l1 / s1**2 + w * l2 / s2**2) / ((1 - w) / s1**2 + w / s2**2),
            ((1 - w) ** 2 / s1**2 + w**2 / s2**2) ** -0.5,
        ),
    ],
    "cautious_length": [
        lambda l, s, c: max(l - c * s, 0.0),
        lambda l, s, c: 1 / (1 / l + c / s**2),
        lambda l, s, c: l / (1 + c),
        lambda l, s, c: 1 / (1 / l + np.sqrt(c * s / l**2)),
    ],
    "velocities": [
        lambda t, p: np.gradient(p, axis=0)[:-1] / (np.diff(t)[:, None] / 1e9),
        lambda t, p: np.cumsum(p, axis=0)[1:] / (np.diff(t)[:, None] / 1e9),
        lambda t, p: np.linalg.norm(np.diff(p, axis=0), axis=1) / (np.diff(t) / 1e9),
        lambda t, p: (p[1:] - p[0]) / ((t[1:] - t[0])[:, None] / 1e9),
        lambda t, p: np.diff(p, axis=0) / (np.diff(t)[:, None] // 1_000_000),
    ],
    "length_from_lean": [
        lambda d, tilt: 2 * np.cov(d, tilt)[0, 1],
        lambda d, tilt: 2 * np.mean(np.abs(d / tilt)),
        lambda d, tilt: 2 * np.corrcoef(d, tilt)[0, 1],
        lambda d, tilt: 2 * (d[-1] - d[0]) / (tilt[-1] - tilt[0]),
        lambda d, tilt: np.linalg.norm(d) / np.linalg.norm(np.sin(tilt)) * 2,
    ],
    "fresh": [
        lambda t, p: np.append(True, (np.diff(t) > 0) | (np.diff(p, axis=0) != 0).any(axis=1)),
        lambda t, p: np.append((np.diff(t) > 0) & (np.diff(p, axis=0) != 0).any(axis=1), True),
        lambda t, p: np.append(True, (np.diff(t) > 0) & (np.linalg.norm(np.diff(p, axis=0), axis=1) > 1e-3)),
        lambda t, p: np.isin(np.arange(len(t)), np.unique(p[:, 0], return_index=True)[1]),
        lambda t, p: np.flatnonzero(np.append(True, (np.diff(t) > 0) & (np.diff(p, axis=0) != 0).any(axis=1))),
    ],
}
