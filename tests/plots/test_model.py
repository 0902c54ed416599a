"""Pictures of the model of a pair: covariances, ellipses, heights."""

import jax
import numpy as np
import pytest

import jaxro
from jaxro import mock_pairs as mock, plots
from jaxro.plots.ellipses import confidence_radius, draw_ellipses

pytest.importorskip("matplotlib")
from matplotlib.collections import LineCollection

SIGMA = 0.01


@pytest.mark.parametrize(
    ("system", "correlated"),
    [
        (jaxro.RelativePose, False),
        pytest.param(jaxro.DependentElements, True, marks=pytest.mark.slow),
    ],
    ids=["relative", "dependent-correlated"],
)
def test_covariances_of_the_model_follow_from_all_coordinates(system, correlated):
    """C = J Q Jᵀ, J of the whole orientation by each coordinate of each point from
    differences, at errorless points: nothing of the formula for a single point."""
    layout = mock.standard_layout(8)
    exact = mock.mock_pair(layout, heights=mock.relief(jax.random.key(2), layout, 8.0))
    own, spread = np.eye(4) * SIGMA**2, np.array([[4.0, 1.0], [1.0, 2.0]]) * SIGMA**2
    how = {"focal": 70.0, "sigma": SIGMA}
    if correlated:
        own = np.kron(np.eye(2), spread)
        how = {"focal": 70.0, "covariances": (spread, spread)}
    at = np.stack([np.asarray(c) for c in exact.coordinates])

    def orient(coordinates):
        pair = jaxro.pair(*coordinates, **how)
        return pair, jaxro.orient(pair, elements=system, base=70.0)

    def model(k, i, step):
        moved = at.copy()
        moved[k, i] += step
        return np.stack([np.asarray(c) for c in orient(moved)[1].model], axis=-1)

    step = 1e-3
    j = np.stack(
        [
            (model(k, i, step) - model(k, i, -step)) / (2 * step)
            for k in range(4)
            for i in range(8)
        ]
    ).reshape(4, 8, 8, 3)  # coordinate, moved point, model point, axis
    expected = np.einsum("cipa,cd,dipb->pab", j, own, j)
    found = plots.model_covariances(*orient(at), sigma0=1.0)
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-11)


def test_ellipses_have_the_axes_of_the_covariance():
    """Outlines of standard ellipses: the longest and the shortest radius are the roots
    of the eigenvalues; the radius holds 95 % of simulated places."""
    covariance = np.array([[[4.0, 1.5], [1.5, 1.0]]])
    drawn = draw_ellipses(
        plots.new_figure().subplots(), np.array([[10.0, 20.0]]), covariance, 3.0
    )
    assert isinstance(drawn, LineCollection)
    (line,) = drawn.get_segments()
    radii = np.hypot(*(line - [10.0, 20.0]).T)
    roots = np.sqrt(np.linalg.eigvalsh(covariance[0]))
    assert radii.max() == pytest.approx(3 * roots[1], rel=1e-9)
    assert radii.min() == pytest.approx(3 * roots[0], rel=1e-9)
    rng = np.random.default_rng(4)
    places = rng.multivariate_normal([0, 0], covariance[0], 100_000)
    size = np.sqrt(np.sum(places @ np.linalg.inv(covariance[0]) * places, axis=1))
    assert np.mean(size < confidence_radius(0.95, None)) == pytest.approx(
        0.95, abs=3e-3
    )
    estimated = np.sqrt(rng.chisquare(6, 100_000) / 6)
    inside = np.mean(size / estimated < confidence_radius(0.95, 6))
    assert inside == pytest.approx(0.95, abs=3e-3)


def test_the_model_is_drawn_in_its_places():
    layout = mock.row_layout()
    exact = mock.mock_pair(layout, heights=mock.relief(jax.random.key(1), layout, 5.0))
    pair = mock.noisy(exact, jax.random.key(0), SIGMA).with_sigma(SIGMA)
    orientation = jaxro.orient(pair)
    given = plots.new_figure().subplots(1, 2)
    left, right = drawn = plots.draw_model(pair, orientation, unit="bases", axes=given)
    assert drawn is given
    x, y, _ = (np.asarray(c) for c in orientation.model)
    np.testing.assert_allclose(left.lines[0].get_xydata(), np.stack([x, y], axis=-1))
    (outlines,) = [c for c in left.collections if isinstance(c, LineCollection)]
    centres = [np.mean(line[:-1], axis=0) for line in outlines.get_segments()]
    np.testing.assert_allclose(centres, np.stack([x, y], axis=-1), atol=1e-9)
    covariances = plots.model_covariances(pair, orientation)
    told = {float(text.get_text()) for text in right.texts}
    deviations = np.sqrt(covariances[:, 2, 2])
    assert told and told <= {float(f"{s:.2g}") for s in deviations}
    assert left.get_xlabel() == "X [bases]" and "95 %" in left.get_title()
