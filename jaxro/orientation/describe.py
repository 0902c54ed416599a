"""What follows from the solution of an orientation: elements, points, sizes of errors."""

from typing import NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from ..adjustment.guarded import root
from ..geometry import coplanarity
from ..geometry.elements import AbstractElements, RelativePose, to_pose
from ..geometry.intersection import model_point
from ..geometry.pairs import Pair
from ..xla.passes import pointwise, sums
from . import chosen_elements, degeneracy
from .degeneracy import Noise, WorstDirection
from .inspection import Inspection, inspect
from .problem import Problem
from .solve import Solution


class Description(NamedTuple):
    """`pose`: with the base on the side of the points. `elements` and `cofactor`: in
    the system that was asked for, whose base has the length `length`. `worst`: the
    direction of the parameters that were solved that is determined worst. `inspection`:
    what the points tell of the pose; `noise`: the measuring errors that layouts are
    judged by. `sigma0`: the estimated one, zero without redundancy. Of every point:
    `parallax`, `model`, `in_front`. `m_q`: the mean parallax. `behind`: how many
    accurate points lie behind a photo."""

    pose: RelativePose
    elements: AbstractElements
    cofactor: Float[Array, "5 5"]
    length: Float[Array, ""]
    worst: WorstDirection
    inspection: Inspection
    noise: Noise
    sigma0: Float[Array, ""]
    parallax: Float[Array, " point"]
    model: tuple[Float[Array, " point"], Float[Array, " point"], Float[Array, " point"]]
    in_front: Bool[Array, " point"]
    m_q: Float[Array, ""]
    behind: Float[Array, ""]


def describe(pair: Pair, problem: Problem, solution: Solution) -> Description:
    """`Description` of a solution of a pair whose masked points are zero."""
    adjustment = solution.adjustment
    solved = adjustment.parameters
    pose = to_pose(solved)
    inspection = inspect(pair, pose)
    free = isinstance(solved, RelativePose)
    pose, flipped = chosen_elements.face_points(pose, inspection, free)
    length = chosen_elements.length(pair, problem.elements, problem.length, pose)
    freedom = adjustment.degrees_of_freedom
    checked = freedom > 0
    sigma0 = jnp.where(checked, adjustment.sigma0, 0.0)
    noise = degeneracy.noise(
        sigma0, freedom.astype(sigma0.dtype), inspection.sigma, pair.focal_left
    )

    # what errors add to the information has no derivative: the rest of it has
    fixed = lax.stop_gradient((pair, solved, adjustment.cofactor, noise.size))
    worst = degeneracy.worst_direction(*fixed)
    cofactor = adjustment.cofactor + (worst.cofactor - fixed[2])
    elements, cofactor = chosen_elements.in_system(
        solved, cofactor, flipped, problem.elements, length
    )

    parallax_of = coplanarity.parallax_of(pair, pose)
    scale = problem.elements.scale((pose.bx, pose.by, pose.bz), length)
    meet = model_point(pair, pose, elements, scale, noise.size)

    def of_point(point, sigma, use, roots):
        return jnp.where(use, parallax_of(point), 0.0), *meet(point, sigma, use, roots)

    parallax, model, in_front, behind = pointwise(
        of_point, pair.coordinates, pair.sigma, pair.mask, pair.roots
    )
    accurate = (behind & ~pair.coarse).astype(parallax.dtype)
    squares, behind = sums((parallax**2, accurate))
    divisor = jnp.where(checked, freedom, 1).astype(parallax.dtype)
    return Description(
        pose=pose,
        elements=elements,
        cofactor=cofactor,
        length=length,
        worst=worst,
        inspection=inspection,
        noise=noise,
        sigma0=sigma0,
        parallax=parallax,
        model=model,
        in_front=in_front,
        m_q=jnp.where(checked, root(squares / divisor), jnp.nan),
        behind=behind,
    )
