"""Critical values against SciPy and published tables."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxro import critical_values as critical

stats = pytest.importorskip("scipy.stats")

LEVELS = np.array([0.5, 0.2, 0.1, 0.05, 0.01, 1e-3, 1e-4, 1e-6, 1e-9])
FREEDOMS = np.array([1.0, 2.0, 3.0, 4.0, 7.0, 11.0, 30.0, 100.0, 1000.0, 1e5])
GRID = [a.ravel() for a in np.meshgrid(LEVELS, FREEDOMS)]


def test_normal():
    np.testing.assert_allclose(critical.normal(LEVELS), stats.norm.isf(LEVELS / 2), rtol=1e-12)
    np.testing.assert_allclose(critical.normal(1.0), 0.0, atol=1e-15)
    np.testing.assert_allclose(critical.normal(0.001), 3.2905, atol=5e-5)  # Baarda's usual limit


def test_student():
    # x = f / (f + t²) is found to 1e-18: few digits are left of it where t is 1e6 and more
    level, freedom = (a[(GRID[1] > 1) | (GRID[0] > 1e-5)] for a in GRID)
    np.testing.assert_allclose(critical.student(level, freedom), stats.t.isf(level, freedom), rtol=1e-8, atol=1e-8)


def test_chi_squared():
    level, freedom = GRID
    np.testing.assert_allclose(critical.chi_squared(level, freedom), stats.chi2.isf(level, freedom), rtol=1e-9)


def test_tau_is_a_beta_quantile():
    """tau² / f ~ Beta(1/2, (f - 1)/2); never above sqrt(f)."""
    level, freedom = (a[GRID[1] > 1] for a in GRID)
    value = np.asarray(critical.tau(level, freedom))
    np.testing.assert_allclose(value**2 / freedom, stats.beta.isf(level, 0.5, (freedom - 1) / 2), rtol=1e-8, atol=1e-12)
    assert np.all(value <= np.sqrt(freedom)) and np.isinf(critical.tau(0.05, 1))


def test_tau_of_many_degrees_is_normal():
    np.testing.assert_allclose(critical.tau(LEVELS, 1e6), critical.normal(LEVELS), rtol=1e-4)


# one-sided 5 % and 1 %, S over n - 1 (Grubbs 1969; ISO 5725-2)
PUBLISHED = {3: (1.153, 1.155), 6: (1.822, 1.944), 10: (2.176, 2.410), 16: (2.443, 2.747), 30: (2.745, 3.103)}


@pytest.mark.parametrize("count", PUBLISHED)
def test_grubbs_is_the_published_table(count):
    found = np.array([critical.grubbs(level, count) for level in (0.05, 0.01)])
    np.testing.assert_allclose(found * np.sqrt((count - 1) / count), PUBLISHED[count], atol=6e-4)


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


def test_values_under_jit_are_the_same():
    level, freedom = jnp.asarray(0.01), jnp.asarray(11.0)
    for function in (critical.tau, critical.chi_squared, critical.grubbs):
        np.testing.assert_allclose(jax.jit(function)(level, freedom), function(level, freedom), rtol=1e-12)
