"""Pairs that share measurements: their joint cofactors against moved measurements, the
closures of triplets against chi-squared, and the factor for files that know no
correlations."""

import json

import jax
import numpy as np
import pytest
from command_line import run, words

import jaxro
from jaxro import exchange
from jaxro.batches.joint import joint_root, largest_correlations
from jaxro.batches.ragged import Ragged, orient_ragged
from jaxro.geometry.elements import DependentElements

FOCAL, SIGMA = 1000.0, 0.5
SIDES = ((0, 1), (1, 2), (0, 2))


def places(rng, points):
    """Where three photos in general position show these many points."""
    from scipy.spatial.transform import Rotation

    centres = np.array([[0, 0, 0], [1.0, 0.2, 0], [1.9, -0.3, 0.2]])
    centres += rng.normal(0, 0.05, (3, 3))
    turns = Rotation.from_rotvec(rng.normal(0, 0.1, (3, 3)))
    ground = np.column_stack(
        [rng.uniform(-2, 3, (40 * points, 2)), rng.uniform(-6, -3, 40 * points)]
    )
    seen = []
    for turn, centre in zip(turns, centres, strict=True):
        ahead = turn.inv().apply(ground - centre)
        seen.append(-FOCAL * ahead[:, :2] / ahead[:, 2:])
    seen = np.array(seen)
    inside = np.all(np.abs(seen) < 0.8 * FOCAL, axis=(0, 2))
    return seen[:, inside][:, :points]


def fly(rng, shares, points, lens=0.0, sigma=SIGMA):
    """The pairs of triplets of photos, of whose points these shares are measured once
    on each of the three photos, and the others anew in each pair; every pair in any
    direction. `lens`: k1, which nobody knows of."""
    left, right, rows = [], [], []
    for t, share in enumerate(shares):
        true = places(rng, 4 * points)
        true = true * (1 + lens * np.sum(true**2, axis=2, keepdims=True) / FOCAL**2)
        once = true + rng.normal(0, sigma, true.shape)
        common = round(share * points)
        for k, ends in enumerate(SIDES):
            rest = slice((k + 1) * points, (k + 2) * points - common)
            anew = true[:, rest] + rng.normal(0, sigma, true[:, rest].shape)
            both = np.concatenate([once[:, :common], anew], axis=1)
            one, other = rng.permutation(ends)
            rows.append(np.concatenate([both[one], both[other]], axis=1))
            left.append(f"{t}-{one}")
            right.append(f"{t}-{other}")
    every = np.concatenate(rows)
    pairs = Ragged(
        begins=np.arange(len(rows) + 1) * points,
        **dict(zip(Ragged._fields[1:5], every.T, strict=True)),
        sigma=np.full(len(every), sigma),
        mask=np.ones(len(every), bool),
        focal_left=np.full(len(rows), FOCAL),
        focal_right=np.full(len(rows), FOCAL),
    )
    return left, right, pairs


@pytest.mark.slow
def test_cofactors_are_those_of_moved_measurements():
    """A place that is moved moves the elements of all pairs that have it, as the root
    of the joint cofactors says; of one pair the cofactors are its own."""
    sigma = 0.01 * SIGMA  # linear
    left, right, pairs = fly(np.random.default_rng(1), [1.0], 12, sigma=sigma)
    orient = lambda pairs: orient_ragged(pairs, elements=DependentElements, base=1.0)
    oriented = jax.tree.map(np.asarray, orient(pairs))
    root = joint_root(left, right, pairs, oriented.elements, oriented.cofactor)
    assert root.shape == (15, 2 * 3 * 12)
    joint = (root @ root.T).toarray()
    for k in range(3):
        own = joint[5 * k : 5 * k + 5, 5 * k : 5 * k + 5]
        np.testing.assert_allclose(own, oriented.cofactor[k], rtol=1e-7, atol=1e-14)
    at = pairs.x_left[3], pairs.y_left[3]
    step = 0.01 * sigma

    def move(by):
        here = (pairs.x_left == at[0]) & (pairs.y_left == at[1])
        there = (pairs.x_right == at[0]) & (pairs.y_right == at[1])
        assert np.sum(here) + np.sum(there) == 2
        moved = pairs._replace(
            x_left=pairs.x_left + by * here, x_right=pairs.x_right + by * there
        )
        elements = orient(moved).elements
        values = [getattr(elements, name) for name in elements.names]
        return np.stack(values, axis=-1).ravel()

    slope = (move(step) - move(-step)) / (2 * step) * sigma
    gap = np.max(np.abs(root.toarray() - slope[:, None]), axis=0)
    assert np.min(gap) < 0.005 * np.max(np.abs(slope))


@pytest.mark.slow
@pytest.mark.parametrize("sigma_known", [True, False])
def test_triplets_close_as_their_joint_covariance_says(sigma_known):
    """95 % of the closures are inside 95 %, whether pairs share all, half or none of
    their measurements; independent ones would be far too small."""
    from scipy.stats import binom, chi2

    shares = np.repeat([0.0, 0.5, 1.0], 100)
    left, right, pairs = fly(np.random.default_rng(2), shares, 20)
    oriented = orient_ragged(pairs)
    assert np.all(oriented.usable)
    found = jaxro.close_triplets(left, right, pairs, oriented, sigma_known=sigma_known)
    assert found is not None and len(found.photos) == 300
    inside = (found.squares < chi2.ppf(0.95, 3)).reshape(3, 100).sum(axis=1)
    assert np.all(inside >= binom.ppf(0.001, 100, 0.95)), inside
    assert found.freedom == pytest.approx(900) and not found.open
    # pairs whose names are not shared share nothing
    apart = [f"{name} of {k}" for k, name in enumerate(left)]
    assert jaxro.close_triplets(apart, right, pairs, oriented) is None
    # the same with all places moved by more than a copy is: independent
    rng = np.random.default_rng(3)
    away = pairs._replace(x_left=pairs.x_left + rng.normal(0, SIGMA, len(pairs.x_left)))
    alone = jaxro.close_triplets(left, right, away, oriented, sigma_known=sigma_known)
    assert alone is not None
    assert np.mean(alone.squares[200:]) < 0.6 * np.mean(found.squares[200:])


def test_pairs_that_are_not_usable_take_no_part():
    """A pair of four points opens its triplet."""
    left, right, pairs = fly(np.random.default_rng(7), [1.0, 1.0], 20)
    mask = pairs.mask.copy()
    mask[4:20] = False
    pairs = pairs._replace(mask=mask)
    oriented = orient_ragged(pairs)
    found = jaxro.close_triplets(left, right, pairs, oriented)
    assert found is not None and found.photos == (("1-0", "1-1", "1-2"),)
    graph = exchange.pose_graph(left, right, oriented, pairs=pairs, sigma0=1.0)
    assert len(graph.factor) == 5 and np.all(graph.factor > 1)


def test_a_lens_that_nobody_knows_shows_in_triplets():
    left, right, pairs = fly(np.random.default_rng(4), [1.0] * 30, 20, lens=-0.02)
    found = jaxro.close_triplets(left, right, pairs, orient_ragged(pairs))
    assert found is not None and found.open and found.ratio > 2


def test_edges_with_shared_measurements_are_not_overconfident():
    """The factor bounds the joint covariance, and is 1 where nothing is shared; the
    information of the graph is divided by it."""
    left, right, pairs = fly(np.random.default_rng(5), [1.0, 0.0], 20)
    oriented = orient_ragged(pairs)
    cofactor = np.asarray(oriented.cofactor)
    root = joint_root(left, right, pairs, oriented.elements, cofactor)
    factor = largest_correlations(root, cofactor)
    assert np.all(factor[:3] == factor[0]) and factor[0] > 1.2
    np.testing.assert_allclose(factor[3:], 1.0, rtol=1e-9)
    own = np.zeros((30, 30))
    for k in range(6):
        own[5 * k : 5 * k + 5, 5 * k : 5 * k + 5] = factor[k] * cofactor[k]
    least = np.linalg.eigvalsh(own - (root @ root.T).toarray())
    assert least[0] > -1e-9 * least[-1]
    names = left, right, oriented, 1.0, 0.1
    alone = exchange.pose_graph(*names, sigma0=1.0)
    graph = exchange.pose_graph(*names, pairs=pairs, sigma0=1.0)
    np.testing.assert_allclose(graph.factor, factor)
    weaker = alone.information / factor[:, None, None]
    np.testing.assert_allclose(graph.information, weaker)
    # the joint covariance of the edges has that of each on its diagonal
    both = {"length": 1.0, "length_deviation": 0.1, "sigma0": 1.0}
    tangent = exchange.tangents.g2o
    joint = exchange.joint_pose_covariance(
        left, right, pairs, oriented, tangent, **both
    ).toarray()
    each = exchange.pose_covariance(oriented, tangent, **both)
    for k in range(6):
        block = joint[6 * k : 6 * k + 6, 6 * k : 6 * k + 6]
        np.testing.assert_allclose(block, each[k], rtol=1e-6, atol=1e-12)
    assert np.max(np.abs(joint[:18, 18:])) == 0 < np.max(np.abs(joint[:6, 6:12]))


@pytest.mark.slow
def test_reports_say_what_does_not_close(tmp_path):
    """With the lens corrected nothing is said; without it the factor and the worst
    triplet, in the report and in the JSON."""
    for lens in (0.0, -0.03):
        rng = np.random.default_rng(6)
        left, right, pairs = fly(rng, [1.0] * 10, 20, lens=lens)
        rows = ["left,right,point,x_left,y_left,x_right,y_right"]
        owner = np.repeat(np.arange(30), 20)
        for k, *four in zip(owner, *pairs[1:5], strict=True):
            of_photos = f"{left[k]},{right[k]}".replace("-", " photo ")
            rows.append(
                f"{of_photos},{len(rows)},{','.join(map(repr, map(float, four)))}"
            )
        table, out = tmp_path / f"{lens}.csv", tmp_path / f"{lens}"
        table.write_text("\n".join(rows) + "\n")
        told = run("orient", table, "--focal", FOCAL, "--out", out)
        closures = json.loads((out / "summary.json").read_text())["closures"]
        assert told.exit_code == 0 and closures["triplets"] == 10
        said = "10 triplets of photos do not close" in words(told.stdout)
        assert said == (lens != 0) == (closures["probability"] < 0.001)
        assert closures["worst"]["photos"][0] in words(told.stdout)
