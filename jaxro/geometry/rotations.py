"""Rotations as plain tuples of scalars, so that a batch of pairs is arithmetic on flat
arrays.

A vector is a tuple of three scalars, a matrix a tuple of three rows. Under `vmap` every
scalar becomes one array over the pairs and XLA fuses the lot; no 3x3 array, no LAPACK,
no gather.

Two angle orders are in use:

* `r_alpha`, `r_omega`, `r_chi`: the papers' rotations, image to model, R = R_alpha
  R_omega R_chi (Dorozhinsky 1971; about y, x, z);
* `m_omega_phi_kappa`: object to image, M = R3(kappa) R2(phi) R1(omega) (Wolf, Mikhail).

Angles are radians.
"""

from collections.abc import Sequence

import jax.numpy as jnp
from jaxtyping import Array, Float

Scalar = Float[Array, ""]
Vector = tuple[Scalar, Scalar, Scalar]
Matrix = tuple[Vector, Vector, Vector]


def dot(a: Sequence, b: Sequence) -> Scalar:
    """a . b"""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def cross(a: Vector, b: Vector) -> Vector:
    """a x b"""
    return (
        a[1] * b[2] - a[2] * b[1],
        a[2] * b[0] - a[0] * b[2],
        a[0] * b[1] - a[1] * b[0],
    )


def scale(a: Vector, factor: Scalar | float) -> Vector:
    """factor * a"""
    return (a[0] * factor, a[1] * factor, a[2] * factor)


def length(x: Scalar, y: Scalar) -> Scalar:
    """sqrt(x² + y²). Not `jnp.hypot`: its derivative compares with a maximum and is
    wrong where the compiler computes that maximum twice with different rounding."""
    return jnp.sqrt(x * x + y * y)


def unit(a: Vector) -> Vector:
    """a / |a|"""
    return scale(a, 1 / jnp.sqrt(dot(a, a)))


def add_scaled(a: Vector, b: Vector, factor: Scalar | float) -> Vector:
    """a + factor b"""
    return (a[0] + factor * b[0], a[1] + factor * b[1], a[2] + factor * b[2])


def transpose(m: Matrix) -> Matrix:
    """Mᵀ"""
    return tuple(zip(*m, strict=True))  # pyright: ignore[reportReturnType]


def apply(m: Matrix, a: Vector) -> Vector:
    """M a"""
    return (dot(m[0], a), dot(m[1], a), dot(m[2], a))


def product(m: Matrix, n: Matrix) -> Matrix:
    """M N"""
    columns = transpose(n)
    return tuple(tuple(dot(row, column) for column in columns) for row in m)  # pyright: ignore[reportReturnType]


def as_array(m) -> Float[Array, "..."]:
    """Nested tuples of scalars (or of equal batches) as one array, vector and matrix
    axes last."""
    if isinstance(m[0], tuple):
        return jnp.stack([as_array(row) for row in m], axis=-2)
    return jnp.stack([jnp.asarray(entry) for entry in m], axis=-1)


def as_matrix(a: Float[Array, "3 3"]) -> Matrix:
    """The inverse of `as_array` for one 3x3 array."""
    return tuple(tuple(a[i, j] for j in range(3)) for i in range(3))  # pyright: ignore[reportReturnType]


def identity(like: Scalar) -> Matrix:
    """The unit matrix with entries of the shape and dtype of `like`."""
    one, zero = jnp.ones_like(like), jnp.zeros_like(like)
    return ((one, zero, zero), (zero, one, zero), (zero, zero, one))


def r_alpha(angle: Scalar) -> Matrix:
    """[[c, 0, -s], [0, 1, 0], [s, 0, c]]"""
    c, s = jnp.cos(angle), jnp.sin(angle)
    one, zero = jnp.ones_like(c), jnp.zeros_like(c)
    return ((c, zero, -s), (zero, one, zero), (s, zero, c))


def r_omega(angle: Scalar) -> Matrix:
    """[[1, 0, 0], [0, c, -s], [0, s, c]]"""
    c, s = jnp.cos(angle), jnp.sin(angle)
    one, zero = jnp.ones_like(c), jnp.zeros_like(c)
    return ((one, zero, zero), (zero, c, -s), (zero, s, c))


def r_chi(angle: Scalar) -> Matrix:
    """[[c, -s, 0], [s, c, 0], [0, 0, 1]]"""
    c, s = jnp.cos(angle), jnp.sin(angle)
    one, zero = jnp.ones_like(c), jnp.zeros_like(c)
    return ((c, -s, zero), (s, c, zero), (zero, zero, one))


def alpha_omega_chi(r: Matrix) -> Vector:
    """Angles of R = R_alpha R_omega R_chi; |omega| <= pi/2.

    chi is that of R_alphaᵀ R: near |omega| = pi/2 alpha is any angle, and chi has to go
    with it.
    """
    alpha = jnp.arctan2(-r[0][2], r[2][2])
    omega = jnp.arctan2(-r[1][2], length(r[1][0], r[1][1]))
    c, s = jnp.cos(alpha), jnp.sin(alpha)
    chi = jnp.arctan2(-c * r[0][1] - s * r[2][1], c * r[0][0] + s * r[2][0])
    return alpha, omega, chi


def m_omega_phi_kappa(omega: Scalar, phi: Scalar, kappa: Scalar) -> Matrix:
    """M = R3(kappa) R2(phi) R1(omega), object to image.

    With the papers' matrices this is R_chi(-kappa) R_alpha(phi) R_omega(-omega): the
    same elementary turns, of the frame instead of the vector.
    """
    return product(r_chi(-kappa), product(r_alpha(phi), r_omega(-omega)))


def omega_phi_kappa(m: Matrix) -> Vector:
    """Angles of M = R3(kappa) R2(phi) R1(omega); |phi| <= pi/2.

    kappa is that of M R1(omega)ᵀ: near |phi| = pi/2 omega is any angle, and kappa has
    to go with it.
    """
    omega = jnp.arctan2(-m[2][1], m[2][2])
    phi = jnp.arctan2(m[2][0], length(m[0][0], m[1][0]))
    c, s = jnp.cos(omega), jnp.sin(omega)
    kappa = jnp.arctan2(c * m[0][1] + s * m[0][2], c * m[1][1] + s * m[1][2])
    return omega, phi, kappa


def from_quaternion(w: Scalar, x: Scalar, y: Scalar, z: Scalar) -> Matrix:
    """The rotation of a quaternion of any length, times its squared length (the
    condition does not mind)."""
    ww, xx, yy, zz = w * w, x * x, y * y, z * z
    return (
        (ww + xx - yy - zz, 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), ww - xx + yy - zz, 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), ww - xx - yy + zz),
    )


def turn_quaternion(
    quaternion: Float[Array, "4"], turn: Float[Array, "3"]
) -> Float[Array, "4"]:
    """A quaternion after a small turn: (1, turn/2) times it."""
    w, x, y, z = (quaternion[k] for k in range(4))
    a, b, c = (turn[k] / 2 for k in range(3))
    return jnp.stack(
        [
            w - a * x - b * y - c * z,
            x + a * w + b * z - c * y,
            y + b * w + c * x - a * z,
            z + c * w + a * y - b * x,
        ]
    )


def unit_quaternion(quaternion: Float[Array, "4"]) -> Float[Array, "4"]:
    """The quaternion of the same rotation with length 1 and w >= 0."""
    length = jnp.sqrt(jnp.sum(quaternion**2))
    sign = jnp.where(quaternion[0] < 0, -1.0, 1.0)
    return quaternion * sign / length


def to_quaternion(r: Matrix) -> tuple[Scalar, Scalar, Scalar, Scalar]:
    """Unit quaternion (w, x, y, z), w >= 0, of a rotation matrix.

    Each column of q qᵀ is the quaternion times one of its components; the longest of
    the four is taken, so there is no rotation at which digits are lost (Shepperd 1978).
    """
    t = (r[0][0], r[1][1], r[2][2])
    a, b, c = r[2][1] - r[1][2], r[0][2] - r[2][0], r[1][0] - r[0][1]
    d, e, f = r[0][1] + r[1][0], r[0][2] + r[2][0], r[1][2] + r[2][1]
    columns = (
        (1 + t[0] + t[1] + t[2], a, b, c),
        (a, 1 + t[0] - t[1] - t[2], d, e),
        (b, d, 1 - t[0] + t[1] - t[2], f),
        (c, e, f, 1 - t[0] - t[1] + t[2]),
    )
    best, longest = columns[0], columns[0][0]
    for i in (1, 2, 3):
        longer = columns[i][i] > longest
        best = tuple(
            jnp.where(longer, new, old)
            for new, old in zip(columns[i], best, strict=True)
        )
        longest = jnp.maximum(longest, columns[i][i])
    length = jnp.sqrt(best[0] ** 2 + best[1] ** 2 + best[2] ** 2 + best[3] ** 2)
    scale = jnp.where(best[0] < 0, -1.0, 1.0) / length
    return tuple(entry * scale for entry in best)  # pyright: ignore[reportReturnType]


def tangents(b: Vector) -> tuple[Vector, Vector]:
    """Two unit vectors at right angles to the unit vector b and to each other, for
    every b (Duff et al. 2017)."""
    x, y, z = b
    sign = jnp.where(z < 0, -1.0, 1.0)
    a = -1 / (sign + z)
    c = x * y * a
    return (1 + sign * x * x * a, sign * c, -sign * x), (c, sign + y * y * a, -y)
