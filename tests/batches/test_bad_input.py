"""Whatever is given: a result with advice or an exception, and no neighbour in the
batch is touched."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import problems
import pytest
from mock_photos import FOCAL, block, name, outcome, photographed

import jaxro
from jaxro import DependentElements, IndependentElements, RelativePose


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_non_finite_input(bad):
    good = photographed(block(12), sigma=0.01)
    broken = jaxro.pair(
        good.x_left.at[4].set(bad), good.y_left, good.x_right, good.y_right, focal=FOCAL
    )
    found = outcome(broken)
    assert name(found) == "non_finite_input"
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(found))
    without = outcome(good.with_mask(jnp.arange(12) != 4))
    np.testing.assert_allclose(
        found.pose.quaternion, without.pose.quaternion, atol=1e-14
    )


@pytest.mark.parametrize("focal", [0.0, -150.0, np.nan])
def test_impossible_focal_length(focal):
    good = photographed(block(12))
    assert (
        name(outcome(jaxro.pair(*good.coordinates, focal=focal))) == "non_finite_input"
    )


def test_swapped_photos_show_in_the_sign_of_the_base():
    pair = photographed(block(12), sigma=0.005)
    swapped = jaxro.swapped(pair)
    assert name(outcome(pair, elements=DependentElements, base=90.0)) == "successful"
    assert (
        name(outcome(swapped, elements=DependentElements, base=90.0))
        == "photos_swapped"
    )
    assert (
        name(outcome(swapped, elements=DependentElements, base=-90.0)) == "successful"
    )
    assert float(outcome(swapped).pose.bx) < -0.99


@pytest.mark.parametrize("sigma", [0.0, 0.01])
def test_elements_that_do_not_exist_or_are_nothing_but_errors(sigma):
    forward = photographed(
        block(14, depth=(3.0, 6.0)) - [0.5, 0, 0], base=(0.0, 0.0, -1.0), sigma=sigma
    )
    assert name(outcome(forward)) == "successful"
    for options in (
        {"elements": DependentElements, "base": 1.0},
        {"elements": IndependentElements},
    ):
        found = outcome(forward, start=outcome(forward).pose, **options)
        assert name(found) == "elements_undefined"


@pytest.mark.parametrize("count", [5, 6])
def test_elements_at_a_right_angle_do_not_exist_with_or_without_redundancy(count):
    """phi = 90°: omega and kappa turn about the same axis. Five points have no errors
    to tell that by."""
    across = photographed(block(12), turn=(0.0, np.pi / 2, 0.0), base=(3.0, 0.0, 0.0))
    options = {
        "elements": DependentElements,
        "base": 3.0,
        "start": outcome(across).pose,
    }
    few = across.with_mask(jnp.arange(12) < count)
    assert name(outcome(few, **options)) == "elements_undefined"
    assert (
        name(outcome(few, **options | {"elements": RelativePose}))
        == ("successful", "no_redundancy")[count == 5]
    )


def test_nonsense_coordinates_are_not_called_an_orientation():
    rng = np.random.default_rng(8)
    found = outcome(jaxro.pair(*rng.uniform(-100, 100, (4, 20)), focal=FOCAL))
    assert not bool(found.usable)


@pytest.mark.parametrize("size", [1e12, 1e160, 1e280])
def test_numbers_out_of_all_proportion_are_no_measurements(size):
    """Their squares are infinite, and what is divided by them nothing."""
    pair = photographed(block())
    for spoiled in ("x_left", "y_right", "sigma", "focal_right"):
        value = getattr(pair, spoiled)
        value = value.at[3].set(size * 1e20) if value.ndim else value * size * 1e20
        worse = eqx.tree_at(lambda p, spoiled=spoiled: getattr(p, spoiled), pair, value)
        assert name(outcome(worse)) == "non_finite_input"


def test_a_base_that_is_no_length_gives_no_elements():
    pair = photographed(block())
    for base in (0.0, np.nan, np.inf):
        assert (
            name(outcome(pair, elements=DependentElements, base=base))
            == "elements_undefined"
        )
    assert (
        name(outcome(pair, elements=IndependentElements, base=-3.0))
        == "elements_undefined"
    )


@pytest.mark.slow
def test_no_points_at_all():
    assert name(jaxro.orient(jaxro.pair([], [], [], [], focal=1.0))) == "too_few_points"


def test_single_precision_is_adjusted_in_double_or_refused():
    pair = photographed(block(), sigma=0.01)
    single = jax.tree.map(
        lambda a: a if a.dtype == bool else a.astype(jnp.float32), pair
    )
    found = outcome(single)
    assert name(found) == "successful" and found.sigma0.dtype == jnp.float64
    many = jax.tree.map(lambda a: np.asarray(a)[None], single)
    np.testing.assert_allclose(
        jaxro.orient_batch(many, select=lambda o: o.sigma0)[0], found.sigma0, rtol=1e-9
    )
    with jax.enable_x64(False), pytest.raises(ValueError, match="double precision"):
        jaxro.orient(single)


def test_duplicate_points_do_not_make_a_layout():
    """Six rows, but only four different points."""
    found = outcome(photographed(np.concatenate([block(4), block(4)[:2]])))
    assert not bool(found.usable)


def test_wrong_arguments_raise_before_anything_is_traced():
    with pytest.raises(ValueError, match="all four must agree"):
        jaxro.pair([1.0, 2.0], [1.0], [1.0, 2.0], [1.0, 2.0], focal=FOCAL)
    with pytest.raises(ValueError, match="orient_batch"):
        jaxro.orient(jaxro.stack([photographed(block())]))
    with pytest.raises(ValueError, match="batch of pairs"):
        jaxro.orient_batch(photographed(block()))


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (
            lambda x: jaxro.pair(np.ma.array(x, mask=x > 1), x, x, x, focal=1.0),
            "x_left is a masked array",
        ),
        (lambda x: jaxro.pair(x, x, x + 1j, x, focal=1.0), "x_right must be real"),
        (
            lambda x: jaxro.pair(x, x, x, x, focal=(1.0, 2.0, 3.0)),
            r"\(left, right\), got 3",
        ),
        (lambda x: jaxro.pair(x, x, x, x, focal=x), "focal lengths"),
        (lambda x: jaxro.pair(x, x, x, x, focal=1.0, weight=x - 1), "negative"),
        (
            lambda x: jaxro.pair(x, x, x, x, focal=1.0).with_mask([True] * 3),
            r"shape \(3,\), the pair \(4,\)",
        ),
        (
            lambda x: jaxro.stack([jaxro.pair(x, x, x, x, focal=1.0)], points=3),
            "4 points, more than 3",
        ),
        (
            lambda x: jaxro.stack([jaxro.stack([jaxro.pair(x, x, x, x, focal=1.0)])]),
            "single pairs are wanted",
        ),
        (lambda x: jaxro.unstack(jaxro.pair(x, x, x, x, focal=1.0)), "got one pair"),
    ],
)
def test_what_makes_no_pair_is_told(call, message):
    with pytest.raises(ValueError, match=message):
        call(np.arange(4.0))


@pytest.mark.parametrize(
    "points", [8, 64]
)  # some sizes begin where an array can be used without copying it
def test_a_pair_keeps_its_numbers_whatever_becomes_of_the_arrays_it_was_made_of(points):
    given = [np.arange(points) + float(k) for k in range(1, 8)] + [
        np.ones(points, bool)
    ]
    made = jaxro.pair(
        *given[:4], focal=(100.0, 101.0), sigma=given[4], weight=given[5], mask=given[7]
    )
    numpy = jax.tree.map(np.array, made)
    pairs = [
        made,
        made.with_mask(given[7]),
        jaxro.pad(numpy, points),
        jaxro.stack([numpy, made]),
    ]
    pairs += jaxro.unstack(jax.tree.map(lambda a: np.stack([a, a]), numpy))
    before = jax.tree.map(np.array, pairs)
    for array in (*given, *jax.tree.leaves(numpy)):
        array[...] = 0
    jax.tree.map(np.testing.assert_array_equal, pairs, before)
    with pytest.raises(ValueError, match="focal must be a positive"):
        jaxro.Camera(focal=-1.0)


@pytest.mark.slow
def test_failed_pairs_leave_the_derivatives_of_their_neighbours_finite():
    """By a number that all pairs share; what has failed is selected away."""
    good = photographed(block(8), turn=(0.01, 0.02, -0.01), sigma=0.01)
    x, y = good.x_left, good.y_left
    pairs = jaxro.stack(
        [good, jaxro.pair(x, y, x, y, focal=FOCAL), good.with_mask(np.arange(8) < 4)]
    )

    def summed(focal):
        def one(pair):
            new = jaxro.pair(*pair.coordinates, focal=focal, mask=pair.mask)
            found = jaxro.orient(new, start=jaxro.starts.Vertical())
            values = (
                found.cofactor[0, 0],
                found.sigma0,
                found.redundancy[0],
                found.model[2][0],
            )
            values = *values, found.covariance[0, 0], found.deviations[0]
            return jnp.where(found.usable, jnp.stack(values), 0.0)

        return jnp.sum(jax.vmap(one)(pairs), axis=0)

    weights = np.random.default_rng(1).uniform(1, 2, 6)

    @problems.jit
    def derivatives(focal):
        reverse = jax.grad(lambda focal: weights @ summed(focal))(focal)
        return reverse, jax.jvp(summed, (focal,), (jnp.ones(()),))[1]

    reverse, forward = derivatives(jnp.asarray(FOCAL))
    np.testing.assert_allclose(reverse, weights @ forward, rtol=1e-9)
    assert np.all(forward != 0)


def test_elements_that_do_not_exist_have_finite_derivatives():
    def by(base):
        direction = base, jnp.ones(()), jnp.zeros(())
        length = jnp.asarray(70.0)
        rotation = RelativePose(
            *map(jnp.asarray, (1.0, 0.0, 0.0, 0.0)), *direction
        ).relative()[0]
        elements = DependentElements.from_relative(rotation, direction, length)
        return jnp.where(DependentElements.exist(direction, length), elements.by, 0.0)

    assert (
        by(jnp.zeros(())) == 0
        and jax.grad(by)(jnp.zeros(())) == 0
        and jax.grad(by)(jnp.ones(())) == -70
    )


def test_a_number_of_python_in_a_pair_is_one_also_under_a_trace():
    pair = photographed(block(8), sigma=0.01)
    given = eqx.tree_at(lambda p: p.focal_left, pair, FOCAL)
    sigma0 = jax.jit(
        lambda base: (
            jaxro.orient(given, base=base, start=jaxro.starts.Vertical()).sigma0
        )
    )(70.0)
    np.testing.assert_allclose(sigma0, jaxro.orient(pair).sigma0, rtol=1e-9)


def test_results_of_a_batch_say_which():
    pairs = jaxro.stack(
        [photographed(block(12)), photographed(block(12)).with_mask(jnp.arange(12) < 4)]
    )
    found = jaxro.orient_batch(pairs, elements=RelativePose)
    np.testing.assert_array_equal(np.asarray(found.usable), [True, False])
    with pytest.raises(RuntimeError, match="1 of 2"):
        found.check()
