"""Covariances of the model points of an oriented pair."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..geometry import coplanarity, rotations as rot
from ..geometry.cofactor_roots import CofactorRoots
from ..geometry.elements import AbstractElements
from ..geometry.pairs import Pair, mask_unusable
from ..orientation.result import Orientation
from ..xla.programs import compiled

Data = tuple[Pair, AbstractElements, Float[Array, "5 5"]]


def model_covariances(
    pair: Pair, orientation: Orientation, sigma0: float | None = None
) -> Float[np.ndarray, "point 3 3"]:
    """The covariance of (X, Y, Z) of every model point of the pair that was oriented, in
    the frame and scale of `orientation.model`; zero where masked.

        C = sigma0² (J Q Jᵀ + sigma² K Kᵀ)

    J: derivatives of the point by the elements, Q their cofactors; K: by the four
    coordinates, times the roots of their cofactors where these are not 1. There is no
    mixed term, because the corrected coordinates are independent of the misclosures,
    from which the elements come. `sigma0`: the estimated one if None. Of first order.
    """
    unit, at = _cofactors(pair, orientation.elements, orientation.cofactor)
    model = np.stack([np.asarray(c) for c in orientation.model], axis=-1)
    length = float(np.sum(at * model) / max(np.sum(np.square(at)), 1e-300))
    own = float(orientation.sigma0) if sigma0 is None else sigma0
    return (own * length) ** 2 * np.asarray(unit)


@compiled
def _cofactors(
    pair: Pair, elements: AbstractElements, q: Float[Array, "5 5"]
) -> tuple[Float[Array, "point 3 3"], Float[Array, "point 3"]]:
    """Cofactors of the model points with the base of the elements, or a base of 1 where
    these are angles alone; and the points."""
    pair, _ = mask_unusable(pair)
    focals = pair.focal_left, pair.focal_right
    zero = (jnp.zeros_like(q[0, 0]),) * 5

    def of_point(
        point: tuple, sigma: Array, use: Array, roots: CofactorRoots | None
    ) -> tuple[Float[Array, "3 3"], Float[Array, "3"]]:
        def place(step: tuple, z: tuple) -> Float[Array, "3"]:
            shift = z if roots is None else roots.displace(z)
            at = tuple(c + d for c, d in zip(point, shift, strict=True))
            return _place(elements.move(step), at, use, roots, focals)

        none = (jnp.zeros_like(sigma),) * 4
        by_step, by_z = jax.jacfwd(place, argnums=(0, 1))(zero, none)
        j, k = jnp.stack(by_step, axis=1), jnp.stack(by_z, axis=1) * sigma
        covariance = j @ q @ j.T + k @ k.T
        there = jnp.where(use, 1.0, 0.0)
        return covariance * there, place(zero, none) * there

    return jax.vmap(of_point)(pair.coordinates, pair.sigma, pair.mask, pair.roots)


def _place(elements: AbstractElements, point, use, roots, focals) -> Float[Array, "3"]:
    """X, Y, Z of one point from its corrected coordinates."""
    (rotation, base), frame = elements.relative(), elements.model_frame()
    f = coplanarity.fundamental_matrix(rotation, base, *focals)
    v = coplanarity.corrections(f, point, use, roots)
    x, *others = (c + d for c, d in zip(point, v, strict=True))
    # masked points stand where no rays are parallel
    corrected = jnp.where(use, x, focals[0]), *others
    right = rot.product(frame, rotation)
    first, second = coplanarity.directions(frame, right, corrected, *focals)
    along = rot.apply(frame, base)
    lam, mu, near = coplanarity.depths(first, second, along)
    return jnp.stack(coplanarity.halfway(first, second, along, lam * near, mu * near))
