"""The rejection procedures of 1971 and 1989 in plain NumPy, written from the papers:
slow, and one pair at a time.

Points are columns of (4, point) coordinates x_left, y_left, x_right, y_right, all of
them measured; lengths in mm. A procedure keeps lists of the points still in use, where
the package has masks, and says at every step whom it rejects.
"""

from typing import NamedTuple

import numpy as np
import oracles
import scipy.stats

ZERO = np.zeros(5)


class Verdict(NamedTuple):
    """Points kept; the round that rejected a point, from 1 (0: kept); whether an
    operator has to look at the pair."""

    kept: np.ndarray
    order: np.ndarray
    operator_needed: bool = False


def verdict(count, rounds, operator_needed=False):
    """From the lists of points rejected round by round."""
    order = np.zeros(count, int)
    for number, points in enumerate((points for points in rounds if len(points)), 1):
        order[points] = number
    return Verdict(order == 0, order, operator_needed)


def linearised(points, focal, elements):
    """q = -f (Y1/Z1 - Y2/Z2) of every point and its derivatives (point, 5) by the
    independent elements."""
    q = lambda e: oracles.y_parallax(e, points, focal)
    return q(elements), oracles.jacobian(q, elements)


def iterated(points, focal, elements, least_change=1e-9, iterations=50):
    """Gauss-Newton on Σ q² from `elements` until no element changes by
    `least_change`."""
    for _ in range(iterations):
        q, a = linearised(points, focal, elements)
        step = np.linalg.lstsq(a, q, rcond=None)[0]
        elements = elements - step
        if np.max(np.abs(step)) < least_change:
            break
    return elements


def residuals(points, focal):
    """|q| after convergence from zero elements."""
    return np.abs(oracles.y_parallax(iterated(points, focal, ZERO), points, focal))


def largest_first(wrong, q, least):
    """The points that are wrong, largest |q| first, so many that `least` stay."""
    return [i for i in np.argsort(-q) if wrong[i]][: max(len(q) - least, 0)]


def mean_parallax(points, focal, eps=0.01):
    """1971, first algorithm: n > 9, once, those with |q| - mean |q| >= eps, six at
    least stay; eqs (1), (3)."""
    n = points.shape[1]
    if n <= 9:
        return verdict(n, [])
    q = residuals(points, focal)
    return verdict(n, [largest_first(q - np.mean(q) >= eps, q, 6)])


def three_sigma(points, focal):
    """1971, second algorithm: n > 9, once, those with |q| >= 3 m_q, six at least stay;
    eqs (2), (4)."""
    n = points.shape[1]
    if n <= 9:
        return verdict(n, [])
    q = residuals(points, focal)
    return verdict(n, [largest_first(q >= 3 * oracles.m_q(q), q, 6)])


def worst_point(points, focal, eps=0.01):
    """1971, third algorithm: n > 9; while (3) fails anywhere the largest |q| goes,
    until six points are left."""
    n = points.shape[1]
    used, rounds = list(range(n)), []
    while n > 9 and len(used) > 6:
        q = residuals(points[:, used], focal)
        if np.all(q - np.mean(q) < eps):
            break
        rounds.append([used.pop(int(np.argmax(q)))])
    return verdict(n, rounds)


def dorozhinsky(points, focal, eps1=7.0, eps2=1e-4, eps3=0.1, eps4=0.01, corrections=1):
    """1971, the algorithm proposed, steps 1 to 5 with eqs (11) to (13).

    Its two iterations are one correction of the elements: the first iteration is at
    zero elements.
    """
    n = points.shape[1]
    q = np.abs(oracles.y_parallax(ZERO, points, focal))
    rounds = [np.flatnonzero(q > eps1)]
    used = list(np.flatnonzero(q <= eps1))
    while True:
        here = points[:, used]
        elements = iterated(here, focal, ZERO, iterations=corrections)
        q = np.abs(oracles.y_parallax(elements, here, focal))
        if np.mean(q) <= eps3:
            break
        if len(used) <= 6:
            return verdict(n, rounds, operator_needed=True)
        rounds.append([used.pop(int(np.argmax(q)))])
    q = np.abs(oracles.y_parallax(iterated(here, focal, elements, eps2), here, focal))
    rounds.append([used[i] for i in largest_first(q - np.mean(q) >= eps4, q, 6)])
    return verdict(n, rounds)


def omission_means(points, focal, exact=True, untestable=1e-6):
    """1989, means (6) of the rows of matrix (5), and which points can be left out at
    all.

    Every row is solved anew from the solution of all points: to convergence, or (not
    `exact`) by one linear step whose residuals are taken as linear, too. Where a point
    has no redundancy the others do not determine five elements.
    """
    n = points.shape[1]
    full = iterated(points, focal, ZERO)
    q, a = linearised(points, focal, full)
    testable = np.sum(np.linalg.qr(a)[0] ** 2, axis=1) < 1 - untestable
    means = np.zeros(n)
    for omitted in np.flatnonzero(testable):
        others = np.arange(n) != omitted
        if exact:
            refit = iterated(points[:, others], focal, full)
            row = oracles.y_parallax(refit, points[:, others], focal)
        else:
            row = (
                q[others]
                - a[others] @ np.linalg.lstsq(a[others], q[others], rcond=None)[0]
            )
        means[omitted] = np.sum(np.abs(row)) / n  # the omitted entry is 0
    return means, testable


def grubbs_v(means):
    """1989, eqs (7) to (9): (mean - value) / S, S over n; only the smallest value is
    tested, where it is largest."""
    spread = np.sqrt(np.mean((np.mean(means) - means) ** 2))
    return (np.mean(means) - means) / spread


def grubbs_critical(level, n):
    """Of the largest V in a normal sample of n."""
    t = scipy.stats.t.isf(level / n, n - 2)
    g = (n - 1) / np.sqrt(n) * np.sqrt(t**2 / (n - 2 + t**2))
    return g * np.sqrt(n / (n - 1))


def leave_one_out(points, focal, level=0.05, exact=True, untestable=1e-6):
    """1989: the point whose omission has the smallest mean goes if its V exceeds the
    critical value; repeated."""
    n = points.shape[1]
    used, rounds = list(range(n)), []
    while len(used) > 6:
        means, testable = omission_means(points[:, used], focal, exact, untestable)
        candidates = np.flatnonzero(testable)
        if len(candidates) < 3:
            break
        v = grubbs_v(means[candidates])
        if np.max(v) <= grubbs_critical(level, len(candidates)):
            break
        rounds.append([used.pop(candidates[np.argmax(v)])])
    return verdict(n, rounds)


def two_stage(points, focal, untestable=1e-6):
    """1989, table 2: residual parallaxes (the algorithm of 1971) first, Grubbs on the
    points that are left."""
    first = dorozhinsky(points, focal)
    second = leave_one_out(points[:, first.kept], focal, untestable=untestable)
    order = first.order.copy()
    order[first.kept] = np.where(
        second.order > 0, second.order + np.max(first.order), 0
    )
    return Verdict(order == 0, order, first.operator_needed)
