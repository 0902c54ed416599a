"""The coplanarity condition, the strict y-parallax and the intersection of one point.

    g = b . (p1 x R p2) = 0,    p = (x, y, -f)

Two ways to adjust it, each a function of the pair that returns a `Term`:

* `rigorous`: all four coordinates are measured with errors; the whitened residual is g
  / sqrt(B Q Bᵀ), B = dg/dl. Statistically right, the default.
* `parallax`: the y-parallax q of the photos turned parallel to the base is taken as
  measured with unit weight, as in the papers (Dorozhinsky 1971, Table 2).

Both residuals are in the unit of the coordinates when sigma is 1.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PyTree

from ..adjustment.residuals import Residuals
from ..adjustment.terms import Term
from . import rotations as rot
from .cofactor_roots import CofactorRoots
from .elements import AbstractElements, essential
from .pairs import Pair
from .rotations import Matrix, Vector

Scalar = Float[Array, "..."]
Point = tuple[Scalar, Scalar, Scalar, Scalar]
"""x_left, y_left, x_right, y_right of one point"""


def fundamental_matrix(
    rotation: Matrix, base: Vector, focal_left: Scalar, focal_right: Scalar
) -> Matrix:
    """F = diag(1, 1, -f1) E diag(1, 1, -f2), so that g = (x1, y1, 1) F (x2, y2, 1)ᵀ;
    once for a pair. It is linear in the rotation and in the base."""
    e = essential(rotation, base)
    return (
        (e[0][0], e[0][1], -focal_right * e[0][2]),
        (e[1][0], e[1][1], -focal_right * e[1][2]),
        (
            -focal_left * e[2][0],
            -focal_left * e[2][1],
            focal_left * focal_right * e[2][2],
        ),
    )


def common_focal(focal_left: Scalar, focal_right: Scalar) -> Scalar:
    """f with 2 / f² = 1 / f1² + 1 / f2²: sigma / f is the standard deviation of
    directions in the mean of both."""
    return jnp.sqrt(2 / (1 / focal_left**2 + 1 / focal_right**2))


def condition(f: Matrix, point: Point) -> Scalar:
    """g of one point, from the fundamental matrix of the pair."""
    x1, y1, x2, y2 = point
    a, b, c = (row[0] * x2 + row[1] * y2 + row[2] for row in f)
    return x1 * a + y1 * b + c


def turn_to_base(rotation: Matrix, base: Vector) -> tuple[Matrix, Matrix]:
    """Rotations of the left and right photo into the frame parallel to the base.

    X runs along the base and the left photo is not turned about X: Y = z x X / |z x X|
    with z the axis of the left photo. These are the papers' R_alpha R_chi and R_alpha'
    R_omega' R_chi', without their angles; undefined only for a base along the photo
    axis.
    """
    across = rot.length(base[0], base[1])
    x = rot.unit(base)
    y = (-base[1] / across, base[0] / across, jnp.zeros_like(across))
    left = (x, y, rot.cross(x, y))
    return left, rot.product(left, rotation)


def y_parallax(
    rows: tuple, point: Point, focal_left: Scalar, focal_right: Scalar
) -> Scalar:
    """q = y1* - y2* = -f1 (Y1/Z1 - Y2/Z2) of one point; `rows` are the Y and Z rows of
    the two rotations of `turn_to_base`."""
    x1, y1, x2, y2 = point
    rays = (x1, y1, -focal_left), (x2, y2, -focal_right)
    (y1, z1), (y2, z2) = (
        [rot.dot(row, ray) for row in turn]
        for turn, ray in zip(rows, rays, strict=True)
    )
    # one division, and that by itself: its derivatives then divide no more: a twelfth
    # of a solution
    return focal_left * (y2 * z1 - y1 * z2) * (1 / (z1 * z2))


def parallax_of(pair: Pair, pose: AbstractElements) -> Callable:
    """q of a point of a pair, as a function of its coordinates."""
    rows = tuple(frame[1:] for frame in turn_to_base(*pose.relative()))
    return lambda point: y_parallax(rows, point, pair.focal_left, pair.focal_right)


def parallaxes(pair: Pair, pose: AbstractElements) -> Float[Array, " point"]:
    """q of all points of a pair, whether they take part or not."""
    return jax.vmap(parallax_of(pair, pose))(pair.coordinates)


def rigorous(pair: Pair) -> Term:
    """Adjust the four image coordinates of every point."""
    prepare = lambda rotation, base: fundamental_matrix(
        rotation, base, pair.focal_left, pair.focal_right
    )
    if pair.roots is None:
        measured = condition, pair.coordinates, pair.sigma**2
    else:
        measured = _with_covariances(pair)
    return Term(*measured, mask=pair.mask, prepare=prepare, bilinear=True)


def _with_covariances(pair: Pair) -> tuple[Callable, PyTree, PyTree]:
    """The condition, observations and cofactor of points whose coordinates are not
    equally accurate: what is measured are the z of the coordinates l + L z, all of
    variance sigma², and z = 0."""

    def of_point(f: Matrix, observation: tuple) -> Scalar:
        z, point, roots = observation
        shift = roots.displace(z)
        return condition(f, tuple(c + d for c, d in zip(point, shift, strict=True)))

    z = tuple(jnp.zeros_like(c) for c in pair.coordinates)
    return of_point, (z, pair.coordinates, pair.roots), (pair.sigma**2, None, None)


def residuals(pair: Pair, pose: AbstractElements) -> Residuals:
    """The rigorous residuals of a pair as a function of a displacement of a pose."""
    return Residuals(rigorous(pair), pose)


def parallax(pair: Pair) -> Term:
    """Adjust the y-parallax of every point as if it had been measured; the coordinates
    are taken as free of error, so that their covariances (`Pair.roots`) play no part:
    sigma² is the variance of q."""

    def prepare(rotation: Matrix, base: Vector):
        left, right = turn_to_base(rotation, base)
        return left[1:], right[1:], pair.focal_left, pair.focal_right

    def of_point(prepared: tuple, observation: tuple[Point, Scalar]) -> Scalar:
        left, right, *focals = prepared
        point, measured = observation
        return y_parallax((left, right), point, *focals) - measured

    observations = pair.coordinates, jnp.zeros_like(pair.sigma)
    cofactor = None, pair.sigma**2
    return Term(of_point, observations, cofactor, mask=pair.mask, prepare=prepare)


def linearise(
    f: Matrix,
    point: Point,
    use: Bool[Array, "..."],
    roots: CofactorRoots | None = None,
) -> tuple[Scalar, Scalar, Point]:
    """g of one point, the square |B|² of its gradient by the coordinates (1 where it is
    not used), and B itself; with the `roots` L of the point, B L in place of B."""
    g, gradient = jax.value_and_grad(condition, argnums=1)(f, point)
    if roots is not None:
        gradient = roots.pull(gradient)
    return g, jnp.where(use, sum(entry**2 for entry in gradient), 1.0), gradient


def corrections(
    f: Matrix,
    point: Point,
    use: Bool[Array, "..."],
    roots: CofactorRoots | None = None,
) -> Point:
    """v = -Q Bᵀ (B Q Bᵀ)⁻¹ g: what brings the rays of one point to intersection with
    the smallest vᵀ Q⁻¹ v; sigma cancels. `roots`: of Q = L Lᵀ, where the coordinates
    of the point are not equally accurate.
    """
    g, square, gradient = linearise(f, point, use, roots)
    factor = jnp.where(use, -g / square, 0.0)
    v = tuple(factor * entry for entry in gradient)
    return v if roots is None else roots.displace(v)  # pyright: ignore[reportReturnType]


def directions(
    left: Matrix | None,
    right: Matrix,
    point: Point,
    focal_left: Scalar,
    focal_right: Scalar,
):
    """The rays R1 p1 and R2 p2 (`left` None for R1 = 1)."""
    x1, y1, x2, y2 = point
    first = x1, y1, -focal_left
    return first if left is None else rot.apply(left, first), rot.apply(
        right, (x2, y2, -focal_right)
    )


def rays(
    left: Matrix | None,
    right: Matrix,
    base: Vector,
    point: Point,
    focal_left: Scalar,
    focal_right: Scalar,
):
    """The two `directions`, and how they meet."""
    first, second = directions(left, right, point, focal_left, focal_right)
    return first, second, *meeting(first, second, base)


def meeting(
    first: Vector, second: Vector, base: Vector
) -> tuple[Scalar, Scalar, Scalar]:
    """w², λ w², μ w² of the closest points λ r1 and b + μ r2 of two rays:

    w = r1 x r2,    λ w² = (b x r2) . w,    μ w² = (b x r1) . w
    """
    w = rot.cross(first, second)
    lam, mu = (rot.dot(rot.cross(base, ray), w) for ray in (second, first))
    return rot.dot(w, w), lam, mu


def depths(
    first: Vector, second: Vector, base: Vector
) -> tuple[Scalar, Scalar, Scalar]:
    """λ w², μ w² and 1 / w²; of parallel rays 0 in place of the last, and the others
    say on which side they would meet."""
    squared, lam, mu = meeting(first, second, base)
    parallel = squared == 0
    # divided by a safe number, or a point at infinity would leave NaN in every
    # derivative
    return lam, mu, jnp.where(parallel, 0.0, 1 / jnp.where(parallel, 1.0, squared))


def halfway(
    first: Vector, second: Vector, base: Vector, lam: Scalar, mu: Scalar
) -> Vector:
    """The model point halfway between λ r1 and b + μ r2."""
    return tuple(
        (lam * p + b + mu * s) / 2 for p, b, s in zip(first, base, second, strict=True)
    )  # pyright: ignore
