"""Orientations as data sets: names, dimensions, units, values."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxro
from jaxro.exchange import to_xarray
from jaxro.geometry import mock_pairs

pytest.importorskip("xarray")


@pytest.fixture(scope="module")
def oriented():
    layout = mock_pairs.standard_layout(8)
    flat = mock_pairs.mock_pair(layout)
    pair = mock_pairs.noisy(flat, jax.random.key(0), 0.01)
    return jaxro.orient(pair, elements=jaxro.DependentElements, base=70.0)


def test_a_batch(oriented):
    failed = replace(oriented, result=jaxro.RESULTS.diverged)
    batch = jax.tree.map(lambda *a: jnp.stack(a), oriented, failed)
    points = [f"p{k}" for k in range(8)]
    found = to_xarray(batch, pairs=["a", "b"], points=points, unit="mm")
    assert dict(found.sizes) == {
        "pair": 2,
        "element": 5,
        "element2": 5,
        "point": 8,
        "axis": 3,
        "wxyz": 4,
    }
    assert found.attrs == {"system": "DependentElements"}
    assert found.parallax.attrs["units"] == found.m_q.attrs["units"] == "mm"
    units = dict(zip(found.element.values, found.element_unit.values, strict=True))
    assert units["by"] == "base" and units["omega"] == "rad"
    at = found.sel(pair="a")
    expected = float(oriented.elements.omega)
    assert float(at.elements.sel(element="omega")) == expected
    value = at.covariance.sel(element="by", element2="omega")
    assert float(value) == pytest.approx(float(oriented.covariance[0, 2]))
    q = at.parallax.sel(point="p3")
    assert float(q) == float(oriented.parallax[3])
    assert np.all(np.isnan(found.elements.sel(pair="b")))
    assert list(found.result.values) == ["successful", "diverged"]
    assert list(found.usable.values) == [True, False]


def test_a_single_pair(oriented):
    found = to_xarray(oriented, pairs=["only"])
    assert "pair" not in found.sizes and str(found.pair.values) == "only"
    np.testing.assert_array_equal(found.deviation, oriented.deviations)
    with pytest.raises(ValueError, match="3 names of 8 points"):
        to_xarray(oriented, points=["a", "b", "c"])
    nested = jax.tree.map(lambda a: a[None, None], oriented)
    with pytest.raises(ValueError, match="one leading axis"):
        to_xarray(nested)
