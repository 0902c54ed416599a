"""The adjustment of the papers of 1971 and 1989, on which their procedures judge.

The residual y-parallaxes q are taken as measured with equal weights, and the five
independent elements minimise Σ q² (Dorozhinsky 1971). The iteration begins with zero
elements, which suits near-vertical photos.
"""

from collections.abc import Callable

import jax.numpy as jnp
from jaxtyping import Array, Bool

from ..adjustment.normal_equations import steps
from ..adjustment.residuals import Residuals
from ..geometry import coplanarity
from ..geometry.elements import AbstractElements, IndependentElements
from ..geometry.pairs import Pair, mask_unusable
from ..orientation.orient import Orientation, orient
from .base import PointValues, Rejection
from .rounds import (
    Round,
    conclude_round,
    element_values,
    finished_if,
    keep_at_least,
)


def zero_elements(pair: Pair) -> IndependentElements:
    """The elements of photos that are parallel to the base and to each other."""
    zero = jnp.zeros_like(pair.focal_left)
    return IndependentElements(zero, zero, zero, zero, zero)


def adjust_parallaxes(
    pair: Pair,
    mask: Bool[Array, "point"],
    start: AbstractElements | None = None,
    max_steps: int = 30,
) -> Orientation:
    """The converged solution for the points in use, from zero elements if no start is
    given."""
    return orient(
        _equally_accurate(pair).with_mask(mask),
        elements=IndependentElements,
        residual=coplanarity.parallax,
        start=zero_elements(pair) if start is None else start,
        max_steps=max_steps,
    )


def iterate_once(
    pair: Pair, mask: Bool[Array, "point"], elements: AbstractElements
) -> AbstractElements:
    """The elements after one iteration of this adjustment."""
    residuals = parallax_residuals(pair, mask, elements)
    moved = steps(residuals, elements.origin, 1, float("inf"))
    return elements.move(moved)


def parallaxes(
    pair: Pair, mask: Bool[Array, "point"], elements: AbstractElements
) -> PointValues:
    """q of the points in use at given elements; zero of all others."""
    residuals = parallax_residuals(pair, mask, elements)
    return residuals()


def parallax_residuals(
    pair: Pair, mask: Bool[Array, "point"], elements: AbstractElements
) -> Residuals:
    """q of the points in use as a function of a displacement of the elements."""
    term = coplanarity.parallax(_equally_accurate(pair).with_mask(mask))
    return Residuals(term, elements)


def _equally_accurate(pair: Pair) -> Pair:
    """The pair with unit weights, as in the papers. Raises ValueError for a pair whose
    coordinates have covariances."""
    if pair.roots is not None:
        raise ValueError(
            "this procedure adjusts y-parallaxes of unit weight and cannot use the "
            "covariances of the pair: use `recommended` or `data-snooping`, or make the "
            "pair without covariances"
        )
    return pair.with_sigma(1.0)


def reject_once(
    pair: Pair,
    judge: Callable[[Pair, Orientation], tuple[PointValues, Array, Array]],
    more_than: int,
    least: int,
) -> Rejection:
    """One solution, one judgement of all points, and the solution of those kept.

    judge(pair, solution) -> (statistic, limit, points to reject). Pairs of at most
    `more_than` points have nothing to test; at least `least` points stay, those of
    largest |q| go first.
    """
    pair = mask_unusable(pair)[0]
    solved = adjust_parallaxes(pair, pair.mask)
    statistic, limit, wrong = judge(pair, solved)
    enough = pair.count > more_than
    size = jnp.abs(solved.parallax)
    wrong = keep_at_least(least, pair.mask & wrong & enough, size, pair.mask)
    only = Round(
        statistic=statistic,
        limit=limit,
        rejected=wrong,
        parallax=solved.parallax,
        elements=element_values(solved.elements),
    )
    final = adjust_parallaxes(pair, pair.mask & ~wrong, solved.elements)
    return conclude_round(pair, only, final, finished_if(enough))
