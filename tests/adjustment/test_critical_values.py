"""Critical values against SciPy and published tables."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxro.adjustment import critical_values as critical

stats = pytest.importorskip("scipy.stats")

LEVELS = np.array([0.5, 0.2, 0.1, 0.05, 0.01, 1e-3, 1e-4, 1e-6, 1e-9])
FREEDOMS = np.array([1.0, 2.0, 3.0, 4.0, 7.0, 11.0, 30.0, 100.0, 1000.0, 1e5])
GRID = [a.ravel() for a in np.meshgrid(LEVELS, FREEDOMS)]


def test_normal():
    np.testing.assert_allclose(
        critical.normal(LEVELS), stats.norm.isf(LEVELS / 2), rtol=1e-12
    )
    np.testing.assert_allclose(critical.normal(1.0), 0.0, atol=1e-15)
    np.testing.assert_allclose(
        critical.normal(0.001), 3.2905, atol=5e-5
    )  # Baarda's usual limit


def test_student():
    # x = f / (f + t²) is found to 1e-18: few digits are left of it where t is 1e6 and
    # more
    level, freedom = (a[(GRID[1] > 1) | (GRID[0] > 1e-5)] for a in GRID)
    np.testing.assert_allclose(
        critical.student(level, freedom),
        stats.t.isf(level, freedom),
        rtol=1e-8,
        atol=1e-8,
    )


def test_chi_squared():
    level, freedom = GRID
    np.testing.assert_allclose(
        critical.chi_squared(level, freedom), stats.chi2.isf(level, freedom), rtol=1e-9
    )
    level, freedom = (
        a.ravel()
        for a in np.meshgrid([1e-20, 1e-50, 1e-100, 0.999], [1.0, 5.0, 1000.0])
    )
    np.testing.assert_allclose(
        critical.chi_squared(level, freedom), stats.chi2.isf(level, freedom), rtol=1e-9
    )


def test_chi_squared_bounds():
    level, freedom = GRID
    low, high = critical.chi_squared_bounds(level, freedom)
    np.testing.assert_allclose(low, stats.chi2.ppf(level / 2, freedom), rtol=1e-9)
    np.testing.assert_allclose(high, stats.chi2.isf(level / 2, freedom), rtol=1e-9)


def test_fisher():
    level, above, below = (a.ravel() for a in np.meshgrid(LEVELS, FREEDOMS, FREEDOMS))
    # the incomplete beta function keeps seven digits where F is beyond 1e6
    level, above, below = (
        a[(below > 2) | (level > 1e-5)] for a in (level, above, below)
    )
    np.testing.assert_allclose(
        critical.fisher(level, above, below),
        stats.f.isf(level, above, below),
        rtol=1e-7,
    )
    level, freedom = (a[GRID[1] > 2] for a in GRID)
    np.testing.assert_allclose(
        critical.fisher(level, 1, freedom),
        critical.student(level / 2, freedom) ** 2,
        rtol=1e-8,
    )


def test_sidak():
    np.testing.assert_allclose(
        critical.sidak(0.05, np.array([1, 8, 1e6])),
        [0.05, 0.006391150774, 5.1293291e-8],
        rtol=1e-6,
    )
    np.testing.assert_allclose(
        1 - (1 - critical.sidak(LEVELS, 16)) ** 16, LEVELS, rtol=1e-6
    )


DELTAS = np.array([0.0, 0.3, 2.0, 4.13, 8.0, 30.0])


@pytest.mark.parametrize("limit", [0.1, 1.0, 5.0, 11.0, 40.0, 200.0, 1100.0])
def test_non_central_chi_squared(limit):
    freedom, delta = (a.ravel() for a in np.meshgrid(FREEDOMS, DELTAS))
    expected = stats.ncx2.sf(limit, freedom, np.maximum(delta**2, 1e-13))
    np.testing.assert_allclose(
        critical.chi_squared_power(limit, freedom, delta), expected, atol=1e-11
    )


@pytest.mark.parametrize("limit", [0.5, 2.0, 3.3, 8.0, 31.0, 636.0])
def test_non_central_student(limit):
    freedom, delta = (
        a.ravel() for a in np.meshgrid(FREEDOMS[:-1], np.append(DELTAS, [60.0, 700.0]))
    )
    expected = stats.nct.sf(limit, freedom, delta) + stats.nct.cdf(
        -limit, freedom, delta
    )
    known = np.isfinite(expected)  # SciPy has none far out
    assert np.mean(known) > 0.6
    found = np.asarray(critical.student_power(limit, freedom, delta))
    np.testing.assert_allclose(found[known], expected[known], atol=1e-9)
    assert (
        np.all(np.isfinite(found))
        and np.all(found > -1e-9)
        and np.all(found < 1 + 1e-9)
    )


def test_delta_is_found_with_the_promised_power():
    """Against SciPy's distributions, and Baarda's tabulated 4.13 (level 0.001, power
    0.80) and 2.80 (0.05, 0.80)."""
    np.testing.assert_allclose(
        critical.delta_normal(np.array([0.001, 0.05]), 0.8), [4.13, 2.80], atol=5e-3
    )
    level, power = (
        a.ravel() for a in np.meshgrid([0.3, 0.05, 1e-3, 1e-6], [0.5, 0.8, 0.95, 0.999])
    )
    delta = np.asarray(critical.delta_normal(level, power))
    np.testing.assert_allclose(
        stats.ncx2.sf(stats.chi2.isf(level, 1), 1, delta**2), power, rtol=1e-9
    )
    for freedom in (1.0, 2.0, 11.0, 300.0):
        delta = np.asarray(critical.delta_chi_squared(level, power, freedom))
        np.testing.assert_allclose(
            stats.ncx2.sf(stats.chi2.isf(level, freedom), freedom, delta**2),
            power,
            rtol=1e-9,
        )
    np.testing.assert_allclose(
        critical.delta_student(level, power, 1e5),
        critical.delta_normal(level, power),
        rtol=1e-3,
    )
    for freedom in (5.0, 11.0, 100.0):
        delta = np.asarray(critical.delta_student(0.001, 0.8, freedom))
        t = stats.t.isf(0.0005, freedom)
        np.testing.assert_allclose(stats.nct.sf(t, freedom, delta), 0.8, rtol=1e-8)


def test_b_method_has_the_power_of_the_single_test():
    freedom = np.array([1.0, 2.0, 11.0, 100.0, 1000.0])
    level = np.asarray(critical.b_method(0.001, 0.8, freedom))
    delta = float(critical.delta_normal(0.001, 0.8))
    np.testing.assert_allclose(
        stats.ncx2.sf(stats.chi2.isf(level, freedom), freedom, delta**2), 0.8, rtol=1e-9
    )
    np.testing.assert_allclose(level[0], 0.001, rtol=1e-9)


def test_tau_is_a_beta_quantile():
    """tau² / f ~ Beta(1/2, (f - 1)/2); never above sqrt(f)."""
    level, freedom = (a[GRID[1] > 1] for a in GRID)
    value = np.asarray(critical.tau(level, freedom))
    np.testing.assert_allclose(
        value**2 / freedom,
        stats.beta.isf(level, 0.5, (freedom - 1) / 2),
        rtol=1e-8,
        atol=1e-12,
    )
    assert np.all(value <= np.sqrt(freedom)) and np.isinf(critical.tau(0.05, 1))


def test_tau_of_many_degrees_is_normal():
    np.testing.assert_allclose(
        critical.tau(LEVELS, 1e6), critical.normal(LEVELS), rtol=1e-4
    )


# one-sided 5 % and 1 %, S over n - 1 (Grubbs 1969; ISO 5725-2)
PUBLISHED = {
    3: (1.153, 1.155),
    6: (1.822, 1.944),
    10: (2.176, 2.410),
    16: (2.443, 2.747),
    30: (2.745, 3.103),
}


@pytest.mark.parametrize("count", PUBLISHED)
def test_grubbs_is_the_published_table(count):
    found = np.array([critical.grubbs(level, count) for level in (0.05, 0.01)])
    np.testing.assert_allclose(
        found * np.sqrt((count - 1) / count), PUBLISHED[count], atol=6e-4
    )


def test_grubbs():
    level, count = (a[GRID[1] > 2] for a in GRID)
    t = stats.t.isf(level / count, count - 2)
    # with S over n, the largest possible value is sqrt(n - 1)
    expected = np.sqrt((count - 1) * t**2 / (count - 2 + t**2))
    np.testing.assert_allclose(critical.grubbs(level, count), expected, rtol=1e-8)
    assert np.all(np.isinf(critical.grubbs(0.05, np.array([0.0, 1.0, 2.0]))))


def test_grubbs_keeps_its_level_in_normal_samples():
    sample = np.random.default_rng(5).normal(size=(200_000, 8))
    v = (np.mean(sample, axis=1) - np.min(sample, axis=1)) / np.std(sample, axis=1)
    rate = np.mean(v > float(critical.grubbs(0.05, 8)))
    assert abs(rate - 0.05) < 3 * np.sqrt(0.05 * 0.95 / 200_000), rate


def test_by_count_looks_up_what_it_would_calculate():
    value = lambda n: critical.grubbs(0.05, n)
    counts = jnp.arange(17.0)
    looked_up = jax.jit(jax.vmap(lambda n: critical.by_count(value, 16, n)))
    np.testing.assert_array_equal(looked_up(counts), value(counts))


@pytest.mark.parametrize("most", [64, 10_000])
def test_long_pairs_get_their_critical_values_from_a_short_table(most):
    values = {
        "grubbs": lambda n: critical.grubbs(0.05, n),
        "normal": lambda n: critical.normal(0.01 / jnp.maximum(n, 1.0)),
        "tau": lambda n: critical.tau(critical.sidak(0.05, n), jnp.maximum(n - 5, 2.0)),
        "delta": lambda n: critical.delta_student(0.001, 0.8, jnp.maximum(n - 6, 1.0)),
        "chi squared": lambda n: critical.chi_squared(0.05, jnp.maximum(n - 5, 1.0)),
    }
    count = jnp.asarray(
        np.unique(
            np.minimum(
                [17, 63, 64, 65, 66, 67.0, 71, 99, 399, 3333, 9999, 10_000], most
            )
        )
    )
    assert critical.counts(most).size < 310
    for name, value in values.items():
        looked_up = jax.vmap(lambda n, value=value: critical.by_count(value, most, n))(
            count
        )
        np.testing.assert_allclose(looked_up, value(count), rtol=1e-8, err_msg=name)


def test_values_under_jit_are_the_same():
    level, freedom = jnp.asarray(0.01), jnp.asarray(11.0)
    for function in (critical.tau, critical.chi_squared, critical.grubbs):
        np.testing.assert_allclose(
            jax.jit(function)(level, freedom), function(level, freedom), rtol=1e-12
        )


def test_a_sigma0_within_chance_is_not_trusted():
    sigma0 = np.array([2.0, 2.0, 0.3, np.nan, 1.05])
    found = critical.trusted_sigma0(sigma0, np.array([2, 40, 40, 0, 1000]))
    np.testing.assert_array_equal(found, [1.0, 2.0, 1.0, 1.0, 1.0])
