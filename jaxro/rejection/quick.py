"""The quick stages of `recommended`, for the ordinary pair near the vertical."""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, ScalarLike

from ..geometry.elements import RelativePose
from ..geometry.linear import linearise
from ..geometry.pairs import Pair
from ..xla.passes import count
from . import evidence
from .agreement import normalised_residuals
from .graduated_non_convexity import GraduatedNonConvexity
from .judgement import Decision
from .search import forward
from .stages import AbstractStage, believe_if_it_fits, on_a_plane, settle
from .steps import from_vertical
from .visibility import seen

LEAST = 0.4
"""Share of the points below which a set of them is not believed without a search."""


class Plain(AbstractStage):
    """All points, in `steps` of least squares from the vertical. Believed if they pass
    the global test, no |w| exceeds its limit, and all are seen from both photos."""

    steps: int = 5

    def __call__(self, pair: Pair, limit: Float[Array, ""]) -> Decision:
        pose = from_vertical(pair, self.steps)
        return Decision(
            pose=pose,
            use=pair.mask,
            believed=_all_agree(pair, pose, limit),
            scale=jnp.ones_like(limit),
        )


def _all_agree(
    pair: Pair, pose: RelativePose, limit: Float[Array, ""]
) -> Bool[Array, ""]:
    linear = linearise(pair, pose)
    small = normalised_residuals(linear, pair.mask) <= limit
    agree = pair.mask & small & seen(pair, pose, limit, pair.mask)
    fits = evidence.fits_well(linear.squares, pair.mask)
    return (count(agree) == count(pair.mask)) & fits


class Quick(AbstractStage):
    """The graduated search from the vertical.

    Believed if at least `share` of the points are kept, or `many`, and
    `believe_if_it_fits`, with `accidents`. A small part of a regular field of targets
    may fit a wrong pose. A plane has two poses, and a base that points into a photo
    several minima; these are left to `Thorough`, which compares them.
    """

    graduated: GraduatedNonConvexity = GraduatedNonConvexity()
    share: ScalarLike = 0.6
    many: int = 60
    accidents: ScalarLike = 1e-4

    def __call__(self, pair: Pair, limit: Float[Array, ""]) -> Decision:
        pose, use = settle(pair, self.graduated.search(pair), limit)
        fits = believe_if_it_fits(pair, pose, use, limit, LEAST, self.accidents)
        kept = count(use)
        enough = (kept >= self.share * count(pair.mask)) | (kept >= self.many)
        _, _, flat = on_a_plane(pair, pose, use, limit)
        return Decision(
            pose=pose,
            use=use,
            believed=fits & enough & ~flat & ~forward(pose),
            scale=jnp.ones_like(limit),
        )
