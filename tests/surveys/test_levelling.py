"""Levelling networks against normal equations of all their legs in plain NumPy, and the
paper's special cases."""

from statistics import NormalDist

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxro
from jaxro.adjustment import Term
from jaxro.surveys import accuracy as accuracy, levelling


def oracle(start, end, rises, q, known, heights):
    """All points and legs at once: heights, their cofactor, corrections v, redundancy
    numbers."""
    a = np.zeros((len(start), len(known)))
    a[np.arange(len(start)), end] += 1
    a[np.arange(len(start)), start] -= 1
    misclosure = rises - a[:, known] @ heights[known]
    a, p = a[:, ~known], 1 / q
    cofactor = np.linalg.inv(a.T @ (p[:, None] * a))
    x = cofactor @ (a.T @ (p * misclosure))
    all_heights = heights.copy()
    all_heights[~known] = x
    return (
        all_heights,
        cofactor,
        a @ x - misclosure,
        1 - np.diag(a @ cofactor @ a.T) * p,
    )


# 0, 1 known; a closed main traverse 0-2-3-4-5-6-7-0, open ones 3-8-9-6, 1-10-5, 1-4
# against its legs' direction, a spur 9-11-12, and a loop 5-13-14-5
START = np.array([0, 2, 3, 4, 5, 6, 7, 3, 8, 9, 10, 5, 4, 9, 11, 5, 13, 14])
END = np.array([2, 3, 4, 5, 6, 7, 0, 8, 9, 6, 1, 10, 1, 11, 12, 13, 14, 5])
KNOWN = np.arange(15) < 2
SPUR = [13, 14]


@pytest.fixture(scope="module")
def measured():
    rng = np.random.default_rng(5)
    true = rng.normal(size=15) * 30
    q = rng.uniform(0.5, 2.0, len(START))
    return true, true[END] - true[START] + rng.normal(size=len(START)) * np.sqrt(q), q


NETWORK = levelling.network(START, END, KNOWN)
solve = jax.jit(
    lambda rises, q, known: levelling.adjust_heights(NETWORK, rises, q, known)
)


def test_traverses_are_the_network_of_all_legs(measured):
    true, rises, q = measured
    heights, cofactor, v, r = oracle(START, END, rises, q, KNOWN, true)
    found = solve(rises, q, true)
    assert found.result == jaxro.adjustment.RESULTS.successful
    np.testing.assert_allclose(found.heights, heights, atol=1e-12)
    np.testing.assert_allclose(
        found.deviations[~KNOWN], np.sqrt(np.diag(cofactor)), atol=1e-12
    )
    assert not np.any(np.asarray(found.deviations)[KNOWN])
    np.testing.assert_allclose(found.corrections, v, atol=1e-12)
    np.testing.assert_allclose(found.leg_redundancy, r, atol=1e-12)
    freedom = len(START) - np.sum(~KNOWN)
    assert int(found.degrees_of_freedom) == freedom
    np.testing.assert_allclose(
        found.sigma0, np.sqrt(np.sum(v**2 / q) / freedom), rtol=1e-12
    )
    # w of every leg is that of its traverse, and so is the error it would show
    legs = np.asarray(NETWORK.leg)
    seen = r > 1e-6
    w = np.zeros(len(START))
    w[legs] = (
        np.asarray(NETWORK.turned) * np.asarray(found.w)[np.asarray(NETWORK.traverse)]
    )
    np.testing.assert_allclose(
        w[seen], (v / np.sqrt(q * np.where(seen, r, 1)))[seen], atol=1e-11
    )
    detectable = np.zeros(len(START))
    detectable[legs] = np.asarray(found.detectable)[np.asarray(NETWORK.traverse)]
    np.testing.assert_allclose(
        detectable[seen], 4.132 * np.sqrt(q[seen] / r[seen]), rtol=1e-3
    )
    assert (
        not seen[SPUR].any() and np.isinf(detectable[SPUR]).all() and not w[SPUR].any()
    )


SMALL = (np.array([0, 2, 3, 2]), np.array([2, 3, 0, 1]))
"""The loop 0-2-3-0 with 2-1; 0, 1 known."""
SMALL_NETWORK = levelling.network(*SMALL, np.arange(4) < 2)
SMALL_MEASURED = (
    np.array([1.0, 2.0, -3.3, -0.2]),
    np.array([1.0, 2.0, 1.5, 1.0]),
    np.array([0.0, 0.5, 0.0, 0.0]),
)
small = jax.jit(
    lambda rises, q, known: levelling.adjust_heights(SMALL_NETWORK, rises, q, known)
)


def test_adjust_itself_gives_the_same_for_all_legs():
    """The full network through the same engine, small enough to be compiled."""
    (start, end), (rises, q, known) = SMALL, SMALL_MEASURED

    def condition(free, observation):
        a, b, rise = observation
        every = jnp.concatenate([jnp.asarray(known[:2]), free])
        return every[b] - every[a] - rise

    observations = jnp.asarray(start), jnp.asarray(end), jnp.asarray(rises)
    cofactor = None, None, jnp.asarray(q)
    solve = lambda o: jaxro.adjust(Term(condition, o, cofactor), jnp.zeros(2))
    full = jax.jit(solve)(observations)
    found = small(rises, q, known)
    np.testing.assert_allclose(found.heights[2:], full.parameters, atol=1e-12)
    np.testing.assert_allclose(
        found.deviations[2:] ** 2, np.diag(full.cofactor), atol=1e-12
    )
    np.testing.assert_allclose(found.leg_redundancy, full.redundancy, atol=1e-12)
    np.testing.assert_allclose(found.sigma0, full.sigma0, rtol=1e-12)


def test_a_traverse_between_two_known_points_gets_its_misclosure_in_proportion():
    """The paper's two-sided traverse: (13) at its middle, and the mean of both sides
    there."""
    n, m = 8, 1.7
    rises = np.random.default_rng(2).normal(size=n) * 10
    known = np.zeros(n + 1)
    known[-1] = rises.sum() + 4.0  # misclosure 4
    net = levelling.network(
        np.arange(n), np.arange(1, n + 1), np.isin(np.arange(n + 1), (0, n))
    )
    found = levelling.adjust_heights(net, rises, m**2, known)
    np.testing.assert_allclose(
        found.heights[1:-1],
        np.cumsum(rises)[:-1] + 4.0 * np.arange(1, n) / n,
        atol=1e-12,
    )
    from_both = np.mean([rises[:4].sum(), known[-1] - rises[4:].sum()])
    np.testing.assert_allclose(found.heights[4], from_both, atol=1e-12)
    np.testing.assert_allclose(
        found.deviations[4], accuracy.middle_deviation(m, n), atol=1e-12
    )
    assert np.argmax(found.deviations) == 4
    np.testing.assert_allclose(np.abs(found.w), 4.0 / (m * np.sqrt(n)), rtol=1e-12)
    np.testing.assert_allclose(found.sigma0, 4.0 / (m * np.sqrt(n)), rtol=1e-12)


def test_a_node_is_the_weighted_mean_of_its_traverses():
    """(14), (15) and (16): traverses of 2, 3 and 5 legs from known heights, weights
    1/n."""
    lengths, m = (2, 3, 5), 0.9
    start, end, known, count = [], [], [True, True, True, False], 4
    for i, n in enumerate(lengths):
        chain = [i, *range(count, count + n - 1), 3]
        count += n - 1
        start, end, known = (
            start + chain[:-1],
            end + chain[1:],
            known + [False] * (n - 1),
        )
    rng = np.random.default_rng(7)
    rises, base = rng.normal(size=len(start)), rng.normal(size=count) * 5
    found = levelling.adjust_heights(
        levelling.network(start, end, known), rises, m**2, base
    )
    each = np.array(
        [
            base[i] + part.sum()
            for i, part in enumerate(np.split(rises, np.cumsum(lengths)[:-1]))
        ]
    )
    weights = 1 / np.array(lengths)
    mean = np.sum(weights * each) / weights.sum()
    np.testing.assert_allclose(found.heights[3], mean, atol=1e-12)
    np.testing.assert_allclose(
        accuracy.weighted_mean(each, np.array(lengths)), mean, atol=1e-12
    )
    np.testing.assert_allclose(
        found.deviations[3], m / np.sqrt(weights.sum()), atol=1e-12
    )
    np.testing.assert_allclose(
        accuracy.node_deviation(m, np.array(lengths)),
        m / np.sqrt(weights.sum()),
        rtol=1e-12,
    )
    mu = np.sqrt(np.sum(weights * (each - mean) ** 2) / 2)
    np.testing.assert_allclose(
        accuracy.unit_weight_deviation(each, np.array(lengths)), mu, rtol=1e-12
    )
    np.testing.assert_allclose(found.sigma0 * m, mu, rtol=1e-12)


def test_a_wrong_leg_is_found_in_its_traverse(measured):
    """5 mm in one leg of 0.5 mm: as often seen as the test promises, and then the
    largest |w| is in its traverse."""
    true, _, _ = measured
    q = np.full(len(START), 0.25)
    draws = 0.5 * np.random.default_rng(11).normal(size=(200, len(START)))
    rises = (true[END] - true[START])[None, :] + draws
    wrong = 8  # of the traverse 3-8-9
    batch = jax.jit(
        jax.vmap(lambda rises: levelling.adjust_heights(NETWORK, rises, q, true))
    )
    found = batch(jnp.asarray(rises + 5.0 * (np.arange(len(START)) == wrong)[None, :]))
    traverse = int(
        NETWORK.traverse[np.flatnonzero(np.asarray(NETWORK.leg) == wrong)[0]]
    )
    w = np.abs(found.w)
    largest = w > np.max(w, axis=1, keepdims=True) - 1e-9
    named = largest[:, traverse] & (
        np.sum(largest, axis=1) == 2
    )  # the spur at 9 checks nothing: 9-6 cannot be told apart
    seen = np.asarray(found.suspicious)[:, traverse]
    size = 5.0 / np.asarray(found.detectable)[0, traverse] * 4.132
    power = NormalDist().cdf(size - 3.29)
    assert (
        abs(np.mean(seen) - power) < 3 * np.sqrt(power * (1 - power) / 200)
        and np.mean(named[seen]) > 0.95
    )
    clean = batch(jnp.asarray(rises))
    tests = np.asarray(clean.w)[:, np.asarray(clean.testable)[0]]
    np.testing.assert_allclose(np.std(tests), 1.0, atol=0.06)
    np.testing.assert_allclose(np.mean(np.asarray(clean.sigma0) ** 2), 1.0, atol=0.12)


def test_derivatives_are_those_of_differences():
    """Of heights, deviations, sigma0 and w, by what is measured, its variances and the
    known heights."""

    def f(rises, q, known):
        found = small(rises, q, known)
        return jnp.concatenate(
            [
                found.heights,
                found.deviations[2:],
                found.sigma0[None],
                found.w,
                found.corrections,
            ]
        )

    at = [jnp.asarray(a) for a in SMALL_MEASURED]
    for derivative in (jax.jacfwd, jax.jacrev):
        for k, found in enumerate(jax.jit(derivative(f, (0, 1, 2)))(*at)):
            step = lambda d, k=k: f(*(a + d if i == k else a for i, a in enumerate(at)))
            differences = np.stack(
                [(step(d) - step(-d)) / 2e-4 for d in 1e-4 * jnp.eye(4)], axis=1
            )
            np.testing.assert_allclose(found, differences, atol=1e-6)


@pytest.mark.parametrize(
    ("legs", "known", "said"),
    [
        ([(0, 1), (1, 1)], [True, False], "ends where it starts"),
        ([(0, 1), (2, 3)], [True, False, False, False], r"\[2, 3\]"),
        ([(0, 1)], [True, True], "all points are known"),
    ],
)
def test_networks_that_determine_nothing_say_so(legs, known, said):
    with pytest.raises(ValueError, match=said):
        levelling.network(*zip(*legs, strict=True), known)
