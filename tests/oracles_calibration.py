"""Independent calibration in plain NumPy: the model as the papers write it, numerical
derivatives, Gauss-Newton from the truth."""

import numpy as np


def rotation(omega, phi, kappa):
    """Object to photo axes: R3(kappa) R2(phi) R1(omega)."""
    c, s = np.cos, np.sin
    r1 = np.array([[1, 0, 0], [0, c(omega), s(omega)], [0, -s(omega), c(omega)]])
    r2 = np.array([[c(phi), 0, -s(phi)], [0, 1, 0], [s(phi), 0, c(phi)]])
    r3 = np.array([[c(kappa), s(kappa), 0], [-s(kappa), c(kappa), 0], [0, 0, 1]])
    return r3 @ r2 @ r1


def rays(unknowns, points):
    """x/z, y/z of object points in a camera with x to the right, y down, from omega,
    phi, kappa and the station."""
    turn = np.diag([1.0, -1.0, -1.0]) @ rotation(*unknowns[:3])
    seen = (points - unknowns[3:6]) @ turn.T
    return seen[:, :2] / seen[:, 2:]


def gauss_newton(residuals, x, steps=8):
    """The minimum of the squares of residuals(x), and the inverse of JᵀJ there."""
    for _ in range(steps):
        x = x - np.linalg.lstsq(jacobian(residuals, x), residuals(x), rcond=None)[0]
    j = jacobian(residuals, x)
    return x, np.linalg.inv(j.T @ j)


def jacobian(function, x):
    """Central differences."""
    columns = []
    for k in range(len(x)):
        step = np.zeros(len(x))
        step[k] = 1e-6 * max(1.0, abs(x[k]))
        columns.append((function(x + step) - function(x - step)) / (2 * step[k]))
    return np.stack(columns, axis=1)


def scene(rng, n, focal=60.0, half=30.0, distance=10.0, depth=0.35):
    """Angles, station, object points, and places about the principal place, y down:
    points that fill a square image."""
    angles = np.append(rng.normal(0, 0.2, 2), rng.uniform(-np.pi, np.pi))
    turn = np.diag([1.0, -1.0, -1.0]) @ rotation(*angles)
    station = -turn.T @ np.array([0, 0, distance])
    places = rng.uniform(-half, half, (n, 2))
    z = distance * (1 + depth * rng.uniform(-1, 1, n))
    seen = np.column_stack([places / focal * z[:, None], z])
    return angles, station, seen @ turn + station, places
