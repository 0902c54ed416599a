"""An orientation in other elements: what a search has solved as a pose, in the system
that is asked for."""

import dataclasses

import jax.numpy as jnp
from jaxtyping import ArrayLike

from ..geometry.elements import AbstractElements, RelativePose
from ..geometry.intersection import model_point
from ..geometry.pairs import Pair, mask_unusable
from ..xla.passes import pointwise
from . import chosen_elements
from .result import Orientation
from .results import RESULTS, is_usable
from .verdict import lack_elements, largest_variance, noise_of


def express(
    pair: Pair,
    orientation: Orientation,
    system: type[AbstractElements],
    base: ArrayLike | None = None,
) -> Orientation:
    """The orientation of a pair in the elements that `orient(pair, elements=system,
    base=base)` gives: with their cofactors, the model in their frame and scale, and the
    result where there are no such elements."""
    if system is RelativePose and isinstance(orientation.elements, RelativePose):
        return orientation
    pair, pose = mask_unusable(pair)[0], orientation.pose
    length = chosen_elements.length(pair, system, base, pose)
    flipped = jnp.zeros_like(pose.bx, bool)
    elements, cofactor = chosen_elements.in_system(
        orientation.elements, orientation.cofactor, flipped, system, length
    )
    noise, _ = noise_of(pair, orientation)
    scale = system.scale((pose.bx, pose.by, pose.bz), length)
    meet = model_point(pair, pose, elements, scale, noise.size)
    points = pair.coordinates, pair.sigma, pair.mask, pair.roots
    model, *_ = pointwise(meet, *points)
    weakest = largest_variance(orientation.elements, orientation.cofactor)
    lack = lack_elements(pose, elements, cofactor, length, noise.size, weakest)
    swapped = chosen_elements.wrong_side(system, base, pose)
    result = orientation.result
    # those that stand behind the two below in the table of `verdict`
    later = is_usable(result)
    for name in ("two_solutions", "carried_by_few", "points_behind_camera"):
        later = later | (result == getattr(RESULTS, name))
    result = RESULTS.where(later & swapped, RESULTS.photos_swapped, result)
    result = RESULTS.where(later & lack, RESULTS.elements_undefined, result)
    return dataclasses.replace(
        orientation,
        elements=elements,
        cofactor=cofactor,
        model=model,
        result=result,
    )
