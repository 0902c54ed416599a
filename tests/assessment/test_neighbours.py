"""The test of agreement between the residuals of neighbouring points, and the accuracy
where there is some."""

import dataclasses
import json
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from typer.testing import CliRunner

import jaxro
from jaxro import IndependentElements, Pair, table_neighbours
from jaxro.assessment import (
    allow_for_neighbours,
    correlated_covariance,
    neighbours,
    pattern,
    pool,
)
from jaxro.assessment.correlated import BLOCK
from jaxro.batches.after_cleaning import difference
from jaxro.cli import app
from jaxro.geometry import mock_pairs
from jaxro.geometry.linear import linearise
from jaxro.rejection.steps import improve

SIGMA = 0.005
PHOTO = 140.0
ELEMENTS = (0.03, -0.05, 0.04, -0.02, 0.06)


def places(
    points: int, regular: bool, pairs: int, rng: np.random.Generator
) -> np.ndarray:
    """(pair, 3, point): x and y in the overlap of 90 by 140 mm, random or on a grid,
    and heights."""
    if regular:
        wide, long = {16: (4, 4), 40: (5, 8), 100: (8, 13)}[points]
        grid = np.stack(
            np.meshgrid(np.linspace(-10, 80, wide), np.linspace(-70, 70, long))
        ).reshape(2, -1)
        xy = np.broadcast_to(grid[:, :points], (pairs, 2, points))
    else:
        xy = rng.uniform([[-10], [-70]], [[80], [70]], (pairs, 2, points))
    return np.concatenate([xy, rng.uniform(-8, 8, (pairs, 1, points))], axis=1)


AT_ONCE = 500
"""Pairs of one call: every number of pairs goes by the same programs."""


@cache
def programs():
    """The errorless pairs; the orientation from their errors and the test."""
    elements = IndependentElements(*(jnp.asarray(e) for e in ELEMENTS))

    def ideal(place) -> Pair:
        layout = mock_pairs.Layout(place[0] / 70, place[1] / 70, ())
        return mock_pairs.mock_pair(layout, elements, heights=place[2])

    def solved(place, errors):
        names = ("x_left", "y_left", "x_right", "y_right")
        pair = mock_pairs.plant(ideal(place), **dict(zip(names, errors, strict=True)))
        pose = jax.lax.fori_loop(
            0, 4, lambda _, p: improve(pair, p, pair.mask), jaxro.to_pose(elements)
        )
        return neighbours.of_linear(linearise(pair, pose), pair.coordinates)

    return at_once(jax.jit(jax.vmap(ideal))), at_once(
        jax.jit(lambda *a: jax.lax.map(lambda one: solved(*one), a, batch_size=50))
    )


def at_once(program):
    """A program of any number of pairs, by calls of AT_ONCE; the last is filled up by
    repetition."""

    def every(*data):
        count = len(data[0])
        rows = np.resize(np.arange(count), -(-count // AT_ONCE) * AT_ONCE)
        parts = [
            program(*(a[k] for a in data)) for k in np.split(rows, len(rows) // AT_ONCE)
        ]
        return jax.tree.map(lambda *a: jnp.concatenate(a)[:count], *parts)

    return every


def correlated_errors(
    pairs: Pair, rho: float, length: float, rng: np.random.Generator
) -> np.ndarray:
    """(pair, 4, point) errors of variance sigma², correlated by rho exp(-(d/l)²) in
    each coordinate of a photo."""
    coordinates = [np.asarray(c) for c in pairs.coordinates]
    every = []
    for x, y in (coordinates[:2], coordinates[2:]):
        squared = (x[:, :, None] - x[:, None]) ** 2 + (y[:, :, None] - y[:, None]) ** 2
        covariance = (1 - rho + 1e-9) * np.eye(x.shape[1]) + rho * np.exp(
            -squared / length**2
        )
        factor = np.linalg.cholesky(covariance)
        every += [(factor @ rng.normal(size=(*x.shape, 1)))[..., 0] for _ in range(2)]
    return SIGMA * np.stack(every, axis=1)


def judged(
    points: int,
    regular: bool,
    pairs: int,
    rho: float = 0.0,
    length: float = 0.1 * PHOTO,
    seed: int = 0,
):
    rng = np.random.default_rng(seed)
    ideal, solved = programs()
    place = places(points, regular, pairs, rng)
    if rho:
        return solved(place, correlated_errors(ideal(place), rho, length, rng))
    return solved(place, SIGMA * rng.normal(size=(pairs, 4, points)))


def test_level_and_power():
    """Independent errors are flagged in 5 %; of errors correlated by .5 over a tenth of
    the photo, a pair of forty points shows 44 %, where the most powerful test of known
    rho and length has 47; ten pairs together show it."""
    flagged = np.mean(np.asarray(judged(40, False, 1500).probability) < 0.05)
    assert abs(flagged - 0.05) < 0.015
    found = judged(40, False, 200, rho=0.5)
    assert np.mean(np.asarray(found.probability) < 0.05) > 0.33
    together = jax.jit(jax.vmap(pool))(
        jax.tree.map(lambda a: a.reshape(-1, 10, *a.shape[1:]), found)
    )
    assert np.all(np.asarray(together.probability) < 0.05)
    np.testing.assert_allclose(np.median(together.rho), 0.5, atol=0.15)
    np.testing.assert_allclose(np.median(together.length), 0.1 * PHOTO, rtol=0.4)


@pytest.mark.slow
@pytest.mark.parametrize("regular", [False, True])
@pytest.mark.parametrize("points", [16, 40, 100])
def test_level_at_full_size(points, regular):
    flagged = np.mean(
        np.asarray(
            judged(points, regular, 10_000 if points < 100 else 4_000).probability
        )
        < 0.05
    )
    assert abs(flagged - 0.05) < (0.009 if points < 100 else 0.012)


def test_probability_is_that_of_a_simulation():
    """The statistic written as sums over pairs of points, R by a QR decomposition,
    20,000 draws of independent errors; NumPy arrays and JAX arrays give the same."""
    rng = np.random.default_rng(3)
    ideal, _ = programs()
    place = places(40, False, 1, rng)
    errors = correlated_errors(ideal(place), 0.4, 20.0, rng)[0]
    pair = jax.tree.map(lambda a: a[0], ideal(place))
    pair = mock_pairs.plant(
        pair, x_left=errors[0], y_left=errors[1], x_right=errors[2], y_right=errors[3]
    )
    photo = jaxro.orient(pair)
    found = pattern(pair, photo)
    linear, coordinates = jax.tree.map(
        np.asarray, (linearise(pair, photo.pose), pair.coordinates)
    )
    in_numpy = neighbours.of_linear(linear, coordinates)
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(in_numpy), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-8)

    b = np.stack(linear.gradient)
    u = b / np.sqrt(np.sum(b * b, axis=0))
    xl, yl, xr, yr = coordinates
    side = np.sqrt(np.ptp(xl) * np.ptp(yl))
    k = np.zeros((40, 40))
    for i in range(40):
        for j in range(40):
            for l in (0.025, 0.05, 0.1, 0.2):
                if i != j:
                    left = np.exp(
                        -((xl[i] - xl[j]) ** 2 + (yl[i] - yl[j]) ** 2) / (l * side) ** 2
                    )
                    right = np.exp(
                        -((xr[i] - xr[j]) ** 2 + (yr[i] - yr[j]) ** 2) / (l * side) ** 2
                    )
                    k[i, j] += (u[:2, i] @ u[:2, j]) * left + (
                        u[2:, i] @ u[2:, j]
                    ) * right
    root = np.sqrt(linear.weight)
    basis, _ = np.linalg.qr(np.stack(linear.columns, axis=1) * root[:, None])
    statistic = lambda r: np.einsum("si,ij,sj->s", r, k, r) / np.sum(r * r, axis=1)
    draws = rng.normal(size=(20_000, 40))
    chance = np.mean(
        statistic(draws - draws @ basis @ basis.T)
        >= statistic((linear.g * root)[None, :])
    )
    np.testing.assert_allclose(found.probability, chance, atol=0.006)


@pytest.mark.slow
def test_padding_and_sigma_change_nothing():
    """Masked points take no part; the probability does not depend on sigma."""
    pair = mock_pairs.noisy(
        mock_pairs.mock_pair(mock_pairs.row_layout()), jax.random.key(1), SIGMA
    )
    found = pattern(pair, jaxro.orient(pair))
    wide = jaxro.pad(pair, 20)
    again = pattern(wide, jaxro.orient(wide))
    other = Pair(
        *pair.coordinates,
        0.01 * pair.sigma,
        pair.mask,
        pair.focal_left,
        pair.focal_right,
    )
    for same in (again, pattern(other, jaxro.orient(other))):
        np.testing.assert_allclose(same.probability, found.probability, rtol=1e-6)
        np.testing.assert_allclose(same.rho, found.rho, rtol=1e-6, atol=1e-9)
    six = mock_pairs.noisy(
        mock_pairs.mock_pair(mock_pairs.standard_layout(6)), jax.random.key(1), SIGMA
    )
    assert pattern(six, jaxro.orient(six)).probability == 1  # one degree of freedom


@pytest.mark.slow
@pytest.mark.parametrize("elements", [jaxro.RelativePose, IndependentElements])
def test_correlated_covariance_is_the_scatter(elements):
    """The deviations of AT_ONCE orientations from correlated errors, which are known to
    a thirtieth; without correlation those of the adjustment."""
    rng = np.random.default_rng(5)
    ideal, _ = programs()
    place = np.repeat(places(40, False, 1, rng), AT_ONCE, axis=0)
    pairs = ideal(place)
    errors = correlated_errors(pairs, 0.5, 40.0, rng)
    measured = [
        c + e for c, e in zip(pairs.coordinates, errors.transpose(1, 0, 2), strict=True)
    ]
    noisy = Pair(
        *measured, pairs.sigma, pairs.mask, pairs.focal_left, pairs.focal_right
    )
    found = jaxro.orient_batch(noisy, elements=elements)
    one = jax.tree.map(lambda a: a[:50], (noisy, found))
    told = jax.jit(jax.vmap(lambda p, o: correlated_covariance(p, o, 0.5, 40.0)))(*one)
    variance = np.mean(
        np.diagonal(np.asarray(told.covariance), axis1=1, axis2=2), axis=0
    )
    if elements is IndependentElements:
        scatter = np.var(np.stack(found.elements.values(), axis=1), axis=0)
        np.testing.assert_allclose(np.sqrt(variance), np.sqrt(scatter), rtol=0.1)
        assert np.max(np.asarray(told.growth)) > 1.5
    np.testing.assert_allclose(np.mean(told.sigma0), SIGMA, rtol=0.06)
    plain = correlated_covariance(*jax.tree.map(lambda a: a[0], one), 0.0, 40.0)
    np.testing.assert_allclose(
        plain.covariance, found.covariance[0], rtol=1e-5, atol=1e-14
    )
    np.testing.assert_allclose(plain.growth, 1, rtol=1e-9)


def table(points, pairs, rho, length, seed=7):
    """A table of different layouts with such errors, oriented, and the true pose."""
    rng = np.random.default_rng(seed)
    ideal, _ = programs()
    exact = ideal(places(points, False, pairs, rng))
    errors = correlated_errors(exact, rho, length, rng).transpose(1, 0, 2)
    measured = [
        np.asarray(c) + e for c, e in zip(exact.coordinates, errors, strict=True)
    ]
    measured = jaxro.pair(*measured, focal=70.0)
    truth = jaxro.to_pose(IndependentElements(*(jnp.asarray(e) for e in ELEMENTS)))
    return measured, jaxro.orient_batch(measured), truth


def hold(found, truth):
    """The share of pairs whose joint 95 % region holds the true pose."""
    away = jax.jit(jax.vmap(lambda pose: jnp.stack(difference(pose, truth))))
    off = np.asarray(away(found.pose))
    squared = np.einsum("ki,kij,kj->k", off, np.linalg.inv(found.covariance), off)
    return np.mean(squared <= np.asarray(found.radius()) ** 2)


@pytest.mark.slow
def test_a_table_tells_the_deviations_of_its_pairs():
    """Of errors that agree by .5 over a tenth of the photo, regions hold what they
    promise by what the table tells of them, and independent ones are left as they are;
    cofactors twice as large grow as these do."""
    pairs, found, truth = table(40, 150, 0.5, 0.1 * PHOTO)
    allowed, together = table_neighbours.allow(pairs, found)
    assert together.sure
    np.testing.assert_allclose(together.rho, 0.5, atol=0.1)
    np.testing.assert_allclose(together.length, 0.1 * PHOTO, rtol=0.2)
    assert hold(found, truth) < 0.85 and 0.9 < hold(allowed, truth) < 0.99

    told = float(together.rho), float(together.length)
    one = jax.tree.map(lambda a: a[0], (pairs, found))
    expected = correlated_covariance(*one, *told).covariance
    np.testing.assert_allclose(allowed.covariance[0], expected, rtol=1e-9)
    twice = dataclasses.replace(one[1], cofactor=2 * one[1].cofactor)
    grown = allow_for_neighbours(one[0], twice, *told)
    np.testing.assert_allclose(grown.covariance, 2 * expected, rtol=1e-9)

    pairs, found, _ = table(40, 150, 0.0, 1.0)
    same, together = table_neighbours.allow(pairs, found)
    assert not together.sure and same is found


@pytest.mark.slow
@pytest.mark.parametrize("points", [16, 50, 200, 500])
@pytest.mark.parametrize("rho", [0.5, 0.8])
@pytest.mark.parametrize("length", [0.02, 0.05, 0.1])
def test_regions_hold_in_tables_of_fifty_pairs(points, rho, length):
    """A share of 200 pairs, which has a deviation of 1.5 %."""
    inside = []
    for seed in range(4):
        pairs, found, truth = table(points, 50, rho, length * PHOTO, seed)
        inside.append(hold(table_neighbours.allow(pairs, found)[0], truth))
    assert 0.9 - 0.015 <= np.mean(inside) <= 0.97 + 0.03


def test_many_points_are_those_of_the_whole_matrix():
    """The covariance of more points than are in memory at once, from K in plain
    NumPy."""
    rng = np.random.default_rng(4)
    points = 2 * BLOCK + 3
    ideal, _ = programs()
    pair = jax.tree.map(lambda a: a[0], ideal(places(points, False, 1, rng)))
    photo = jaxro.orient(mock_pairs.noisy(pair, jax.random.key(2), SIGMA))
    pair = jaxro.pad(pair, photo.residuals.size)
    told = correlated_covariance(pair, photo, 0.6, 15.0)
    linear = jax.tree.map(np.asarray, linearise(pair, photo.pose))
    rows = np.stack(linear.columns, axis=1) * np.sqrt(linear.weight)[:, None]
    k = neighbours.agreement(linear, jax.tree.map(np.asarray, pair.coordinates))(15.0)
    q = np.linalg.inv(rows.T @ rows)
    variance = float(photo.sigma0) ** 2 * (points - 5)
    variance /= points - 5 - 0.6 * np.sum(q * (rows.T @ k @ rows))
    expected = variance * (q + 0.6 * q @ rows.T @ k @ rows @ q)
    np.testing.assert_allclose(told.covariance, expected, rtol=1e-9)


@pytest.mark.slow
def test_report_says_it(tmp_path):
    """One pair and a table of three, correlated errors: the sentence, and probability,
    rho and the growth of the deviations in the JSON."""
    rng = np.random.default_rng(2)
    ideal, _ = programs()
    pairs = ideal(places(40, False, 3, rng))
    errors = correlated_errors(pairs, 0.8, 30.0, rng)
    measured = np.stack(pairs.coordinates, axis=1) + errors
    for count in (1, 3):
        rows = ["pair,point,x_left,y_left,x_right,y_right"]
        rows += [
            f"p{k},{i},{','.join(map(repr, map(float, measured[k, :, i])))}"
            for k in range(count)
            for i in range(40)
        ]
        table, out = tmp_path / f"{count}.csv", tmp_path / f"out{count}"
        table.write_text("\n".join(rows) + "\n", encoding="utf-8")
        told = CliRunner().invoke(
            app, ["orient", str(table), "--focal", "70", "--out", str(out)]
        )
        assert told.exit_code == 0, told.output
        summary = json.loads((out / "summary.json").read_text(encoding="utf-8"))
        assert "the standard deviations allow for it" in " ".join(told.output.split())
        assert summary["growth_of_deviations"] > 1
        assert (
            summary["pattern"]["probability"] < 0.05
            and 0.3 < summary["pattern"]["rho"] <= 1
        )
        assert all(
            p["pattern"] is not None and p["pattern"]["length_mm"] > 0
            for p in summary["pairs"]
        )
