"""Points that repeat another one are one measurement, from the API and from tables."""

import dataclasses
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from command_line import rows, run, words

import jaxro
from jaxro.batches.copies import first_rows
from jaxro.batches.ragged import join
from jaxro.geometry.copies import find_copies

SIGMA, FOCAL, POINTS = 0.01, 150.0, 24


def measured(rng, pairs):
    """Coordinates (4, pair, point) with copies: exact ones, and others about as near as
    a tenth of sigma, on either side of it."""
    coordinates = rng.uniform(-80, 80, (4, pairs, POINTS))
    for k in range(pairs):
        to, source = rng.permutation(POINTS)[: 2 * (k % 4)].reshape(2, -1)
        near = rng.choice([0.0, 1e-9, 0.09, 0.11], len(to)) * SIGMA
        coordinates[:, k, to] = coordinates[:, k, source] + near
    return coordinates


def groups(coordinates, taking_part, most):
    """Of every point the least number of those that it is a copy of: by comparing each
    with each."""
    first = np.arange(coordinates.shape[1])
    for i in range(len(first)):
        for j in range(i):
            apart = np.abs(coordinates[:, i] - coordinates[:, j]).max()
            if apart <= most and taking_part[i] and taking_part[j]:
                first[i] = min(first[i], first[j])
    return first


def test_copies_are_those_of_comparing_each_with_each():
    """NumPy and JAX, batches and pairs of any length find the same groups."""
    rng = np.random.default_rng(8)
    coordinates = measured(rng, 40)
    mask = rng.random((40, POINTS)) < 0.9
    sigma, focal = np.full(mask.shape, SIGMA), np.full(40, FOCAL)
    found = find_copies(tuple(coordinates), sigma, mask, focal)
    traced = jax.jit(lambda *given: find_copies(*given, xp=jnp))
    assert np.array_equal(found, traced(tuple(coordinates), sigma, mask, focal))
    pairs = []
    for k in range(40):
        wanted = groups(coordinates[:, k], mask[k], 0.1 * SIGMA)
        # which one of a group is the first is free
        together = lambda first: first[:, None] == first[None, :]
        assert np.array_equal(together(found[k]), together(wanted))
        one = jaxro.pair(*coordinates[:, k], focal=FOCAL, sigma=SIGMA, mask=mask[k])
        assert np.array_equal(one.mask, mask[k] & (found[k] == np.arange(POINTS)))
        pairs.append(dataclasses.replace(one, mask=jnp.asarray(mask[k])))
    begins = POINTS * np.arange(40)[:, None]
    flat = first_rows(join(pairs)).reshape(40, POINTS)
    assert np.array_equal(flat - begins, found)


@pytest.mark.slow
@pytest.mark.parametrize("apart", [0.0, 1e-9])
def test_five_points_prove_nothing_however_often_they_stand_there(apart):
    """The orientation is that of the five, without redundancy; after cleaning it is
    not called successful either."""
    rng = np.random.default_rng(3)
    model = rng.uniform([-1, -1, 3], [1, 1, 6], (5, 3))
    left = -FOCAL * model[:, :2] / -model[:, 2:]
    right = -FOCAL * (model - [1.0, 0, 0])[:, :2] / -model[:, 2:]
    points = np.concatenate([left, right], axis=1).T + rng.normal(0, SIGMA, (4, 5))
    repeated = points[:, rng.integers(5, size=7)] + apart * rng.normal(size=(4, 7))
    every = np.concatenate([points, repeated], axis=1)
    pair = jaxro.pair(*every, focal=FOCAL, sigma=SIGMA)
    five = jaxro.pair(*points, focal=FOCAL, sigma=SIGMA)
    one, other = jaxro.orient(pair), jaxro.orient(five)
    assert int(one.degrees_of_freedom) == 0
    assert one.result == other.result != jaxro.RESULTS.successful
    found = jaxro.rejection.Recommended()(pair)
    assert found.orientation.result != jaxro.RESULTS.successful


@pytest.mark.slow
def test_a_table_says_which_points_repeat_others(tmp_path):
    """They have the residuals of what they repeat, are kept or rejected with it, and
    count once."""
    rng = np.random.default_rng(5)
    coordinates = rng.uniform(-80, 80, (4, 12))
    coordinates[2] = coordinates[0] - 60
    coordinates[3] = coordinates[1] + rng.normal(0, SIGMA, 12)
    coordinates[:, 11], coordinates[:, 10] = coordinates[:, 4], coordinates[:, 0]
    coordinates[3, [0, 10]] += 5.0
    lines = [
        f"{k},{','.join(map(repr, c))}" for k, c in enumerate(coordinates.T.tolist())
    ]
    path = tmp_path / "twice.csv"
    header = "point,x_left,y_left,x_right,y_right"
    path.write_text("\n".join([header, *lines]) + "\n")
    out = tmp_path / "out"
    asked = ("--focal", FOCAL, "--sigma", SIGMA, "--elements", "relative", "--out", out)
    done = run("clean", path, *asked)
    told = words(done.stdout + done.stderr)
    assert "2 points repeat another point of the pair (10, 11)" in told
    by_point = {row["point"]: row["verdict"] for row in rows(out / "cleaned.csv")}
    assert by_point["0"] == by_point["10"] == "rejected"
    assert by_point["4"] == by_point["11"] == "kept"
    summary = json.loads((out / "summary.json").read_text())
    assert any("repeat" in warning for warning in summary["warnings"])
