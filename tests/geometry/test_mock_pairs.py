"""Mock pairs against their own definition, judged by the NumPy oracle."""

import jax
import jax.numpy as jnp
import numpy as np
import oracles
import problems
import pytest

from jaxro import DependentElements, IndependentElements, RelativePose
from jaxro.geometry import mock_pairs
from jaxro.geometry.mock_pairs import (
    mock_pair,
    noisy,
    plant,
    random_pairs,
    relief,
    row_layout,
    standard_layout,
)


def test_layouts_are_those_of_the_papers():
    assert standard_layout(16).zone == (1, 2, 3, 4, 5, 6, 3, 4, 5, 6, 1, 2, 4, 3, 5, 1)
    assert standard_layout(8).x == (0, 1, 0, 1, 0, 1, 0, 1)
    assert standard_layout(8).y == (0, 0, 1, 1, -1, -1, 1, 1)
    rows = row_layout()
    assert [i + 1 for i, zone in enumerate(rows.zone) if zone == 1] == [7, 9]
    assert [i + 1 for i, zone in enumerate(rows.zone) if zone == 2] == [8, 10]
    assert set(rows.x[::2]) == {0.0} and set(rows.x[1::2]) == {1.0}
    assert {len(layout.x) for layout in mock_pairs.STANDARD_LAYOUTS.values()} == {
        6,
        7,
        8,
        9,
        10,
        16,
    }
    for wrong in (5, 17):
        with pytest.raises(ValueError, match="6 to 16"):
            standard_layout(wrong)


def test_vertical_flat_pair_has_the_written_coordinates():
    x, y, x_right, y_right = problems.arrays(
        mock_pair(standard_layout(6), focal=100.0, base=60.0, y_range=(80.0, 50.0))
    )
    np.testing.assert_allclose(x, [0, 60, 0, 60, 0, 60], atol=1e-12)
    np.testing.assert_allclose(y, [0, 0, 80, 80, -50, -50], atol=1e-12)
    np.testing.assert_allclose(x_right, x - 60, atol=1e-12)
    np.testing.assert_allclose(y_right, y, atol=1e-12)


def test_height_is_the_papers_parallax_difference():
    """h = H dp / (b + dp)."""
    heights = np.array([0.0, 5.0, -3.0, 10.0, 0.0, 2.0])
    x, _, x_right, _ = problems.arrays(mock_pair(standard_layout(6), heights=heights))
    dp = (x - x_right) - 70.0
    np.testing.assert_allclose(70.0 * dp / (70.0 + dp), heights, atol=1e-12)


@pytest.mark.parametrize(
    "layout", mock_pairs.STANDARD_LAYOUTS.values(), ids=mock_pairs.STANDARD_LAYOUTS
)
def test_elements_satisfy_the_condition(layout):
    key = jax.random.key(1)
    heights = relief(key, layout, 6.0)
    values = np.array([0.05, -0.3, 0.04, -0.02, 0.6])
    made = mock_pair(
        layout, IndependentElements(*map(jnp.asarray, values)), heights=heights
    )
    assert (
        np.max(np.abs(oracles.y_parallax(values, problems.arrays(made), 70.0))) < 1e-12
    )

    values = np.array([3.0, -2.0, 0.04, -0.02, 0.1])
    made = mock_pair(
        layout, DependentElements(*map(jnp.asarray, (*values, 70.0))), heights=heights
    )
    g = oracles.condition(
        oracles.dependent(70.0), values, problems.arrays(made), (70.0, 70.0)
    )
    assert np.max(np.abs(g)) < 1e-9


def test_base_may_point_backwards():
    """Strips flown along -x: base (-1, 0, 0), points still between the photos."""
    backwards = RelativePose(*map(jnp.asarray, (1.0, 0.0, 0.0, 0.0, -1.0, 0.0, 0.0)))
    x, _, x_right, _ = problems.arrays(mock_pair(standard_layout(6), backwards))
    np.testing.assert_allclose(x - x_right, -70.0, atol=1e-12)


def test_noise_is_seeded_and_has_its_sigma():
    flat = mock_pair(row_layout())
    keys = jax.random.split(jax.random.key(0), 2000)
    many = jax.vmap(noisy, in_axes=(None, 0, None))(flat, keys, 0.01)
    errors = np.stack(
        [
            np.asarray(m - f[None])
            for m, f in zip(many.coordinates, flat.coordinates, strict=True)
        ]
    )
    assert errors.shape == (4, 2000, 16)
    assert abs(errors.std() / 0.01 - 1) < 0.01 and abs(errors.mean()) < 1e-4
    again = noisy(flat, keys[3], 0.01)
    np.testing.assert_array_equal(again.y_right, many.y_right[3])


def test_planted_errors_go_where_they_are_sent():
    flat = mock_pair(standard_layout(8)).with_mask(jnp.arange(8) < 7)
    wrong = plant(flat, y_right=np.array([0, 0, 0, 0, 0, 0, 1.5, 2.0]), x_left=0.1)
    np.testing.assert_allclose(
        wrong.y_right - flat.y_right, [0, 0, 0, 0, 0, 0, 1.5, 0], atol=1e-14
    )
    np.testing.assert_allclose(wrong.x_left - flat.x_left, [0.1] * 7 + [0], atol=1e-14)
    np.testing.assert_array_equal(wrong.x_right, flat.x_right)


def test_random_pairs_are_true_and_anywhere():
    made = jax.jit(lambda key: random_pairs(key, 300, 9, focal=100.0))
    pairs, poses = made(jax.random.key(5))
    poses = jax.tree.map(np.asarray, poses)
    coordinates = np.stack([np.asarray(c) for c in pairs.coordinates])
    assert coordinates.shape == (4, 300, 9)
    turns, bases = [], []
    for i in range(300):
        r, b = problems.rotation_base(jax.tree.map(lambda field, i=i: field[i], poses))
        ray1 = oracles.vectors(*coordinates[:2, i], 100.0)
        ray2 = oracles.vectors(*coordinates[2:, i], 100.0) @ r.T
        for p, q in zip(ray1, ray2, strict=True):
            (s, t), *_ = np.linalg.lstsq(np.stack([p, -q], axis=1), b, rcond=None)
            assert s > 0 and t > 0
            assert 2 - 1e-6 < s * np.linalg.norm(p) < 10 + 1e-6
            assert np.linalg.norm(s * p - b - t * q) < 1e-9
        turns.append(oracles.angle(r))
        bases.append(b)
    assert np.max(turns) > 3.0 and np.min(turns) < 0.7
    assert np.all(np.ptp(np.array(bases), axis=0) > 1.8)


def test_random_pairs_refuse_points_that_may_lie_behind():
    with pytest.raises(ValueError, match="nearest >= 2"):
        random_pairs(jax.random.key(0), 2, 8, depth=(1.0, 5.0))
