"""Approximate coordinates: points of errorless measurements are found where they are."""

import numpy as np

from jaxro.surveys.approximate import complete
from jaxro.surveys.geodetic import Measured

AT = np.array(
    [
        *([0.0, 0, 5], [100, 10, 6], [60, 80, 7], [150, 90, 4], [-30, 70, 9]),
        *([40, -50, 3], [90, -80, 2], [200, 40, 8]),
    ]
)
"""Two known points, then those that are found."""

TURN = 0.8
ABOVE = np.array([[1.6, 1.2]])


def t(a, b):
    return np.arctan2(*(AT[b] - AT[a])[1::-1])


def plan(a, b):
    return np.hypot(*(AT[b] - AT[a])[:2])


def one(kind, ends, values, **others):
    values = np.atleast_2d(np.asarray(values, float).T).reshape(len(ends), -1)
    m = values.shape[1]
    roots = np.broadcast_to(np.eye(m), (len(ends), m, m))
    return Measured(kind, np.array(ends), values, roots, **others)


def test_polar_points_cuts_heights_and_vectors():
    sights = [(0, 1), (0, 2), (2, 0), (2, 3), (0, 4), (1, 4)]
    sets = [0, 0, 1, 1, 0, 2]
    turns = [TURN, TURN, -2.0, -2.0, TURN, 0.3]
    rise = AT[2] - AT[0] + [0, 0, ABOVE[0, 1] - ABOVE[0, 0]]
    measured = [
        one(
            "direction",
            [*sights, (1, 0)],
            [
                *(t(*ends) - o for ends, o in zip(sights, turns, strict=True)),
                t(1, 0) - 0.3,
            ],
            set=np.array([*sets, 2]),
        ),
        one("slope", [(2, 0)], [np.linalg.norm(rise)]),
        one(
            "zenith",
            [(0, 2)],
            [np.arctan2(np.hypot(*rise[:2]), rise[2])],
            above=ABOVE,
        ),
        one("distance", [(2, 3), (0, 5), (3, 6)], [plan(2, 3), plan(0, 5), plan(3, 6)]),
        one("angle", [(0, 5, 1)], [t(0, 1) - t(0, 5)]),
        one("azimuth", [(3, 6)], [t(3, 6)]),
        one("height", [(3, 2), (4, 3), (3, 5), (6, 5)], [3.0, -5.0, -1.0, 1.0]),
        one("vector", [(7, 3)], (AT[3] - AT[7])[None]),
    ]
    start = np.full(AT.shape, np.nan)
    start[:2] = AT[:2]
    np.testing.assert_allclose(complete(start, measured), AT, atol=1e-9)


def test_what_nothing_tells_stays_unknown():
    start = np.full(AT.shape, np.nan)
    start[:2] = AT[:2]
    flat = [(0, 2), (1, 2)]
    measured = [one("azimuth", flat, [t(0, 2), t(0, 2) + 0.01])]
    assert np.all(np.isnan(complete(start, measured)[2:]))
