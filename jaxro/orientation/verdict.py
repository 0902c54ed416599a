"""How an orientation ended: a table of conditions in the order of their precedence."""

import dataclasses

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from ..adjustment import results
from ..geometry.elements import AbstractElements, RelativePose
from ..geometry.pairs import Pair, mask_unusable
from ..xla.passes import total
from . import chosen_elements, degeneracy, planes
from .describe import Description
from .problem import Problem
from .result import Orientation
from .results import RESULTS, of_adjustment
from .solve import Solution

WEAK = 0.04
"""Standard deviation (rad) of a local parameter above which the linearised statistics
no longer mean anything."""


def verdict(
    pair: Pair,
    problem: Problem,
    solution: Solution,
    description: Description,
    bad_input: Bool[Array, ""],
) -> RESULTS:
    """The first result of the table whose condition holds, or else how the adjustment
    ended; `check_plane` is still to come. `bad_input`: whether something had to be left
    out of the pair."""
    start, adjustment = solution
    noise, pose = description.noise, description.pose
    freedom = adjustment.degrees_of_freedom
    solved = adjustment.result == results.RESULTS.successful

    worst = description.worst
    weakest = largest_variance(adjustment.parameters, worst.cofactor)
    deviates = noise.size**2 * weakest > WEAK**2
    undetermined = worst.margin < noise.least_margin
    # the nearer to that, the slower
    ended = solved | (adjustment.result == results.RESULTS.diverged)
    second, undivided = degeneracy.find_second(worst, noise)
    rotation = degeneracy.pure_rotation(
        description.inspection, noise.freedom, description.sigma0
    )

    table = (
        (RESULTS.non_finite_input, bad_input),
        (RESULTS.too_few_points, freedom < 0),
        (RESULTS.zero_base, rotation | start.pure_rotation),
        (
            RESULTS.weakly_determined,
            (solved & (deviates | undivided)) | (ended & undetermined),
        ),
        (
            RESULTS.elements_undefined,
            solved
            & lack_elements(
                pose,
                description.elements,
                description.cofactor,
                description.length,
                noise.size,
                weakest,
            ),
        ),
        (
            RESULTS.photos_swapped,
            solved & chosen_elements.wrong_side(problem.elements, problem.length, pose),
        ),
        (RESULTS.points_behind_camera, solved & (description.behind > 0)),
        (RESULTS.two_solutions, solved & (start.ambiguous | second)),
        (RESULTS.no_redundancy, solved & (freedom == 0)),
    )
    result = of_adjustment(adjustment.result)
    for name, holds in reversed(table):
        result = RESULTS.where(holds, name, result)
    return result


def largest_variance(
    elements: AbstractElements, cofactor: Float[Array, "5 5"]
) -> Float[Array, ""]:
    """The largest cofactor of an element in rad, of the base over its length."""
    return jnp.max(jnp.diagonal(degeneracy.in_radians(elements, cofactor)[0]))


def lack_elements(
    pose: RelativePose,
    elements: AbstractElements,
    cofactor: Float[Array, "5 5"],
    length: Float[Array, ""],
    noise: Float[Array, ""],
    weakest: Float[Array, ""],
) -> Bool[Array, ""]:
    """Whether the elements that were asked for do not exist at the pose, or are far
    less certain than it. `noise`: the size of the measuring errors; `weakest`: the
    `largest_variance` of the pose itself."""
    missing = ~type(elements).exist((pose.bx, pose.by, pose.bz), length)
    variance = largest_variance(elements, cofactor)
    uncertain = noise**2 * variance > WEAK**2
    # without redundancy there is no noise to judge by
    rounding = degeneracy.ROUNDING**2 * variance > weakest
    return missing | uncertain | rounding


def noise_of(
    pair: Pair, orientation: Orientation
) -> tuple[degeneracy.Noise, Float[Array, ""]]:
    """The measuring errors that an orientation is judged by, without a derivative, and
    the root mean square of the sigmas of the pair."""
    n = jnp.maximum(pair.count, 1.0)
    mean_square = total(jnp.where(pair.mask, pair.sigma**2, 0.0)) / n
    sigma = jnp.where(mean_square > 0, jnp.sqrt(mean_square), 1.0)
    freedom = orientation.degrees_of_freedom.astype(sigma.dtype)
    sigma0 = lax.stop_gradient(jnp.where(freedom > 0, orientation.sigma0, 0.0))
    return degeneracy.noise(sigma0, freedom, sigma, pair.focal_left), sigma


def check_plane(
    pair: Pair, orientation: Orientation, asked: Bool[Array, ""]
) -> Orientation:
    """The orientation with the result `two_solutions` where that is `asked` and the
    second pose, which exists if the points lie in a plane, fits them as well; whether
    they do, its Σ r² tells. Few pairs are asked."""
    # a verdict has no derivative
    pair, pose = lax.stop_gradient((mask_unusable(pair)[0], orientation.pose))
    squares = planes.second_squares(pair, pose, asked)
    noise, sigma = noise_of(pair, orientation)
    freedom = noise.freedom
    sigma0 = lax.stop_gradient(jnp.where(freedom > 0, orientation.sigma0, 0.0))
    rounding = planes.ROUNDING * pair.count * (pair.focal_left / sigma) ** 2
    fits = squares <= noise.tolerance(freedom * sigma0**2) + rounding
    result = RESULTS.where(asked & fits, RESULTS.two_solutions, orientation.result)
    return dataclasses.replace(orientation, result=result)
