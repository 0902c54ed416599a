"""The modern procedures in plain NumPy: dense matrices, one pair at a time, dependent
elements of unit base.

Points are columns of (4, point) coordinates; `share` is the part of its weight that a
point has in the solution.
"""

from itertools import combinations

import numpy as np
import oracles
import scipy.stats

PLACED = oracles.dependent(1.0)


def linearised(points, focal, sigma, elements):
    """The whitened condition r = g / (sigma |dg/dl|) and its columns, the denominator
    held."""
    g = lambda e: oracles.condition(PLACED, e, points, (focal, focal))
    left, right, base = PLACED(elements)
    ray1 = oracles.vectors(*points[:2], focal) @ left.T
    ray2 = oracles.vectors(*points[2:], focal) @ right.T
    # the condition (b, ray1, ray2) is linear in each of them
    slopes = [
        (np.cross(ray2, base) @ left)[:, :2],
        (np.cross(base, ray1) @ right)[:, :2],
    ]
    spread = sigma * np.sqrt(np.sum(np.square(slopes), axis=(0, 2)))
    return g(elements) / spread, oracles.jacobian(g, elements) / spread[:, None]


def solved(points, focal, sigma, share, elements, iterations=30):
    """Gauss-Newton with these shares of the weights."""
    for _ in range(iterations):
        r, a = linearised(points, focal, sigma, elements)
        step = np.linalg.solve((a.T * share) @ a, a.T @ (share * r))
        elements = elements - step
        if np.max(np.abs(step)) < 1e-12:
            break
    return elements


def standardised(points, focal, sigma, share, elements):
    """|r| over its standard deviation sqrt(1 + (1 - 2p) h), h = a N⁻¹ a'."""
    r, a = linearised(points, focal, sigma, elements)
    h = np.sum((a @ np.linalg.inv((a.T * share) @ a)) * a, axis=1)
    return np.abs(r) / np.sqrt(np.maximum(1 + (1 - 2 * share) * h, 1e-12)), h


def reweighted(points, focal, sigma, weight, limit, rounds=200, convex=5, full=15):
    """The points with |w| <= limit at the fixed point of w -> weight(w) next to that of
    Huber's weights, and whether it rests; after `full` rounds the mean of new and last
    weights. A solution that runs away does not rest."""
    share = np.ones(points.shape[1])
    elements = solved(points, focal, sigma, share, np.zeros(5))
    try:
        for k in range(rounds):
            w = standardised(points, focal, sigma, share, elements)[0]
            new = (
                np.minimum(1, 1.345 / np.maximum(w, 1e-9)) if k < convex else weight(w)
            )
            share = new if k < convex + full else (share + new) / 2
            before, elements = (
                elements,
                solved(points, focal, sigma, share, elements, 1),
            )
            if np.max(np.abs(elements)) > 1:
                break
            if k >= convex and np.max(np.abs(elements - before)) < 1e-9:
                return standardised(points, focal, sigma, share, elements)[
                    0
                ] <= limit, True
    except np.linalg.LinAlgError:
        pass
    return np.zeros(points.shape[1], bool), False


def snooping(points, focal, sigma, level, estimated=False, least=6, doubt=0.01):
    """The points in the order in which the largest |w| (or tau, with sigma0) goes while
    it exceeds its quantile, and the points of which one is wrong at the end: without
    those the largest |w| is below that of `doubt`."""
    used, gone = list(range(points.shape[1])), []
    while len(used) >= least:
        w = of_used(points, focal, sigma, used, estimated)
        best = used[int(np.argmax(w))]
        if np.max(w) <= quantile(level, len(used), estimated):
            break
        rest = [[k for k in used if k != j] for j in used]
        named = [best] if len(used) > 6 else used
        for j, others in zip(used, rest, strict=True):
            if j != best and len(used) > 6:
                without = of_used(points, focal, sigma, others, estimated)[
                    others.index(best)
                ]
                if without <= quantile(doubt, len(others), estimated):
                    named = [*named, j]
        if len(named) > 1:
            return gone, sorted(named)
        if len(used) == least:
            break
        gone.append(best)
        used.remove(best)
    return gone, []


def of_used(points, focal, sigma, used, estimated):
    """|w|, or |tau|, of these points in their own adjustment."""
    here, every = points[:, used], np.ones(len(used))
    elements = solved(here, focal, sigma, every, np.zeros(5))
    w, h = standardised(here, focal, sigma, every, elements)
    if estimated:
        w = w / np.sqrt(
            np.sum(linearised(here, focal, sigma, elements)[0] ** 2) / (len(used) - 5)
        )
    w[1 - h < 1e-6] = 0
    return w


def quantile(level, count, estimated):
    """Two-sided, of w or of tau."""
    f = count - 5
    if not estimated:
        return scipy.stats.norm.isf(level / 2)
    t = scipy.stats.t.isf(level / 2, max(f - 1, 1))
    return np.sqrt(f) * t / np.sqrt(f - 1 + t * t) if f > 1 else np.inf


def fewest_omissions(points, focal, sigma, most, level):
    """The omissions, fewest first, whose Σ r² passes the chi-squared test and is the
    least of its number; every one solved."""
    n = points.shape[1]
    for k in range(most + 1):
        left = {}
        for omitted in combinations(range(n), k):
            here = np.delete(points, omitted, axis=1)
            elements = solved(here, focal, sigma, np.ones(n - k), np.zeros(5))
            left[omitted] = np.sum(linearised(here, focal, sigma, elements)[0] ** 2)
        best = min(left, key=left.__getitem__)
        if left[best] <= scipy.stats.chi2.isf(level, n - k - 5):
            return best
    return None
