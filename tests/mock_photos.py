"""Photos of given points, for tests of what cannot be oriented."""

import numpy as np
from oracles import wolf

import jaxro
from jaxro import RESULTS

FOCAL = 150.0


def measured(points, turn=(0.0, 0.0, 0.0), base=(1.0, 0.0, 0.0), sigma=0.0, seed=0):
    """(4, n) coordinates of points (n, 3) given in bases, left photo at the origin
    looking along -z, right one turned (Wolf)."""
    points = np.asarray(points, float)
    right = (points - np.asarray(base)) @ wolf(*turn).T
    exact = [-FOCAL * p[:, k] / p[:, 2] for p in (points, right) for k in (0, 1)]
    return (
        np.stack(exact)
        + np.random.default_rng(seed).normal(size=(4, len(points))) * sigma
    )


def photographed(points, **options):
    """The pair of these photos; options as of `measured`."""
    return jaxro.pair(*measured(points, **options), focal=FOCAL)


def block(n=12, seed=1, depth=(1.5, 2.2)):
    rng = np.random.default_rng(seed)
    return np.column_stack(
        [rng.uniform(-0.2, 1.2, n), rng.uniform(-1, 1, n), -rng.uniform(*depth, n)]
    )


PLACES = 20
"""Pairs of up to so many points share one compiled program."""


def outcome(pair, **options):
    """The orientation of a pair in PLACES places."""
    return jaxro.orient(jaxro.pad(pair, max(PLACES, len(pair.x_left))), **options)


def name(orientation):
    return next(
        key
        for key, member in RESULTS._name_to_item.items()
        if bool(orientation.result == member)
    )


def in_any_position(points, count, seed, sigma):
    """`count` pairs of such points (rng -> (n, 3), in bases): photos in any position,
    the mean point ahead of both."""
    rng, pairs, truth = np.random.default_rng(seed), [], []
    while len(pairs) < count:
        ground, base = points(rng), rng.normal(size=3)
        base /= np.linalg.norm(base)
        turn = rng.uniform(-1, 1, 2) * 0.5, rng.uniform(-np.pi, np.pi)
        right = (ground - base) @ wolf(*turn[0], turn[1]).T
        if np.all(right[:, 2] < -0.5):
            both = [-FOCAL * p[:, k] / p[:, 2] for p in (ground, right) for k in (0, 1)]
            pairs.append(np.array(both) + rng.normal(size=(4, len(ground))) * sigma)
            truth.append(base)
    return np.stack(pairs, axis=1), np.stack(truth)


def on_a_critical_surface(count, points, seed, sigma):
    """`count` pairs in any position of which every point fits two orientations (R, b),
    (S, c), in front of all photos.

    The right photo of a ray p lies where its two epipolar lines meet, (p.[b]R) x
    (p.[c]S). Coordinates and b.
    """
    rng, pairs, truth = np.random.default_rng(seed), [], []
    span = FOCAL * 0.75
    while len(pairs) < count:
        angles, base = (
            rng.uniform(-1, 1, 3) * (0.5, 0.5, np.pi),
            rng.normal(size=(2, 3)) * [[1.0], [0.5]],
        )
        first, second = (
            wolf(*a).T for a in (angles, angles + rng.normal(size=3) * 0.3)
        )
        both = [
            (r, b / np.linalg.norm(b))
            for r, b in ((first, base[0]), (second, base[0] + base[1]))
        ]
        p = np.column_stack([rng.uniform(-span, span, (200, 2)), np.full(200, -FOCAL)])
        q = np.cross(*(np.cross(p, b) @ r for r, b in both))
        q *= -FOCAL / q[:, 2:]
        seen = np.max(np.abs(q[:, :2]), axis=1) < span
        for r, b in both:
            a, c = q @ r.T, np.cross(p, q @ r.T)
            seen &= (np.sum(np.cross(b, a) * c, axis=1) > 0) & (
                np.sum(np.cross(b, p) * c, axis=1) > 0
            )
        if np.sum(seen) >= points:
            measured = np.concatenate([p[seen][:points, :2].T, q[seen][:points, :2].T])
            pairs.append(measured + rng.normal(size=measured.shape) * sigma)
            truth.append(both[0][1])
    return np.stack(pairs, axis=1), np.stack(truth)
