"""Single calls for any number of points: the same results, and few programs."""

from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import problems
import pytest

import jaxro
from jaxro.geometry import mock_pairs
from jaxro.rejection import OUTCOMES, DataSnooping, Recommended

MEASURED = "/jax/core/compile/backend_compile_duration"


@contextmanager
def counted() -> Iterator[list[str]]:
    """Collects an entry for every program that is compiled."""
    found: list[str] = []

    def listen(event: str, duration: float, **_) -> None:
        if event == MEASURED:
            found.append(event)

    jax.monitoring.register_event_duration_secs_listener(listen)
    try:
        yield found
    finally:
        jax.monitoring.unregister_event_duration_listener(listen)


def near_vertical(points: int) -> jaxro.Pair:
    """Points over the whole overlap, with normal errors of .01 mm."""
    x, y = np.random.default_rng(points).uniform((0, -1), (1, 1), (points, 2)).T
    layout = mock_pairs.Layout(tuple(x), tuple(y), (1,) * points)
    heights = 5 * np.cos(7.0 * np.arange(points))
    exact = mock_pairs.mock_pair(layout, heights=heights)
    return mock_pairs.noisy(exact, jax.random.key(points), 0.01).with_sigma(0.01)


def compare(one, other, tolerance: float = 1e-9) -> None:
    """All but the number of steps, in which a program of both starts counts others."""
    steps = lambda o: o.iterations
    same = eqx.tree_at(steps, other, steps(one))
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(same), strict=True):
        np.testing.assert_allclose(a, b, rtol=tolerance, atol=tolerance)


VERTICAL = jaxro.starts.Vertical()


@pytest.mark.parametrize(
    ("points", "start"),
    [
        pytest.param(5, VERTICAL, marks=pytest.mark.slow),
        pytest.param(37, VERTICAL, marks=pytest.mark.slow),
        *(
            pytest.param(n, jaxro.starts.Auto(), marks=pytest.mark.slow)
            for n in (3, 9, 13, 16)
        ),
    ],
)
def test_a_pair_of_any_length_is_that_of_its_own_program(points, start):
    """What is compiled for it alone is the whole of a start, or that from the vertical,
    where `orient` ends."""
    pair = near_vertical(points)
    alone = jaxro.orient(pair)
    assert alone.residuals.shape == (points,)
    expected = problems.jit(partial(jaxro.orient, start=start))(pair)
    assert bool(alone.result == expected.result)
    if not bool(expected.usable):
        assert not bool(alone.usable)
        return
    compare(alone, expected)


def test_a_length_that_is_new_compiles_nothing():
    """Nine to twelve points have twelve places: one program serves them all."""
    jaxro.orient(near_vertical(12))
    data_snooping = DataSnooping()
    data_snooping(near_vertical(12))
    pairs = [near_vertical(points) for points in (9, 10, 11, 12)]
    with counted() as programs:
        for pair in pairs:
            assert jaxro.orient(pair).residuals.shape == pair.x_left.shape
            assert data_snooping(pair).mask.shape == pair.x_left.shape
    assert not programs


@pytest.mark.slow
def test_transformations_without_jit_compile_once():
    pair = near_vertical(12)
    batch = jax.tree.map(lambda a: jnp.stack([a, a]), pair)

    def by(x_left):
        moved = jaxro.pair(
            x_left, *pair.coordinates[1:], focal=pair.focal_left, sigma=pair.sigma
        )
        return jaxro.orient(moved, start=VERTICAL).pose.by

    gradient = jax.grad(by)(pair.x_left)
    orient = lambda pair: jaxro.orient(pair, start=VERTICAL)
    mapped = jax.vmap(orient)(batch)
    with counted() as programs:
        again = jax.grad(by)(pair.x_left)
        compare(jax.vmap(orient)(batch), mapped)
    assert not programs
    np.testing.assert_array_equal(again, gradient)
    h = 1e-4
    moved = pair.x_left.at[3].add(h), pair.x_left.at[3].add(-h)
    slope = (by(moved[0]) - by(moved[1])) / (2 * h)
    np.testing.assert_allclose(gradient[3], slope, rtol=1e-5, atol=1e-9)


@pytest.mark.parametrize(
    "procedure",
    [DataSnooping(), pytest.param(Recommended(), marks=pytest.mark.slow)],
)
def test_a_cleaned_pair_of_any_length_is_that_of_its_own_program(procedure):
    pair = near_vertical(11)
    pair = mock_pairs.plant(pair, y_right=jnp.zeros(11).at[4].set(0.3))
    found = procedure(pair)
    assert found.outcome == OUTCOMES.finished
    assert np.flatnonzero(~np.asarray(found.mask)).tolist() == [4]
    expected = problems.jit(procedure.clean)(pair)
    compare(found.orientation, expected.orientation)
    np.testing.assert_array_equal(found.mask, expected.mask)
    np.testing.assert_array_equal(found.order, expected.order)


def test_an_orientation_shows_its_numbers():
    pair = near_vertical(12)
    shown = str(jaxro.orient(pair, elements=jaxro.DependentElements))
    assert shown.startswith("successful\nby ")
    assert "kappa" in shown
    assert shown.endswith("7 degrees of freedom")
    found = jaxro.orient(pair)
    assert "rotation" in str(found)
    batch = jax.tree.map(lambda a: jnp.stack([a, a]), found)
    assert str(batch) == "2 of 2 pairs usable"
