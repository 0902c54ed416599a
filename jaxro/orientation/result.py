"""The result of an orientation."""

import math
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Int, ScalarLike

from ..adjustment import critical_values
from ..adjustment.guarded import root, times
from ..geometry import coplanarity
from ..geometry.elements import AbstractElements, RelativePose
from ..geometry.pairs import Coordinates, Pair, first_points, mask_unusable
from ..xla.programs import compiled, is_traced
from ..xla.settings import RUN_FAST, settings_for
from .results import RESULTS, is_usable

PER_POINT = ("parallax", "residuals", "redundancy", "model", "in_front")
"""What an `Orientation` holds of every point."""


class Orientation(eqx.Module):
    """The relative orientation of a pair; for a batch every field has leading axes.

    Of every point (zero or False where masked): `parallax` the strict y-parallax q = y1* -
    y2* of the photos turned parallel to the base; `residuals` the whitened residuals
    that were minimised; `redundancy` numbers, which add up to the degrees of freedom;
    `model` (X, Y, Z) in the frame and scale of the elements; `in_front` of both photos.

    `m_q` = sqrt([qq]/(n-5)), `sigma0` = sqrt(Σ r²/(n-5)): the standard deviation of a
    coordinate in its own unit when no sigma was given, else its ratio to the given
    sigma. Both NaN without redundancy. `cofactor`: of the five elements in the order of
    `elements.names`; rad, and the unit of the base.
    """

    pose: RelativePose
    elements: AbstractElements
    cofactor: Float[Array, "*pairs 5 5"]
    parallax: Float[Array, "*pairs point"]
    residuals: Float[Array, "*pairs point"]
    redundancy: Float[Array, "*pairs point"]
    model: tuple[
        Float[Array, "*pairs point"],
        Float[Array, "*pairs point"],
        Float[Array, "*pairs point"],
    ]
    in_front: Bool[Array, "*pairs point"]
    m_q: Float[Array, "*pairs"]
    sigma0: Float[Array, "*pairs"]
    degrees_of_freedom: Int[Array, "*pairs"]
    iterations: Int[Array, "*pairs"]
    result: RESULTS

    def __str__(self) -> str:
        """The elements with their standard deviations, and sigma0; why there are none;
        of a batch how many pairs are usable."""
        if is_traced(self):
            return repr(self)
        if jnp.ndim(self.sigma0):
            usable = int(np.sum(np.asarray(self.usable)))
            return f"{usable} of {np.size(self.sigma0)} pairs usable"
        if not bool(self.usable):
            return RESULTS[self.result]
        lines = [RESULTS[self.result].split(":")[0] or "successful"]
        deviations = np.asarray(self.deviations)
        # those of a pose are small turns from it, which are zero
        is_local = isinstance(self.elements, RelativePose)
        if is_local:
            lines += _describe_pose(self.pose)
        for name, value, deviation, angle in zip(
            self.elements.names,
            self.elements.values(),
            deviations,
            self.elements.angles,
            strict=True,
        ):
            factor, unit = (math.degrees(1.0), "°") if angle else (1.0, "")
            shown = "" if is_local else f"{float(value) * factor:.6g} "
            lines.append(f"{name} {shown}± {deviation * factor:.2g}{unit}")
        freedom = int(self.degrees_of_freedom)
        lines.append(f"sigma0 {float(self.sigma0):.3g}, {freedom} degrees of freedom")
        return "\n".join(lines)

    def first(self, points: int) -> "Orientation":
        """The same without the places behind so many points."""
        if points == self.residuals.shape[-1]:
            return self
        of_points = lambda o: [getattr(o, name) for name in PER_POINT]
        return eqx.tree_at(of_points, self, first_points(of_points(self), points))

    @property
    def parameters(self) -> AbstractElements:
        """The elements, under the name that all adjustments have for them."""
        return self.elements

    @property
    def covariance(self) -> Float[Array, "*pairs 5 5"]:
        """sigma0² times the cofactors (a posteriori)."""
        return times(self.cofactor, self.sigma0[..., None, None] ** 2)

    @property
    def deviations(self) -> Float[Array, "*pairs 5"]:
        """Standard deviations of the elements."""
        return times(self._roots, self.sigma0[..., None])

    @property
    def _roots(self) -> Float[Array, "*pairs 5"]:
        """Roots of the cofactors of the elements."""
        return root(jnp.diagonal(self.cofactor, axis1=-2, axis2=-1))

    @property
    def correlation(self) -> Float[Array | np.ndarray, "*pairs 5 5"]:
        """Correlations of the elements."""
        roots = self.cofactor.diagonal(axis1=-2, axis2=-1) ** 0.5
        return self.cofactor / (roots[..., :, None] * roots[..., None, :])

    @property
    def usable(self) -> Bool[Array, "*pairs"]:
        """Whether the elements may be used; `result` says why not, or what to mind."""
        return is_usable(self.result)

    def interval(
        self, confidence: ScalarLike = 0.95, *, sigma0: ArrayLike | None = None
    ) -> Float[Array, "*pairs 5"]:
        """Half widths of the intervals that hold each element with this probability.

        A posteriori: Student's t of n - 5 degrees of freedom times `deviations`;
        infinite or NaN without any. With the `sigma0` known before the measurement (1
        where the sigmas given are standard deviations): the normal quantile times
        sigma0 sqrt(Q), which exists for five points, too.
        """
        if sigma0 is None:
            quantile = self._quantile(
                lambda f: critical_values.half_width(confidence, f)
            )
            return times(self.deviations, quantile[..., None])
        known = sigma0 * critical_values.normal(1 - confidence)
        known = jnp.broadcast_to(known, self.sigma0.shape)
        return times(self._roots, known[..., None])

    def radius(
        self, confidence: ScalarLike = 0.95, *, sigma0: ArrayLike | None = None
    ) -> Float[Array, "*pairs"]:
        """Of the joint region that holds the five elements with this probability: d of
        them from the adjusted ones, d' C⁻¹ d <= radius², C the covariance a posteriori
        or, with a known sigma0, sigma0² Q.

        sqrt(5 F) of 5 and n - 5 degrees of freedom, or the root of the chi-squared
        quantile of 5.
        """
        if sigma0 is not None:
            known = jnp.sqrt(critical_values.chi_squared(1 - confidence, 5))
            return jnp.broadcast_to(known, self.sigma0.shape)
        return self._quantile(lambda f: critical_values.radius(confidence, 5, f))

    def _quantile(self, of: Callable) -> Float[Array, "*pairs"]:
        """A quantile by the degrees of freedom of every pair."""
        most = max(self.residuals.shape[-1] - 5, 0)
        table = lambda freedom: critical_values.by_count(of, most, freedom)
        return jnp.vectorize(table)(
            jnp.asarray(self.degrees_of_freedom, self.sigma0.dtype)
        )

    def corrections(self, pair: Pair) -> Coordinates:
        """The corrections v of (x_left, y_left, x_right, y_right) of the oriented pair,
        zero where masked."""
        return _corrections_of(self.pose, pair)

    def check(self) -> "Orientation":
        """This orientation; raises RuntimeError with advice if any of it is not
        usable."""
        if not bool(jnp.all(self.usable)):
            if jnp.ndim(self.usable) == 0:
                raise RuntimeError(RESULTS[self.result])
            raise RuntimeError(
                f"{int(jnp.sum(~self.usable))} of {self.usable.size} pairs are not "
                "oriented; see result"
            )
        return self


def _describe_pose(pose: RelativePose) -> list[str]:
    """The base and the rotation of the right photo, as lines."""
    axis = np.array([pose.qx, pose.qy, pose.qz], float)
    sine = float(np.linalg.norm(axis))
    angle = math.degrees(2 * math.atan2(sine, float(pose.qw)))
    numbers = lambda values: " ".join(f"{float(value):.5f}" for value in values)
    about = f" about {numbers(axis / sine)}" if sine > 0 else ""
    return [
        f"base {numbers((pose.bx, pose.by, pose.bz))}",
        f"rotation {angle:.5f}°{about}",
    ]


def _by_size(pose: RelativePose, pair: Pair) -> dict[str, Any]:
    return RUN_FAST if jnp.ndim(pose.qw) else settings_for(pair.x_left.size)


@compiled(settings=_by_size)
def _corrections_of(pose: RelativePose, pair: Pair) -> Coordinates:
    if pose.qw.ndim:
        return jax.vmap(_corrections_of)(pose, pair)
    pair, _ = mask_unusable(pair)
    f = coplanarity.fundamental_matrix(
        *pose.relative(), pair.focal_left, pair.focal_right
    )
    correct = lambda point, use, roots: coplanarity.corrections(f, point, use, roots)
    return jax.vmap(correct)(pair.coordinates, pair.mask, pair.roots)
