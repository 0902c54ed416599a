"""What a command tells of a cleaned table is what the procedure found, pair by pair."""

import jax
import numpy as np
import pytest
import scenes

import jaxro
from jaxro.batches.padding import plan_for
from jaxro.commands.causes import mirror, name_causes
from jaxro.commands.solve import Task, solve
from jaxro.geometry.elements import RelativePose
from jaxro.rejection import PROCEDURES
from jaxro.reports.columns import OUTCOME_NAMES, RESULT_NAMES
from jaxro.reports.reader import report_elements

POINTS = 50


def with_long_tails(rng):
    """A pair whose noise is not normal, so that its weights fade."""
    left = rng.uniform([-900, -700], [900, 700], (POINTS, 2))
    right = left - 2000 / rng.uniform(3, 6, (POINTS, 1)) * [1, 0]
    sizes = np.where(rng.random((POINTS, 1)) < 0.1, 3.0, 0.3)
    noise = sizes * rng.normal(size=(POINTS, 4))
    return jaxro.pair(*(np.hstack([left, right]) + noise).T, focal=2000.0, sigma=1.2)


@pytest.fixture(scope="module")
def pairs():
    """Pairs of every kind, in an order in which none is beside one of its own."""
    kinds = [scenes.weak_bases(kind, 2, POINTS, 0.3) for kind in ("plane", "space")]
    kinds.append(scenes.weak_bases("rotation", 2, POINTS, 0.2))
    of = lambda found, k: jaxro.pair(
        *(c[k] for c in found.coordinates), focal=found.focal[k], sigma=found.sigma[k]
    )
    rng = np.random.default_rng(6)
    return [
        one
        for k in range(2)
        for one in (*(of(found, k) for found in kinds), with_long_tails(rng))
    ]


@pytest.mark.slow
def test_a_table_tells_what_the_procedure_found(pairs):
    """Its verdict, sigma0, elements and their deviations: planes with two poses,
    rotations, and weights that fade."""
    procedure = PROCEDURES["recommended"]
    task = Task(RelativePose, ("elements",), sigma_known=True, procedure=procedure)
    table = jaxro.join(pairs)
    found = solve(table, task, plan_for(table.lengths))
    results, faded = set(), False
    for k, pair in enumerate(pairs):
        alone = procedure(pair)
        solved = alone.orientation
        own = slice(*table.begins[k : k + 2])
        assert found.outcome is not None and found.decided is not None
        assert found.outcome[k] == alone.outcome._value
        assert found.of_pairs["result"][k] == solved.result._value
        np.testing.assert_array_equal(found.decided["kept"][own], alone.mask)
        results.add(int(solved.result._value))
        if not solved.usable:
            continue
        told = report_elements(solved.elements, solved.cofactor, solved.sigma0)
        for name, value, deviation in zip(
            ("bx", "by", "bz", "omega", "phi", "kappa"), *told, strict=True
        ):
            sd = found.of_pairs[f"sd_{name}"][k]
            np.testing.assert_allclose(
                found.of_pairs[name][k], value, atol=1e-8 * float(sd)
            )
            np.testing.assert_allclose(sd, deviation, rtol=1e-8)
        np.testing.assert_allclose(found.of_pairs["sigma0"][k], solved.sigma0)
        plain = jaxro.orient(pair.with_mask(alone.in_use), start=solved.pose)
        faded |= bool(abs(plain.sigma0 / solved.sigma0 - 1) > 1e-3)
    assert len(results) >= 3
    assert faded


def near_vertical(rng, points):
    """Coordinates (point, 4) of a pair over hilly ground, with errors of 0.005 mm."""
    ground = rng.uniform([-0.1, -0.6, -1.05], [0.7, 0.6, -0.95], (points, 3))
    photos = [
        -150 * at[:, :2] / at[:, 2:] for at in (ground, ground - [0.6, 0.05, -0.02])
    ]
    return np.hstack(photos) + 0.005 * rng.normal(size=(points, 4))


IMAGES = {
    "as it is": lambda c: c,
    "y of the right": lambda c: c * [1, 1, 1, -1],
    "y of the left": lambda c: c * [1, -1, 1, 1],
    "x and y of the right": lambda c: c[:, [0, 1, 3, 2]],
}
"""The coordinates of a pair in axes of several kinds."""


@pytest.mark.parametrize("cleaned", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_a_mirrored_photo_is_named_and_no_point_accused(cleaned):
    """With a wrong point where pairs are cleaned, in one table with a good pair; also
    where no table of points is asked for."""
    coordinates = near_vertical(np.random.default_rng(2), 16)
    coordinates[5, 3] += 3 * cleaned
    pairs = jaxro.join(
        [
            jaxro.pair(*image(coordinates).T, focal=150.0, sigma=0.005)
            for image in IMAGES.values()
        ]
    )
    procedure = PROCEDURES["recommended"] if cleaned else None
    tables = ("elements", "residuals") if cleaned else ("elements",)
    task = Task(RelativePose, tables, True, procedure=procedure)
    plan = plan_for(pairs.lengths)
    found = name_causes(pairs, solve(pairs, task, plan), task, plan)
    names = [RESULT_NAMES[int(k)] for k in found.of_pairs["result"]]
    assert names == ["successful", "mirrored", "mirrored", "mirrored"]
    assert np.all(np.isnan(found.of_pairs["bx"][1:]))
    if cleaned:
        assert found.decided is not None and found.outcome is not None
        out = np.flatnonzero(~found.decided["kept"])
        np.testing.assert_array_equal(out, [5])
        assert OUTCOME_NAMES[int(found.outcome[0])] == "finished"
        assert {OUTCOME_NAMES[int(k)] for k in found.outcome[1:]} == {"not_oriented"}


def test_mirroring_is_an_involution_and_mirrors_the_covariances():
    rng = np.random.default_rng(3)
    root = 0.01 * (np.eye(2) + 0.3 * rng.normal(size=(8, 2, 2)))
    covariances = root @ np.swapaxes(root, 1, 2)
    given = near_vertical(rng, 8)
    pairs = jaxro.join(
        [jaxro.pair(*given.T, focal=150.0, covariances=(covariances, covariances))]
    )
    image = mirror(pairs)
    sign = np.array([1, -1])
    assert image.roots is not None
    np.testing.assert_allclose(
        image.sigma[:, None, None] ** 2 * image.roots.cofactors[1],
        covariances * sign[:, None] * sign,
    )
    again = mirror(image)
    for one, other in zip(jax.tree.leaves(pairs), jax.tree.leaves(again), strict=True):
        np.testing.assert_array_equal(one, other)
