"""Covariances of the coordinates of a point, where a pair usually has one sigma:
against dense matrices in plain NumPy, and by laws."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import oracles
import oracles_covariances as oracle
import pytest

import jaxro
from jaxro import (
    IndependentElements,
    assess,
    coplanarity,
    orient,
    rejection,
)
from jaxro.batches.buckets import choose
from jaxro.batches.ragged import concatenate
from jaxro.geometry.mock_pairs import Layout, mock_pair, noisy, plant
from jaxro.geometry.pairs import mask_unusable
from jaxro.tables import csv
from jaxro.tables.fields import TableError
from jaxro.tables.measured import to_ragged

FOCAL = 150.0
ELEMENTS = (0.03, -0.02, 0.01, -0.025, 0.04)
POINTS = 24
BATCH = 5


def rng():
    return np.random.default_rng(7)


def random_covariances(generator, points, size=0.01):
    """Two arrays (point, 2, 2), the accuracy of x up to several times better or worse
    than of y, in any direction."""
    roots = generator.normal(size=(2, points, 2, 2)) + 0.3 * np.eye(2)
    covariances = roots @ np.swapaxes(roots, -1, -2) + 0.02 * np.eye(2)
    return size**2 * (covariances + np.swapaxes(covariances, -1, -2)) / 2


def exact_pair(points=POINTS, seed=7):
    generator = np.random.default_rng(seed)
    x, y = generator.uniform(-0.2, 1.2, points), generator.uniform(-0.9, 0.9, points)
    layout = Layout(tuple(x.tolist()), tuple(y.tolist()), ())
    elements = IndependentElements(*map(jnp.asarray, ELEMENTS))
    heights = jnp.asarray(generator.uniform(-12.0, 12.0, points))
    return mock_pair(
        layout, elements, focal=FOCAL, base=80.0, y_range=80.0, heights=heights
    )


def with_covariances(one, covariances):
    """The pair with these covariances, the same coordinates."""
    return jaxro.pair(
        *map(np.asarray, one.coordinates),
        focal=(float(one.focal_left), float(one.focal_right)),
        covariances=tuple(covariances),
    )


@pytest.fixture(scope="module")
def covariances():
    return random_covariances(rng(), POINTS)


@pytest.fixture(scope="module")
def pair(covariances):
    """Points with covariances, and errors that have them."""
    exact = with_covariances(exact_pair(), covariances)
    return noisy(exact, jax.random.key(3), exact.sigma[None, :])


@pytest.fixture(scope="module")
def oriented(pair):
    return orient(pair, elements=IndependentElements)


def coordinates(one):
    return np.stack([np.asarray(c) for c in one.coordinates])


def test_the_matrices_that_were_given_come_back(pair, covariances):
    np.testing.assert_allclose(pair.covariances, covariances, rtol=1e-12, atol=1e-18)
    four = [a[:, k, k] for a in covariances for k in range(2)]
    np.testing.assert_allclose(pair.sigma**2, np.mean(four, axis=0), rtol=1e-12)


def test_the_errors_of_simulated_points_have_these_covariances(covariances):
    exact = with_covariances(exact_pair(), covariances)
    keys = jax.random.split(jax.random.key(1), 4000)
    drawn = jax.vmap(lambda key: noisy(exact, key, exact.sigma[None, :]))(keys)
    errors = np.stack(drawn.coordinates) - coordinates(exact)[:, None]
    for side, wanted in zip((errors[:2], errors[2:]), covariances, strict=True):
        found = np.einsum("arn,brn->nab", side, side) / len(keys)
        scale = np.sqrt(wanted[:, [0, 1], [0, 1]])
        off = (found - wanted) / (scale[:, :, None] * scale[:, None, :])
        assert np.max(np.abs(off)) < 5 * np.sqrt(2 / len(keys))


def test_elements_and_sigma0_of_gauss_helmert(pair, oriented, covariances):
    """The rigorous residual is linearised at the measured coordinates, the oracle at
    the adjusted ones: they differ by a small part of the standard deviations."""
    told = oracle.gauss_helmert(
        coordinates(pair), (FOCAL, FOCAL), oracles.independent, ELEMENTS, covariances
    )
    found = np.array([float(e) for e in oriented.elements.values()])
    deviations = np.sqrt(np.diag(told.cofactor))
    assert np.max(np.abs(found - told.elements) / deviations) < 2e-3
    np.testing.assert_allclose(oriented.cofactor, told.cofactor, rtol=5e-3, atol=1e-12)
    assert float(oriented.sigma0) == pytest.approx(told.sigma0, rel=1e-4)
    v = np.stack(oriented.corrections(pair))
    assert np.max(np.abs(v - told.corrections)) < 1e-3 * np.max(
        np.abs(told.corrections)
    )


def test_equal_weights_would_give_other_elements(pair, oriented, covariances):
    """The differences that are tested are not rounding."""
    plain = orient(
        eqx.tree_at(lambda p: p.roots, pair, None), elements=IndependentElements
    )
    shift = jnp.stack(oriented.elements.values()) - jnp.stack(plain.elements.values())
    assert float(jnp.max(jnp.abs(shift) / oriented.deviations)) > 0.3


def test_reliability_of_dense_matrices(covariances):
    """With small errors: the package linearises the whitened residual, the oracle the
    condition, which differ by the size of the errors."""
    exact = with_covariances(exact_pair(), covariances)
    pair = noisy(exact, jax.random.key(3), 1e-3 * exact.sigma[None, :])
    oriented = orient(pair, elements=IndependentElements)
    told = oracle.dense(
        coordinates(pair),
        (FOCAL, FOCAL),
        oracles.independent,
        [float(e) for e in oriented.elements.values()],
        covariances,
    )
    found = assess(pair, oriented, sigma0=1.0)
    close = lambda a, b: np.testing.assert_allclose(a, b, rtol=2e-6, atol=1e-9)
    by_point = lambda values: np.asarray(values).reshape(POINTS, 4).T
    close(np.stack(found.coordinate_redundancy), by_point(np.diag(told.redundancy)))
    close(np.sum(found.redundancy), POINTS - 5)
    close(found.redundancy, np.sum(by_point(np.diag(told.redundancy)), axis=0))
    close(np.abs(found.w)[None, :] + np.zeros((4, 1)), np.abs(by_point(told.w)))
    least = float(found.delta0) * by_point(told.least)
    close(np.stack(found.detectable), least)
    close(np.stack(oriented.corrections(pair)), told.corrections)
    moved = np.abs(told.shift) * (float(found.delta0) * told.least)[None, :]
    close(np.stack(found.effect), moved.reshape(5, POINTS, 4)[:, :, 0])


@pytest.mark.slow
def test_height_changes_as_a_new_adjustment_says(pair):
    """The effect on the height of a point, through the elements and through the
    corrections, of a small error in one coordinate."""
    options = {"elements": IndependentElements, "base": 80.0}
    oriented = orient(pair, **options)
    found = assess(pair, oriented, sigma0=1.0)
    step, point = 1e-4, 5
    for k, name in enumerate(("x_left", "y_left", "x_right", "y_right")):
        move = jnp.where(jnp.arange(POINTS) == point, step, 0.0)
        moved = [plant(pair, **{name: s * move}) for s in (1, -1)]
        ends = [orient(one, **options) for one in moved]
        slope = (ends[0].model[2][point] - ends[1].model[2][point]) / (2 * step)
        told = found.effect_height[k][point] / found.detectable[k][point]
        assert float(told) == pytest.approx(abs(float(slope)), rel=2e-3)


def as_numbers(tree):
    return [np.asarray(a, float) for a in jax.tree.leaves(tree)]


@pytest.mark.slow
def test_one_sigma_in_matrices_is_one_sigma(pair):
    """sigma² I as a matrix of each point gives the numbers of sigma."""
    plain = eqx.tree_at(lambda p: p.roots, pair, None)
    square = np.asarray(plain.sigma) ** 2
    same = with_covariances(plain, [square[:, None, None] * np.eye(2)] * 2)
    one, other = orient(plain), orient(same)
    for a, b in zip(as_numbers(one), as_numbers(other), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-8, atol=1e-9)
    of_one, of_other = assess(plain, one, sigma0=1.0), assess(same, other, sigma0=1.0)
    of_other = eqx.tree_at(lambda r: r.shown, of_other, None)
    for a, b in zip(as_numbers(of_one), as_numbers(of_other), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-7, atol=1e-7)
    for a, b in zip(one.corrections(plain), other.corrections(same), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-7, atol=1e-12)


def turned(one, covariances, angle):
    """The left photo with its coordinates and covariances turned about its axis."""
    c, s = np.cos(angle), np.sin(angle)
    turn = np.array([[c, -s], [s, c]])
    left = turn @ np.stack([one.x_left, one.y_left])
    moved = dataclasses.replace(
        one, x_left=jnp.asarray(left[0]), y_left=jnp.asarray(left[1])
    )
    return with_covariances(moved, [turn @ covariances[0] @ turn.T, covariances[1]])


def test_turning_a_photo_with_its_covariances_changes_no_residual(pair, covariances):
    first = orient(pair)
    again = orient(turned(pair, covariances, 0.1))
    assert float(again.sigma0) == pytest.approx(float(first.sigma0), rel=1e-9)
    size = lambda o: np.abs(np.asarray(o.residuals))
    np.testing.assert_allclose(size(again), size(first), rtol=1e-6, atol=1e-9)


def test_scaling_all_covariances_scales_sigma0_alone(pair, covariances):
    first = orient(pair)
    again = orient(with_covariances(pair, 9 * covariances))
    assert float(again.sigma0) == pytest.approx(float(first.sigma0) / 3, rel=1e-9)
    np.testing.assert_allclose(again.covariance, first.covariance, rtol=1e-7)
    for a, b in zip(first.corrections(pair), again.corrections(pair), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-6, atol=1e-12)


def test_swapping_the_photos(pair):
    first, again = orient(pair), orient(jaxro.swapped(pair))
    assert float(again.sigma0) == pytest.approx(float(first.sigma0), rel=1e-9)


@pytest.mark.slow
def test_derivatives_agree_with_finite_differences(pair):
    """By a coordinate, and by an entry of the roots."""

    def sigma0(change):
        roots = pair.roots._replace(yx_left=pair.roots.yx_left + change[1])
        moved = dataclasses.replace(pair, x_left=pair.x_left + change[0], roots=roots)
        return orient(moved, start=pose).sigma0

    pose = orient(pair).pose
    zero, own = jnp.zeros((2, POINTS)), np.array([[1e-5], [1e-4]])
    slope = jax.jacrev(sigma0)(zero)
    for row in range(2):
        step = zero.at[row, 3].set(own[row, 0])
        numeric = (sigma0(step) - sigma0(-step)) / (2 * own[row, 0])
        assert float(slope[row, 3]) == pytest.approx(float(numeric), rel=1e-4)


@pytest.fixture(scope="module")
def many():
    """Pairs with covariances of their own, and one without any."""
    pairs = []
    for k in range(BATCH):
        covariances = random_covariances(np.random.default_rng(k), POINTS - k)
        exact = with_covariances(exact_pair(POINTS - k, seed=k), covariances)
        pairs.append(noisy(exact, jax.random.key(k), exact.sigma[None, :]))
    return [*pairs, eqx.tree_at(lambda p: p.roots, pairs[0], None)]


@pytest.mark.slow
def test_batches_and_ragged_pairs_are_those_of_orient(many):
    single = np.array([float(orient(one).sigma0) for one in many])
    batch = jaxro.stack(many, 32)
    np.testing.assert_allclose(jaxro.orient_batch(batch).sigma0, single, rtol=1e-9)
    back = jaxro.unstack(batch)
    np.testing.assert_allclose(float(orient(back[2]).sigma0), single[2], rtol=1e-9)
    ragged = jaxro.join(many)
    np.testing.assert_allclose(jaxro.orient_ragged(ragged).sigma0, single, rtol=1e-9)
    both = concatenate([jaxro.join(many[:2]), jaxro.join(many[-1:])])
    found = jaxro.orient_ragged(both).sigma0
    np.testing.assert_allclose(found, single[[0, 1, -1]], rtol=1e-9)
    last = choose(
        ragged, np.array([1]), [np.arange(ragged.begins[1], ragged.begins[2])]
    )
    np.testing.assert_allclose(jaxro.orient_ragged(last).sigma0, single[[1]], rtol=1e-9)


def test_padding_and_masks_change_nothing(pair):
    first = float(orient(pair).sigma0)
    longer = jaxro.pad(pair, POINTS + 9)
    assert float(orient(longer).sigma0) == pytest.approx(first, rel=1e-9)
    zeros = jax.tree.map(lambda a: a.at[POINTS:].set(0), longer.roots)
    unused = dataclasses.replace(longer, roots=zeros)
    assert float(orient(unused).sigma0) == pytest.approx(first, rel=1e-9)


def test_what_is_no_covariance_is_told(pair, covariances):
    points = [np.asarray(c) for c in pair.coordinates]
    wrong = covariances[0].copy()
    wrong[4] = [[1e-4, 2e-4], [2e-4, 1e-4]]
    with pytest.raises(
        ValueError, match=r"covariances of point 4 .* positive definite"
    ):
        jaxro.pair(*points, focal=FOCAL, covariances=(wrong, covariances[1]))
    wrong[4] = [[1e-4, 2e-5], [1e-5, 1e-4]]
    with pytest.raises(ValueError, match="left photo is not symmetric"):
        jaxro.pair(*points, focal=FOCAL, covariances=(wrong, covariances[1]))
    with pytest.raises(ValueError, match=r"right photo have shape \(3, 2, 2\)"):
        jaxro.pair(*points, focal=FOCAL, covariances=(covariances[0], wrong[:3]))
    with pytest.raises(ValueError, match="leave out sigma"):
        jaxro.pair(*points, focal=FOCAL, sigma=0.01, covariances=tuple(covariances))
    # behind the eyes of pair(): in a batch a failure is a value
    roots = pair.roots._replace(yy_right=pair.roots.yy_right.at[2].set(jnp.nan))
    repaired, bad = mask_unusable(dataclasses.replace(pair, roots=roots))
    assert bool(bad) and not bool(repaired.mask[2])


@pytest.fixture(scope="module")
def with_wrong():
    """x is measured ten times less accurately than y, and two points have errors of 24
    standard deviations of y."""
    generator = rng()
    accurate = np.diag([0.05, 0.005]) ** 2
    one = with_covariances(exact_pair(60), [accurate, accurate])
    errors = [generator.normal(0, s, 60) for s in (0.05, 0.005, 0.05, 0.005)]
    names = ("x_left", "y_left", "x_right", "y_right")
    moved = plant(one, **dict(zip(names, map(jnp.asarray, errors), strict=True)))
    wrong = np.isin(np.arange(60), (7, 33))
    return plant(moved, y_right=jnp.where(jnp.asarray(wrong), 0.12, 0.0)), wrong


@pytest.mark.slow
@pytest.mark.parametrize(
    "procedure",
    [
        rejection.Recommended(),
        rejection.DataSnooping(),
    ],
    ids=["recommended", "data snooping"],
)
def test_cleaning_finds_errors_that_only_covariances_show(procedure, with_wrong):
    pair, wrong = with_wrong
    np.testing.assert_array_equal(np.asarray(procedure(pair).mask), ~wrong)


@pytest.mark.slow
def test_one_sigma_for_all_hides_these_errors(with_wrong):
    pair, _ = with_wrong
    plain = eqx.tree_at(lambda p: p.roots, pair, None)
    assert bool(jnp.all(rejection.DataSnooping()(plain).mask))


@pytest.mark.slow
@pytest.mark.parametrize("known", [True, False])
def test_cleaning_many_pairs(known, with_wrong):
    pair, wrong = with_wrong
    procedure = rejection.Recommended(known=known)
    masks = jaxro.clean_batch(
        jaxro.stack([pair, pair], 64), procedure, select=lambda r: r.mask
    )
    np.testing.assert_array_equal(np.asarray(masks)[:, :60], [~wrong, ~wrong])
    kept = jaxro.clean_ragged(jaxro.join([pair, pair]), procedure).kept
    np.testing.assert_array_equal(kept, np.concatenate([~wrong, ~wrong]))


def test_what_cannot_use_covariances_refuses(pair, oriented):
    for procedure in (rejection.ThreeSigma(), rejection.Dorozhinsky()):
        with pytest.raises(ValueError, match="cannot use the covariances"):
            procedure(pair)
    for procedure in (
        rejection.Recommended(sigma=0.01),
        rejection.DataSnooping(sigma=1.0),
    ):
        with pytest.raises(ValueError, match="leave out the sigma of the procedure"):
            procedure(pair)
    batch = jaxro.stack([pair, pair])
    both = jax.tree.map(lambda a: jnp.stack([a, a]), oriented)
    with pytest.raises(ValueError, match=r"variance_components: .* covariances"):
        jaxro.variance_components.by_photo(batch, both)


@pytest.mark.slow
def test_parallax_residuals_are_those_of_sigma_alone(pair):
    """The parallax is taken as measured itself: covariances of coordinates play no
    part."""
    plain = eqx.tree_at(lambda p: p.roots, pair, None)
    of = lambda one: orient(one, residual=coplanarity.parallax)
    one, other = of(pair), of(plain)
    assert float(one.sigma0) == pytest.approx(float(other.sigma0), rel=1e-9)


TABLE = (
    "point,x_left,y_left,x_right,y_right,"
    "sigma_x_left,sigma_y_left,sigma_x_right,sigma_y_right"
)


def test_columns_of_a_table_are_read():
    text = (
        f"{TABLE},cov_xy_left\n1,10,20,30,40,2,1,3,4,0.5\n2,11,21,31,41,2,1,3,4,-1.5\n"
    )
    table = csv.parse(text, "t.csv", "t")
    assert table.has_sigma and table.has_covariances
    camera = jaxro.Camera(100.0, (0.0, 0.0), 0.01, y_down=True)
    other = jaxro.Camera(100.0, (0.0, 0.0), 0.02)
    pairs = to_ragged(table, (camera, other))
    left, right = pairs.pad_to(np.array([0]), 2).covariances
    # rows that count downwards turn the sign of the covariance
    np.testing.assert_allclose(left[0, 0], 1e-4 * np.array([[4, -0.5], [-0.5, 1]]))
    np.testing.assert_allclose(left[0, 1, 0, 1], 1.5e-4)
    np.testing.assert_allclose(right[0, 1], 4e-4 * np.diag([9.0, 16.0]))


BESIDE = "column sigma_x_left: found it beside the column sigma"
WITHOUT = "column cov_xy_left: found it without"


@pytest.mark.parametrize(
    ("header", "row", "told"),
    [
        (f"{TABLE},sigma", "1,1,1,1,1,1,1,1,1,1", BESIDE),
        (TABLE.rsplit(",", 1)[0], "1,1,1,1,1,1,1,1", "found it without sigma_y_right"),
        (TABLE.split(",sigma")[0] + ",cov_xy_left", "1,1,1,1,1,1", WITHOUT),
        (TABLE, "1,1,1,1,1,1,0,1,1", "column sigma_y_left: found '0'"),
        (
            f"{TABLE},cov_xy_right",
            "1,1,1,1,1,1,1,2,3,6",
            "column cov_xy_right: found 6",
        ),
    ],
)
def test_what_does_not_fit_in_a_table_is_told(header, row, told):
    with pytest.raises(TableError) as error:
        csv.parse(f"{header}\n{row}\n", "t.csv", "t")
    assert told in str(error.value)


def test_csv_and_parquet_tables_hold_the_same(tmp_path):
    pytest.importorskip("pyarrow", reason="Parquet tables need pyarrow")
    from jaxro.tables import conversion, parquet

    rows = "1,10,20,30,40,2,1,3,4,0.5\n2,11,21,31,41,2,1,3,4,-1.5\n"

    source = tmp_path / "t.csv"
    source.write_text(
        f"pair,{TABLE},cov_xy_left\n" + "".join(f"a,{r}\n" for r in rows.split())
    )
    for name, convert in (
        ("quick", lambda file, made: conversion._convert_quickly(file, made, ".")),
        ("careful", conversion._convert_carefully),
    ):
        target = tmp_path / f"{name}.parquet"
        convert(source, target)
        read = parquet.Source(target)
        assert read.has_sigma and read.has_covariances
        table = read.read(read.scan().begins)
        told = csv.read(source)
        cameras = (jaxro.Camera(100.0), jaxro.Camera(100.0))
        one, other = to_ragged(table, cameras), to_ragged(told, cameras)
        for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
            np.testing.assert_array_equal(a, b)
    source.write_text(f"pair,{TABLE},cov_xy_left\na,1,1,1,1,1,1,1,1,1,5\n")
    with pytest.raises(TableError, match="cov_xy_left"):
        conversion.convert(source, tmp_path / "t.parquet")


@pytest.mark.slow
def test_regions_hold_what_they_say():
    """Of 1,500 simulated pairs with strongly different accuracies the 95 % regions of
    known sigma hold 95 % of the poses, and sigma0² is 1 in the mean; equal weights
    hold fewer."""
    count = 1500
    covariances = random_covariances(rng(), POINTS)
    exact = with_covariances(exact_pair(), covariances)
    truth = orient(exact).pose
    keys = jax.random.split(jax.random.key(11), count)
    pairs = jax.vmap(lambda key: noisy(exact, key, exact.sigma[None, :]))(keys)
    from jaxro.batches.after_cleaning import difference

    def inside(batch):
        found = jaxro.orient_batch(batch)
        away = jax.vmap(lambda p: jnp.stack(difference(p, truth)))(found.pose)
        away, q = np.asarray(away), np.asarray(found.cofactor)
        squares = np.einsum("pa,pab,pb->p", away, np.linalg.inv(q), away)
        return np.mean(squares < 11.0705), np.mean(np.asarray(found.sigma0) ** 2)

    share, square = inside(pairs)
    assert abs(share - 0.95) < 3 * np.sqrt(0.95 * 0.05 / count)
    assert abs(square - 1) < 3 * np.sqrt(2 / (POINTS - 5) / count)
    plain, _ = inside(dataclasses.replace(pairs, roots=None))
    assert plain < 0.9
