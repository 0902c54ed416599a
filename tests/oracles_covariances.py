"""Relative orientation with a full cofactor matrix of every point, in plain NumPy with
dense matrices: the Gauss-Helmert model of textbooks (Mikhail 1976), and Baarda's
reliability of correlated observations (R = Q_vv Q⁻¹, any Q)."""

from typing import NamedTuple

import numpy as np
import oracles
from scipy.linalg import block_diag


def observations(covariances):
    """Q of all coordinates, those of a point one behind the other: (4n, 4n), from two
    arrays (n, 2, 2)."""
    return block_diag(*(m for both in zip(*covariances, strict=True) for m in both))


def by_observations(coordinates, focal, placed, elements):
    """B (n, 4n) at these coordinates (4, n)."""
    n = coordinates.shape[1]
    of = lambda l: oracles.condition(placed, elements, l.reshape(n, 4).T, focal)
    return oracles.jacobian(of, coordinates.T.ravel())


class Adjusted(NamedTuple):
    """Elements, their cofactors, sigma0, and v (4, n)."""

    elements: np.ndarray
    cofactor: np.ndarray
    sigma0: float
    corrections: np.ndarray


def gauss_helmert(coordinates, focal, placed, start, covariances):
    """Minimise vᵀ Q⁻¹ v subject to condition(elements, l + v) = 0 exactly, linearised at
    the adjusted measurements in every step."""
    measured = np.asarray(coordinates, float)
    n, q = measured.shape[1], observations(covariances)
    elements, v = np.array(start, float), np.zeros(4 * n)
    for _ in range(100):
        adjusted = measured + v.reshape(n, 4).T
        of = lambda e, at=adjusted: oracles.condition(placed, e, at, focal)
        a = oracles.jacobian(of, elements)
        b = by_observations(adjusted, focal, placed, elements)
        left = oracles.condition(placed, elements, adjusted, focal) - b @ v
        p = np.linalg.inv(b @ q @ b.T)
        normal = a.T @ p @ a
        step = -np.linalg.solve(normal, a.T @ p @ left)
        v = -q @ b.T @ p @ (a @ step + left)
        elements = elements + step
        if np.max(np.abs(step)) < 1e-14 * (1 + np.max(np.abs(elements))):
            break
    sigma0 = np.sqrt(v @ np.linalg.solve(q, v) / (n - 5))
    return Adjusted(elements, np.linalg.inv(normal), sigma0, v.reshape(n, 4).T)


class Dense(NamedTuple):
    """At given elements, per point or per observation (4n): the redundancy matrix R,
    Baarda's w of sigma0 = 1 for P v, and the least error of each observation that
    moves w by one."""

    redundancy: np.ndarray
    w: np.ndarray
    least: np.ndarray
    shift: np.ndarray
    corrections: np.ndarray


def dense(coordinates, focal, placed, elements, covariances) -> Dense:
    """Reliability of all observations of an adjustment that ended here."""
    coordinates = np.asarray(coordinates, float)
    n, q = coordinates.shape[1], observations(covariances)
    of = lambda e: oracles.condition(placed, e, coordinates, focal)
    a = oracles.jacobian(of, elements)
    b = by_observations(coordinates, focal, placed, elements)
    g, p = of(elements), np.linalg.inv(b @ q @ b.T)
    cofactor = np.linalg.inv(a.T @ p @ a)
    left = np.eye(n) - a @ cofactor @ a.T @ p
    v = -q @ b.T @ p @ left @ g
    qvv = q @ b.T @ p @ left @ b @ q
    weight = np.linalg.inv(q)
    # Baarda 1968 of correlated observations: w = eᵀPv / sqrt(eᵀ P Q_vv P e)
    spread = np.sqrt(np.diag(weight @ qvv @ weight))
    return Dense(
        redundancy=qvv @ weight,
        w=(weight @ v) / spread,
        least=1 / spread,
        shift=-cofactor @ a.T @ p @ b,
        corrections=(-q @ b.T @ (g * np.diag(p))).reshape(n, 4).T,
    )
