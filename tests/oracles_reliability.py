"""Reliability from dense matrices in plain NumPy: all 4n observations, the n by 4n
matrix B, the full hat matrix.

Gauss-Helmert model A dx + B v + g = 0 with cofactors Q (Mikhail 1976; Caspary 1988,
Förstner 1987):

    Q_vv = Q Bᵀ D⁻¹ (D - A N⁻¹ Aᵀ) D⁻¹ B Q,    D = B Q Bᵀ,    N = Aᵀ D⁻¹ A,    R = Q_vv Q⁻¹
"""

from typing import NamedTuple

import numpy as np
import oracles
from scipy import stats


class Dense(NamedTuple):
    """Observations in the order of the points, four coordinates each; sigma0 is the
    estimated one."""

    r: np.ndarray
    """(4n, 4n): v = -R (errors)"""
    w: np.ndarray
    """(4n,) v / (sqrt(q_vv)), of sigma0 = 1"""
    shift: np.ndarray
    """(5, 4n): d elements / d observations"""
    cofactor: np.ndarray
    sigma0: float


def dense(coordinates, focal, placed, elements, sigma) -> Dense:
    """At given elements. coordinates: (4, n); sigma: (n,)."""
    coordinates = np.asarray(coordinates, float)
    n = coordinates.shape[1]
    focal = (focal, focal) if np.ndim(focal) == 0 else focal
    a = oracles.jacobian(
        lambda e: oracles.condition(placed, e, coordinates, focal), elements
    )
    flat = coordinates.T.ravel()
    b = oracles.jacobian(
        lambda l: oracles.condition(placed, elements, l.reshape(n, 4).T, focal), flat
    )
    g = oracles.condition(placed, elements, coordinates, focal)
    q = np.diag(np.repeat(np.broadcast_to(sigma, n) ** 2, 4))
    p = np.linalg.inv(b @ q @ b.T)
    cofactor = np.linalg.inv(a.T @ p @ a)
    hat = np.eye(n) - a @ cofactor @ a.T @ p
    v = -q @ b.T @ p @ hat @ g
    qvv = q @ b.T @ p @ hat @ b @ q
    diagonal = np.diag(qvv)
    w = np.where(
        diagonal > 1e-9 * np.diag(q), v / np.sqrt(np.maximum(diagonal, 1e-300)), 0.0
    )
    sigma0 = np.sqrt(v @ (v / np.diag(q)) / (n - 5)) if n > 5 else np.nan
    return Dense(qvv / np.diag(q), w, -cofactor @ a.T @ p @ b, cofactor, sigma0)


def externally_studentised(coordinates, focal, placed, elements, sigma, point) -> float:
    """|t| of one point: the adjustment with its condition given up, by an unknown of its
    own (mean-shift model)."""
    n = coordinates.shape[1]
    focal = (focal, focal) if np.ndim(focal) == 0 else focal
    a = oracles.jacobian(
        lambda e: oracles.condition(placed, e, coordinates, focal), elements
    )
    g = oracles.condition(placed, elements, coordinates, focal)
    b = oracles.jacobian(
        lambda l: oracles.condition(placed, elements, l.reshape(n, 4).T, focal),
        coordinates.T.ravel(),
    )
    d = np.sum(b**2, axis=1) * np.broadcast_to(sigma, n) ** 2
    a = np.column_stack([a, np.eye(n)[point]]) / np.sqrt(d)[:, None]
    g = g / np.sqrt(d)
    cofactor = np.linalg.inv(a.T @ a)
    x = -cofactor @ a.T @ g
    rest = a @ x + g
    return abs(x[5]) / np.sqrt(rest @ rest / (n - 6) * cofactor[5, 5])


def delta0(level, power):
    """Baarda's square root of lambda, by root finding on the non-central chi-squared
    distribution."""
    from scipy.optimize import brentq

    limit = stats.chi2.isf(level, 1)
    return brentq(
        lambda d: stats.ncx2.sf(limit, 1, d * d) - power, 1e-6, 60, xtol=1e-13
    )
