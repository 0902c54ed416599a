"""A finished absolute orientation, and what can be read from it."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from ..adjustment import critical_values
from ..adjustment.guarded import root, times
from ..geometry import rotations as rot
from .absolute_verdict import DATUM, RESULTS, is_usable
from .similarity import Frame, Similarity

NAMES = ("scale", "omega", "phi", "kappa", "TX", "TY", "TZ")
"""The elements in the order of `values` and of their cofactors."""


class AbsoluteOrientation(eqx.Module):
    """The similarity X = s R x + T that places a model on the ground.

    `values` of the elements in the order of `NAMES`, angles in radians; `cofactor`:
    theirs; `rotation`: R. Of every point: `points`, its adjusted ground coordinates,
    and their cofactors. Of every ground coordinate (zero where it is not `known`):
    `residuals`, place of the model point minus given coordinate; `redundancy`, the part
    of an error of the coordinate that its weighted residual shows, from 0 to 1;
    `ratios`, the residual over its standard deviation where sigma0 is 1.

    `sigma0` is a ratio to the given standard deviations; with unit weights it is the
    standard deviation of a ground coordinate. NaN without redundancy. `missing`: what
    of `DATUM` the control leaves open. `slopes`, `own` and `cofactors` are parts of the
    covariance of all points: derivatives by all unknowns, cofactors by errors of their
    own, cofactors of the unknowns. These are the local parameters of the similarity
    `within` the units of a frame, and the errors in common.
    """

    frame: Frame
    within: Similarity
    values: Float[Array, "*model 7"]
    rotation: Float[Array, "*model 3 3"]
    cofactor: Float[Array, "*model 7 7"]
    points: Float[Array, "*model point 3"]
    point_cofactors: Float[Array, "*model point 3 3"]
    residuals: Float[Array, "*model point 3"]
    redundancy: Float[Array, "*model point 3"]
    ratios: Float[Array, "*model point 3"]
    known: Bool[Array, "*model point 3"]
    slopes: Float[Array, "*model point 3 p"]
    own: Float[Array, "*model point 3 3"]
    cofactors: Float[Array, "*model p p"]
    sigma0: Float[Array, "*model"]
    degrees_of_freedom: Int[Array, "*model"]
    missing: Bool[Array, "*model 5"]
    result: RESULTS

    @property
    def scale(self) -> Float[Array, "*model"]:
        """s: a length on the ground over the same in the model."""
        return self.values[..., 0]

    @property
    def angles(self) -> Float[Array, "*model 3"]:
        """omega, phi, kappa in radians: Rᵀ = R3(kappa) R2(phi) R1(omega), ground to
        model."""
        return self.values[..., 1:4]

    @property
    def shift(self) -> Float[Array, "*model 3"]:
        """T."""
        return self.values[..., 4:]

    @property
    def usable(self) -> Bool[Array, "*model"]:
        """Whether the numbers may be used."""
        return is_usable(self.result)

    def check(self) -> "AbsoluteOrientation":
        """This orientation; RuntimeError with advice where it is not usable."""
        if not bool(jnp.all(self.usable)):
            raise RuntimeError(f"orient_model: {RESULTS[self.result]}{self._open()}")
        return self

    def _open(self) -> str:
        found = [n for n, m in zip(DATUM, self.missing.tolist(), strict=True) if m]
        return f" Missing: {', '.join(found)}." if found else ""

    def covariance(self, sigma0: ArrayLike | None = None) -> Float[Array, "7 7"]:
        """sigma0² Q of the elements: a posteriori, or a priori with the sigma0 given (1
        where the given standard deviations are true)."""
        return times(self.cofactor, self._unit(sigma0) ** 2)

    def deviations(self, sigma0: ArrayLike | None = None) -> Float[Array, "7"]:
        """Standard deviations of the elements; `sigma0` as in `covariance`."""
        variances = jnp.diagonal(self.cofactor)
        return times(root(variances), self._unit(sigma0))

    def point_deviations(
        self, sigma0: ArrayLike | None = None
    ) -> Float[Array, "point 3"]:
        """Standard deviations of the adjusted points; `sigma0` as in `covariance`. Without
        errors of the model they are those of the similarity alone."""
        variances = jnp.diagonal(self.point_cofactors, axis1=-2, axis2=-1)
        return times(root(variances), self._unit(sigma0))

    def covariance_of(
        self, i: int, j: int, sigma0: ArrayLike | None = None
    ) -> Float[Array, "3 3"]:
        """The covariance of two points, which share the errors of the similarity and
        those in common; of one point if i = j."""
        found = self.slopes[i] @ self.cofactors @ self.slopes[j].T
        found = found + self.own[i] if i == j else found
        return times(found, self._unit(sigma0) ** 2)

    def w(self, sigma0: ArrayLike | None = None) -> Float[Array, "point 3"]:
        """Residuals over their standard deviations: normal numbers with the sigma0
        given, Pope's tau with the estimated one. Zero where nothing checks the
        coordinate."""
        return self.ratios / self._unit(sigma0)

    def transform(
        self, points: Float[ArrayLike, "n 3"], sigma0: ArrayLike | None = None
    ) -> tuple[Float[Array, "n 3"], Float[Array, "n 3 3"]]:
        """Further places of the model, taken as free of error, on the ground, and their
        covariances by the errors of the elements."""

        def place(step: Array, point: Array) -> Array:
            return self.frame.without(self.within.move(step)).to_ground(point)

        def of_point(point: Array) -> tuple[Array, Array]:
            slopes = jax.jacfwd(place)(jnp.zeros(7), point)
            return place(jnp.zeros(7), point), slopes @ cofactor @ slopes.T

        cofactor = self.cofactors[:7, :7]
        placed, spread = jax.vmap(of_point)(jnp.asarray(points, float))
        return placed, times(spread, self._unit(sigma0) ** 2)

    def interval(self, level: float = 0.95) -> Float[Array | np.ndarray, ""]:
        """Half the width of a confidence interval, in standard deviations (Student)."""
        return critical_values.half_width(level, self.degrees_of_freedom)

    def _unit(self, sigma0: ArrayLike | None) -> Float[Array, "..."]:
        return self.sigma0 if sigma0 is None else jnp.asarray(sigma0, float)


def values_of(similarity: Similarity) -> Float[Array, "7"]:
    """Scale, omega, phi, kappa of Rᵀ, and shift."""
    angles = rot.omega_phi_kappa(rot.transpose(similarity.rotation))
    return jnp.concatenate(
        [similarity.scale[None], jnp.stack(angles), similarity.shift]
    )
