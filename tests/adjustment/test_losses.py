"""Robust losses and standard deviations of single points, against the objective written
out in plain NumPy."""

import jax
import jax.numpy as jnp
import numpy as np
import oracles
import pytest

import jaxro
from jaxro import DependentElements, losses
from jaxro.geometry import mock_pairs
from jaxro.orientation import starts

FOCAL, BASE = 150.0, 90.0
TRUE = np.array([1.2, -0.8, 0.02, -0.01, 0.03])
"""by, bz (mm), omega, phi, kappa"""

WRITTEN_OUT = {
    losses.Huber: lambda s, k: np.where(s <= k**2, s, 2 * k * np.sqrt(s) - k**2),
    losses.SoftL1: lambda s, k: 2 * k**2 * (np.sqrt(1 + s / k**2) - 1),
    losses.Cauchy: lambda s, k: k**2 * np.log(1 + s / k**2),
    losses.GemanMcClure: lambda s, k: s * k**2 / (s + k**2),
    losses.Tukey: lambda s, k: (
        k**2 / 3 * (1 - np.where(s < k**2, 1 - s / k**2, 0) ** 3)
    ),
}


def measured(blunders):
    """Sixteen points with four different standard deviations, errors to match and three
    wrong points."""
    elements = DependentElements(*map(jnp.asarray, TRUE), jnp.asarray(BASE))
    layout = mock_pairs.standard_layout(16)
    heights = mock_pairs.relief(jax.random.key(3), layout, 15.0)
    mock = mock_pairs.mock_pair(
        layout, elements, focal=FOCAL, base=BASE, heights=heights
    )
    sigma = np.tile([0.005, 0.01, 0.02, 0.04], 4)
    errors = np.random.default_rng(8).normal(size=(4, 16)) * sigma
    errors[3, [2, 7, 12]] += blunders
    return np.array([np.asarray(c) for c in mock.coordinates]) + errors, sigma


def objective(rho, coordinates, sigma):
    """Elements -> Σ rho(r²), r = g / (sigma |dg/dl|) with the slopes by complex
    step."""

    def g(elements, coordinates):
        return oracles.condition(
            oracles.dependent(BASE), elements, coordinates, (FOCAL, FOCAL)
        )

    def total(elements):
        slopes = []
        for k in range(4):
            moved = coordinates.astype(complex)
            moved[k] += 1e-20j
            slopes.append(g(elements, moved).imag / 1e-20)
        return np.sum(
            rho(
                (g(elements, coordinates) / sigma) ** 2
                / np.sum(np.square(slopes), axis=0)
            )
        )

    return total


@pytest.mark.parametrize(
    "loss",
    [
        pytest.param(kind, marks=() if kind is losses.Huber else pytest.mark.slow)
        for kind in (None, *WRITTEN_OUT)
    ],
    ids=lambda kind: "squares" if kind is None else kind.__name__,
)
def test_orientation_is_the_minimum_of_the_written_out_objective(loss):
    coordinates, sigma = measured((0.0, 0.0, 0.0) if loss is None else (0.3, -0.2, 0.5))
    rho = (
        (lambda s: s) if loss is None else lambda s: WRITTEN_OUT[loss](s, loss().scale)
    )
    start = DependentElements(*map(jnp.asarray, TRUE), jnp.asarray(BASE))
    pair = jaxro.pair(*coordinates, focal=FOCAL, sigma=sigma)
    found = jaxro.orient(
        pair,
        elements=DependentElements,
        base=BASE,
        loss=None if loss is None else loss(),
        start=start,
    ).check()
    x = np.array(found.elements.values())
    total = objective(rho, coordinates, sigma)
    size = np.array(found.deviations) * 1e-3
    for direction in np.diag(size):
        below, at, above = total(x - direction), total(x), total(x + direction)
        curvature = above - 2 * at + below
        assert (
            curvature > 0
        )  # a minimum, and this near, in standard deviations, to its lowest point:
        assert abs(above - below) / (2 * curvature) * 1e-3 < 1e-5
    if loss in (
        losses.Cauchy,
        losses.GemanMcClure,
        losses.Tukey,
    ):  # those that let go of a wrong point
        squares = jaxro.orient(
            pair, elements=DependentElements, base=BASE, start=start
        ).elements.values()
        assert np.all(np.abs(x - TRUE) < 4 * np.array(found.deviations))
        away = lambda elements: np.sum(
            ((np.array(elements) - TRUE) / np.array(found.deviations)) ** 2
        )
        assert away(x) < 0.1 * away(squares)


@pytest.mark.slow
@pytest.mark.parametrize(
    "loss",
    [
        pytest.param(losses.Cauchy(scale=0.02), marks=pytest.mark.slow),
        losses.GemanMcClure(scale=0.02),
    ],
)
def test_slow_steps_are_gone_to_their_end(loss):
    """Reweighted steps fall by a tenth only where many points are let go: beginning
    again changes nothing."""
    rng = np.random.default_rng(3)
    first, *rest = measured((0.0, 0.0, 0.0))[0]
    disturbed = (
        first + rng.choice([0.0, 0.03], (40, len(first))),
        *(np.broadcast_to(c, (40, len(c))) for c in rest),
    )
    pairs = jaxro.pair(*disturbed, focal=FOCAL)
    orient = jax.jit(
        jax.vmap(lambda pair, start: jaxro.orient(pair, loss=loss, start=start))
    )
    one, zero = jnp.ones(40), jnp.zeros(40)
    vertical = jaxro.RelativePose(one, zero, zero, zero, one, zero, zero)
    once = orient(pairs, vertical)
    again = orient(pairs, once.elements)
    assert np.max(once.iterations) > 25 and np.mean(once.usable) > 0.9
    np.testing.assert_allclose(
        again.sigma0[once.usable], once.sigma0[once.usable], rtol=1e-10
    )


def test_weights_are_standard_deviations():
    coordinates, sigma = measured((0.0, 0.0, 0.0))
    by_sigma, by_weight = (
        jaxro.orient(
            jaxro.pair(*coordinates, focal=FOCAL, **given), start=starts.Vertical()
        )
        for given in ({"sigma": sigma}, {"sigma": 0.01, "weight": (0.01 / sigma) ** 2})
    )
    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-12),
        by_sigma,
        by_weight,
    )


@pytest.mark.parametrize("loss", WRITTEN_OUT)
def test_rho_and_its_slope(loss):
    s = np.concatenate([[0.0], np.logspace(-6, 4, 101)])
    kind = loss()
    written_out = WRITTEN_OUT[loss](
        s.astype(np.longdouble), kind.scale
    )  # its differences lose digits
    np.testing.assert_allclose(
        kind.rho(jnp.asarray(s)), written_out.astype(float), rtol=1e-12, atol=1e-15
    )
    step = 1e-6 * (s + 1e-3)
    slope = (
        WRITTEN_OUT[loss](s + step, kind.scale)
        - WRITTEN_OUT[loss](np.abs(s - step), kind.scale)
    ) / (2 * step)
    np.testing.assert_allclose(kind.weight(jnp.asarray(s))[1:], slope[1:], atol=1e-6)
    # what is minimised is r near zero, to the last digits
    r = jnp.asarray(np.logspace(-12, -6, 25) * kind.scale)
    value, slope = jax.vmap(jax.value_and_grad(kind.transform))(r)
    np.testing.assert_allclose(value, r, rtol=1e-11)
    np.testing.assert_allclose(slope, 1.0, rtol=1e-11)
