"""The errors of model points: of the coordinates of each point, and of the five elements
that all points share."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..geometry import coplanarity, rotations as rot
from ..geometry.cofactor_roots import CofactorRoots
from ..geometry.elements import AbstractElements
from ..geometry.pairs import Pair, mask_unusable

Host = Float[np.ndarray, "..."]


class Derivatives(NamedTuple):
    """Of every point of a pair: where it is `at`, in the frame of the elements with the
    base that they have (1 where they are angles alone); its derivatives `by_elements`
    and by its `own` coordinates, in standard deviations of these."""

    at: Float[Array, "point 3"]
    by_elements: Float[Array, "point 3 5"]
    own: Float[Array, "point 3 4"]


def differentiate(pair: Pair, elements: AbstractElements) -> Derivatives:
    """`Derivatives` of the model points of a pair; zero where masked."""
    pair, _ = mask_unusable(pair)
    focals = pair.focal_left, pair.focal_right
    zero = (jnp.zeros_like(pair.focal_left),) * 5

    def of_point(
        point: tuple, sigma: Array, use: Array, roots: CofactorRoots | None
    ) -> Derivatives:
        def place(step: tuple, z: tuple) -> Float[Array, "3"]:
            shift = z if roots is None else roots.displace(z)
            at = tuple(c + d for c, d in zip(point, shift, strict=True))
            return _place(elements.move(step), at, use, roots, focals)

        none = (jnp.zeros_like(sigma),) * 4
        by_step, by_z = jax.jacfwd(place, argnums=(0, 1))(zero, none)
        there = jnp.where(use, 1.0, 0.0)
        return Derivatives(
            at=place(zero, none) * there,
            by_elements=jnp.stack(by_step, axis=1) * there,
            own=jnp.stack(by_z, axis=1) * sigma * there,
        )

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


def root(matrices: Host) -> Host:
    """Lower triangular roots L of symmetric matrices C = L Lᵀ; NaN where a matrix is not
    positive definite."""
    size = matrices.shape[-1]
    lower = np.zeros_like(matrices)
    with np.errstate(invalid="ignore", divide="ignore"):
        for j in range(size):
            before = lower[..., :j]
            rest = matrices[..., j] - np.sum(before * before[..., j : j + 1, :], -1)
            pivot = np.sqrt(np.where(rest[..., j] > 0, rest[..., j], np.nan))
            lower[..., j:, j] = rest[..., j:] / pivot[..., None]
    return lower
