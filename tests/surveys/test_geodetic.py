"""Geodetic networks of all kinds of measurements, against plain NumPy with derivatives by
differences; published nets."""

import jax
import numpy as np
import pytest

from jaxro.statistics.groups import assess_groups
from jaxro.statistics.rows import normalise_rows, rows
from jaxro.surveys.geodetic import Measured, Network, adjust_network, displacements

POINTS = np.array([[0.0, 0, 10], [80, 15, 12], [30, 70, 9], [95, 90, 14], [40, 30, 11]])
SIGMA = 0.01
INSTRUMENT, TARGET = 1.5, 1.7
ANGLES = ("direction", "angle", "azimuth", "zenith")


def azimuth(p, a, b):
    return np.arctan2(p[b, 1] - p[a, 1], p[b, 0] - p[a, 0])


FUNCTIONS = {
    "height": lambda p, at, o: [p[at[1], 2] - p[at[0], 2]],
    "slope": lambda p, at, o: [np.linalg.norm(p[at[1]] - p[at[0]])],
    "distance": lambda p, at, o: [np.linalg.norm((p[at[1]] - p[at[0]])[:2])],
    "direction": lambda p, at, o: [azimuth(p, *at) - o],
    "angle": lambda p, at, o: [azimuth(p, at[0], at[2]) - azimuth(p, at[0], at[1])],
    "azimuth": lambda p, at, o: [azimuth(p, *at)],
    "zenith": lambda p, at, o: [
        np.arctan2(
            np.linalg.norm((p[at[1]] - p[at[0]])[:2]),
            p[at[1], 2] + TARGET - p[at[0], 2] - INSTRUMENT,
        )
    ],
    "vector": lambda p, at, o: p[at[1]] - p[at[0]],
    "Z": lambda p, at, o: [p[at[0], 2]],
}
PAIRS = [(a, b) for a in range(5) for b in range(5) if a != b]
AT = {
    "height": [(0, 1), (1, 2), (2, 0), (3, 4), (4, 0)],
    "slope": [(0, 3), (1, 4), (2, 3)],
    "distance": [(0, 1), (0, 2), (1, 3), (2, 4), (3, 4)],
    "direction": [pair for pair in PAIRS if pair[0] in (0, 3)],
    "angle": [(4, 0, 1), (4, 1, 3), (1, 0, 2)],
    "azimuth": [(4, 2)],
    "zenith": [(4, 0), (1, 4)],
    "vector": [(0, 4), (2, 3)],
    "Z": [(2,)],
}
TURNS = np.array([0.7, -2.0])
"""Orientations of the sets of directions at the points 0 and 3."""


def measure(seed: int = 4) -> tuple[Measured, ...]:
    """Everything with normal errors; directions and angles some turns away."""
    rng = np.random.default_rng(seed)
    found = []
    for kind, at in AT.items():
        sets = None
        turn = np.zeros(len(at))
        if kind == "direction":
            sets = np.array([0 if a == 0 else 1 for a, _ in at])
            turn = TURNS[sets]
        exact = [FUNCTIONS[kind](POINTS, a, o) for a, o in zip(at, turn, strict=True)]
        values = np.array(exact)
        root = SIGMA * np.eye(values.shape[1])
        if kind in ANGLES:
            root = root / 100
            values = values + 2 * np.pi
        if kind == "vector":
            root = root + np.tril(np.full((3, 3), 0.4 * SIGMA), -1)
        values = (
            values + (root @ rng.normal(size=(len(at), values.shape[1], 1)))[..., 0]
        )
        roots = np.broadcast_to(root, (len(at), *root.shape))
        above = None
        if kind == "zenith":
            above = np.tile([INSTRUMENT, TARGET], (len(at), 1))
        found.append(Measured(kind, np.array(at), values, roots, sets, above))
    return tuple(found)


def whitened(x, measured):
    """Residuals of everything in standard deviations, from all coordinates and the two
    orientations."""
    p, turns = x[:15].reshape(5, 3), x[15:]
    out = []
    for part in measured:
        for k, at in enumerate(part.at):
            turn = 0.0 if part.set is None else turns[part.set[k]]
            off = np.array(FUNCTIONS[part.kind](p, at, turn)) - part.values[k]
            if part.kind in ANGLES:
                off = (off + np.pi) % (2 * np.pi) - np.pi
            out.append(np.linalg.solve(part.roots[k], off))
    return np.concatenate(out)


def slopes(x, measured):
    step = 1e-5
    columns = [
        (whitened(x + step * e, measured) - whitened(x - step * e, measured))
        / (2 * step)
        for e in np.eye(len(x))
    ]
    return np.stack(columns, axis=1)


@pytest.fixture(scope="module")
def measured():
    return measure()


@pytest.fixture(scope="module", params=["known", "free"])
def solved(request, measured):
    """With the first point held and the Y of the second, or nothing known but one
    height."""
    held = np.zeros((5, 3), bool)
    if request.param == "known":
        held[0], held[1, 1] = True, True
    rng = np.random.default_rng(1)
    rough = POINTS + np.where(held, 0, rng.uniform(-2, 2, POINTS.shape))
    return held, rough, adjust_network(Network(rough, held, measured))


def test_a_network_of_all_kinds_is_that_of_numpy(solved, measured):
    held, _, found = solved
    assert int(found.datum) == (0 if held.any() else 2)
    x = np.concatenate(
        [
            found.coordinates.ravel(),
            np.asarray(found.adjusted.parameters["orientation"])[:, 0],
        ]
    )
    design, r = slopes(x, measured), whitened(x, measured)
    free = ~np.concatenate([held.ravel(), [False, False]])
    np.testing.assert_allclose(design[:, free].T @ r, 0, atol=1e-3)
    np.testing.assert_array_equal(found.coordinates[held], POINTS[held])
    freedom = len(r) - np.linalg.matrix_rank(design[:, free], tol=1e-4)
    assert found.adjusted.degrees_of_freedom == freedom
    np.testing.assert_allclose(found.adjusted.sigma0, np.sqrt(r @ r / freedom), 1e-9)
    n = design[:, free].T @ design[:, free]
    own = np.zeros((17, 17))
    if held.any():
        own[np.ix_(free, free)] = np.linalg.inv(n)
    else:
        # vectors tell the directions of the axes: the shift in plan is open
        open_ways = np.zeros((17, 2))
        open_ways[0:15:3, 0] = open_ways[1:15:3, 1] = 1
        border = np.block([[n, open_ways], [open_ways.T, np.zeros((2, 2))]])
        own = np.linalg.inv(border)[:17, :17]
    blocks = np.stack([own[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] for k in range(5)])
    np.testing.assert_allclose(
        found.adjusted.cofactors("point"), blocks, atol=2e-5 * np.max(blocks)
    )


def test_displacements_are_those_of_the_datum(solved):
    """Their covariances by a pseudo-inverse are the cofactors of the adjustment."""
    _, _, found = solved
    free, functions = displacements(found)
    design = rows(found.terms, found.adjusted.parameters, held=found.held).design
    length = np.linalg.norm(design, axis=0)
    length[length == 0] = 1
    inverse = functions / length @ np.linalg.pinv(design / length, rcond=1e-9)
    cofactors = np.asarray(found.adjusted.cofactors("point"))
    variances = np.diagonal(cofactors, axis1=1, axis2=2)[free]
    np.testing.assert_allclose(np.sum(inverse**2, axis=1), variances, rtol=1e-6)


def test_a_vector_is_tested_as_a_whole(measured):
    """By how much Σ r² falls without it; of errorless ones as often as chi-squared
    says."""
    held = np.zeros((5, 3), bool)
    held[0], held[1, 1] = True, True
    found = adjust_network(Network(POINTS, held, measured))
    own = rows(found.terms, found.adjusted.parameters, held=found.held)
    vector = list(AT).index("vector")
    group = np.where(own.term == vector, own.group, -1)
    tested = assess_groups(normalise_rows(own), group)
    less = list(measured)
    part = less[vector]
    less[vector] = part._replace(
        at=part.at[1:], values=part.values[1:], roots=part.roots[1:]
    )
    without = adjust_network(Network(POINTS, held, tuple(less)))
    squares = [
        float(f.adjusted.sigma0) ** 2 * int(f.adjusted.degrees_of_freedom)
        for f in (found, without)
    ]
    np.testing.assert_allclose(tested.statistic[0], squares[0] - squares[1], rtol=1e-4)
    assert tested.freedom[0] == 3
    np.testing.assert_allclose(
        tested.p[0],
        np.exp(-tested.statistic[0] / 2) * (np.sqrt(2 * tested.statistic[0] / np.pi))
        + jax.scipy.special.erfc(np.sqrt(tested.statistic[0] / 2)),
        rtol=1e-6,
    )


@pytest.mark.slow
def test_vectors_with_one_covariance_matrix():
    """Two vectors that were measured together, and a third: least squares with all
    weights."""
    rng = np.random.default_rng(2)
    a = rng.normal(size=(6, 6))
    together = a @ a.T + np.eye(6)
    values = rng.normal(size=9)
    measured = (
        Measured(
            "vector",
            np.array([[0, 1, 1, 2]]),
            values[None, :6],
            np.linalg.cholesky(together)[None],
        ),
        Measured("vector", np.array([[0, 2]]), values[None, 6:], np.eye(3)[None]),
    )
    held = np.zeros((3, 3), bool)
    held[0] = True
    found = adjust_network(Network(np.zeros((3, 3)), held, measured))
    one, none = np.eye(3), np.zeros((3, 3))
    design = np.block([[one, none], [-one, one], [none, one]])
    weights = np.linalg.inv(
        np.block([[together, np.zeros((6, 3))], [np.zeros((3, 6)), one]])
    )
    cofactor = np.linalg.inv(design.T @ weights @ design)
    wanted = cofactor @ design.T @ weights @ values
    np.testing.assert_allclose(found.coordinates[1:].ravel(), wanted, atol=1e-9)
    blocks = np.asarray(found.adjusted.cofactors("point"))[1:]
    np.testing.assert_allclose(blocks[0], cofactor[:3, :3], atol=1e-9)
    np.testing.assert_allclose(blocks[1], cofactor[3:, 3:], atol=1e-9)
