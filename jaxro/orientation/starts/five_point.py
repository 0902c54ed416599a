"""All real essential matrices through five points (Nister 2004, An efficient solution
to the five-point problem).

Five points leave E = x E1 + y E2 + z E3 + w E4. The ten cubic equations

    det E = 0,    2 E Eᵀ E - tr(E Eᵀ) E = 0

are reduced to one polynomial of degree ten in z / w; each of its real roots is one
essential matrix, made exact by Gauss-Newton steps on the cubic equations themselves.

Nothing here calls LAPACK or indexes by a computed number. Arrays carry the problems on
their last axis (see `problems_last`). Degenerate points give fewer solutions or inexact
ones, never NaN.
"""

from functools import partial
from itertools import combinations_with_replacement
from math import comb

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from ...adjustment.null_space import null_space, reflected, reflector
from .problems_last import cross, problems_last

TINY = 1e-300
ROOT_STEPS = 6
POLISHING = 2
RISES = ((1, 2, 3, 4, 5, 6), (7, 8, 9, 10))
# x y z w are the letters 0 1 2 3; the first ten monomials are eliminated (Nister's
# order)
MONOMIALS = tuple(
    f"{m:03d}"
    for m in (
        0,
        111,
        1,
        11,
        2,
        3,
        112,
        113,
        12,
        13,
        22,
        23,
        33,
        122,
        123,
        133,
        222,
        223,
        233,
        333,
    )
)
SQUARES = tuple(combinations_with_replacement(range(4), 2))
# which products of a square and a letter make up each monomial
PRODUCTS = ["".join(sorted(f"{i}{j}{k}")) for i, j in SQUARES for k in range(4)]
COLLECT = [[float(m == product) for product in PRODUCTS] for m in MONOMIALS]


def five_point(
    left: Float[Array, "5 3"], right: Float[Array, "5 3"], *, polished: bool = True
) -> tuple[Float[Array, "10 3 3"], Bool[Array, "10"]]:
    """Every E with p1ᵀ E p2 = 0 for the five points, tr(E Eᵀ) = 2, and which of the ten
    places hold one.

    Image vectors of any length. Places without a solution hold finite numbers without
    meaning. Not `polished`, which takes three fifths of the time, one solution of a
    thousand is off by more than 1e-6.
    """
    essentials, real = (_exact if polished else _rough)(left, right)
    return jnp.moveaxis(essentials, -1, 0), real


def _solve(
    steps: int, left: Float[Array, "5 3 problem"], right: Float[Array, "5 3 problem"]
):
    basis = null_space(
        (left[:, :, None] * right[:, None, :]).reshape(5, 9, -1)
    ).reshape(4, 3, 3, -1)
    matrix = _elimination(constraints(basis))
    z, w, real = _real_roots(determinant(matrix))
    solutions = _polish(basis, essential_coefficients(matrix, z, w), steps)
    essentials = jnp.sum(basis[:, :, :, None] * solutions[:, None, None], axis=0)
    return essentials * jnp.sqrt(2.0), real


_exact, _rough = (problems_last(partial(_solve, steps)) for steps in (POLISHING, 0))


def constraints(basis: Float[Array, "4 3 3 problem"]) -> Float[Array, "10 20 problem"]:
    """The coefficients of the ten cubics (nine of the trace equation, one of the
    determinant) in the monomials."""
    one = jnp.stack([basis[i] for i, _ in SQUARES])
    two = jnp.stack([basis[j] for _, j in SQUARES])
    half = jnp.asarray([0.5 if i == j else 1.0 for i, j in SQUARES], basis.dtype)[
        :, None, None, None
    ]
    outer = jnp.sum(one[:, :, None] * two[:, None], axis=3) * half
    symmetric = outer + jnp.swapaxes(outer, 1, 2)
    trace = symmetric[:, 0, 0] + symmetric[:, 1, 1] + symmetric[:, 2, 2]
    symmetric = (
        symmetric
        - jnp.eye(3, dtype=basis.dtype)[None, :, :, None] * (trace / 2)[:, None, None]
    )
    # term [square, letter]: (E Eᵀ - tr/2) E and row0 . (row1 x row2)
    parts = (symmetric[:, None, :, k, None] * basis[None, :, None, k] for k in range(3))
    cubic = jnp.asarray(sum(parts)).reshape(40, 9, -1)
    normal = (cross(one[:, 1], two[:, 2], 1) + cross(two[:, 1], one[:, 2], 1)) * half[
        :, 0
    ]
    determinant = jnp.sum(normal[:, None] * basis[None, :, 0], axis=2).reshape(
        40, 1, -1
    )
    terms = jnp.concatenate([cubic, determinant], axis=1)
    return jnp.swapaxes(
        jnp.tensordot(jnp.asarray(COLLECT, basis.dtype), terms, 1), 0, 1
    )


def _elimination(m: Float[Array, "10 20 problem"]) -> Float[Array, "3 3 5 problem"]:
    """B(z) of `equations_in_z`, by Householder reflections."""

    def reflect(m, _):
        m = reflected(reflector(m[:, 0]), m)
        below = jnp.pad(m[1:], ((0, 1), (0, 0), (0, 0)))
        return jnp.concatenate(
            [below[:, 1:10], jnp.zeros_like(below[:, :1]), below[:, 10:]], axis=1
        ), m[0]

    def substitute(below, row):
        pivot = jnp.where(jnp.abs(row[:1]) > TINY, row[:1], TINY)
        new = (row[10:] - jnp.sum(row[1:6, None] * below[:5], axis=0)) / pivot
        return jnp.concatenate([new[None], below[:5]]), None

    _, rows = lax.scan(reflect, m, length=10)
    reduced, _ = lax.scan(
        substitute, jnp.zeros_like(rows[4:, 10:]), rows[4:], reverse=True
    )
    return equations_in_z(reduced)


def equations_in_z(
    reduced: Float[Array, "6 10 problem"],
) -> Float[Array, "3 3 5 problem"]:
    """B(z): three equations B (x, y, 1)ᵀ = 0, [equation, unknown, power of z], from the
    last six rows of the eliminated cubics."""
    # ascending powers of z: rows e, f of x²z, x² (then y², xy) combine to e - z f
    reduced = reduced.reshape(3, 2, 10, -1)
    parts = [reduced[:, :, i:j][:, :, ::-1] for i, j in ((0, 3), (3, 6), (6, 10))]
    columns = [jnp.pad(p, ((0, 0), (0, 0), (0, 5 - p.shape[2]), (0, 0))) for p in parts]
    b = jnp.stack(columns, axis=1)
    return b[:, :, 0] - jnp.pad(b[:, :, 1, :-1], ((0, 0), (0, 0), (1, 0), (0, 0)))


def _times(
    p: Float[Array, "3 n problem"], q: Float[Array, "3 m problem"]
) -> Float[Array, "3 k problem"]:
    """Products of polynomials: all pairs of coefficients, each row of pairs shifted by
    one more, summed."""
    n, m = p.shape[1], q.shape[1]
    pairs = jnp.pad(p[:, :, None] * q[:, None], ((0, 0), (0, 0), (0, n), (0, 0)))
    shifted = pairs.reshape(3, n * (m + n), -1)[:, : n * (m + n - 1)].reshape(
        3, n, m + n - 1, -1
    )
    return jnp.sum(shifted, axis=1)


def determinant(b: Float[Array, "3 3 5 problem"]) -> Float[Array, "11 problem"]:
    """det B(z), ascending powers, largest coefficient 1."""
    x1, x2, y1, y2 = (
        jnp.concatenate([b[i:, k, :4], b[:i, k, :4]]) for k in (0, 1) for i in (1, 2)
    )
    c = jnp.sum(_times(b[:, 2], _times(x1, y2) - _times(x2, y1)), axis=0)
    return c / jnp.maximum(jnp.max(jnp.abs(c), axis=0, keepdims=True), TINY)


def _real_roots(c: Float[Array, "11 problem"]):
    """(z, w), max(|z|, |w|) = 1, and which of ten places hold a real root of the sum of
    c_k z^k w^(10-k).

    The roots with |z| <= |w| lie in [-1, 1] after w = 1, the others after z = 1. In
    [-1, 1] the roots of a polynomial lie between those of its derivative (Rolle), so
    from the linear derivative upwards every root has its bracket. Each pass of `RISES`
    treats its degrees with arrays of the size of the highest; unused places stay at 1.
    """
    halves = jnp.stack([c, c[::-1]], axis=1)[:, :, None]
    roots = jnp.ones((2, 0, c.shape[1]), c.dtype)
    for degrees in RISES:
        top = degrees[-1]
        weights = [
            [comb(j + 10 - d, j) if j <= d else 0 for j in range(top + 1)]
            for d in degrees
        ]
        weights = jnp.asarray(weights, c.dtype)[:, :, None, None, None]
        shifted = [
            jnp.pad(halves[10 - d :], ((0, top - d), (0, 0), (0, 0), (0, 0)))
            for d in degrees
        ]
        roots = jnp.pad(
            roots, ((0, 0), (0, top - roots.shape[1]), (0, 0)), constant_values=1.0
        )
        numbers = jnp.asarray(degrees, c.dtype)
        roots, found = lax.scan(_risen, roots, (jnp.stack(shifted) * weights, numbers))
    one = jnp.ones_like(roots)
    z = jnp.stack([roots[0], one[1]]).reshape(20, -1)
    w = jnp.stack([one[0], roots[1]]).reshape(20, -1)
    found = found[-1].reshape(20, -1)
    place = jnp.tensordot(jnp.tri(20, k=-1, dtype=c.dtype), found.astype(c.dtype), 1)
    chosen = found[None] & (place[None] == jnp.arange(10, dtype=c.dtype)[:, None, None])
    real = jnp.any(chosen, axis=1)
    z, w = (jnp.sum(jnp.where(chosen, value[None], 0.0), axis=1) for value in (z, w))
    return jnp.where(real, z, 1.0), w, real


def _risen(roots: Float[Array, "2 n problem"], polynomial):
    """The roots of a polynomial in [-1, 1] from those of its derivative; a bracket
    without one gives its better end."""
    c, degree = polynomial
    edge = jnp.ones_like(roots[:, :1])
    knots = jnp.concatenate([-edge, roots], axis=1)

    def expansion(x):
        """Value, slope and half the curvature (Horner)."""
        p, d, s = c[-1] * jnp.ones_like(x), jnp.zeros_like(x), jnp.zeros_like(x)
        for k in reversed(range(c.shape[0] - 1)):
            s, d, p = s * x + d, d * x + p, p * x + c[k]
        return p, d, s

    a, b = knots[:, :-1], knots[:, 1:]
    value, _, bend = expansion(knots)
    low, high = value[:, :-1], value[:, 1:]
    rising = high >= 0
    found = (low >= 0) != rising
    lower = jnp.abs(low) < jnp.abs(high)
    better = jnp.where(lower, a, b)
    # the ends are extremes of p, except for -1 and 1: start on the parabola of the end
    # nearer to zero
    p, s = jnp.where(lower, low, high), jnp.where(lower, bend[:, :-1], bend[:, 1:])
    reach = jnp.sqrt(jnp.abs(p) / jnp.maximum(jnp.abs(s), TINY))
    x = jnp.where(
        reach < (b - a) / 2, jnp.where(lower, a + reach, b - reach), (a + b) / 2
    )

    def step(_, state):
        """Laguerre's step, cubically convergent; the middle of the bracket where it
        leads far out of it."""
        a, b, x = state
        p, d, s = expansion(x)
        above = (p >= 0) == rising
        a, b = jnp.where(above, a, x), jnp.where(above, x, b)
        root = jnp.sqrt(
            jnp.maximum(
                (degree - 1) ** 2 * d * d - 2 * degree * (degree - 1) * p * s, 0.0
            )
        )
        slope = d + jnp.where(d < 0, -root, root)
        correction = degree * p / jnp.where(jnp.abs(slope) > TINY, slope, TINY)
        inside = jnp.clip(x - correction, a, b)
        return a, b, jnp.where(jnp.abs(correction) <= b - a, inside, (a + b) / 2)

    x = lax.fori_loop(0, ROOT_STEPS, step, (a, b, x))[2]
    return jnp.where(found, x, better), found


def essential_coefficients(
    b: Float[Array, "3 3 5 problem"],
    z: Float[Array, "root problem"],
    w: Float[Array, "root problem"],
):
    """(x, y, z, w) of every root: the null vector of B, the longest cross product of
    two of its rows."""

    def value(c):
        total, power = c[:, :, -1], jnp.ones_like(w)
        for k in reversed(range(c.shape[2] - 1)):
            power = power * w
            total = total * z[None, None] + c[:, :, k] * power[None, None]
        return total

    b = b[:, :, :, None]
    rows = jnp.concatenate([value(b[:, :2, :4]), value(b[:, 2:])], axis=1)
    rows = rows / jnp.maximum(jnp.max(jnp.abs(rows), axis=(0, 1), keepdims=True), TINY)
    normals = cross(rows, jnp.concatenate([rows[1:], rows[:1]]), 1)
    lengths = jnp.sum(normals * normals, axis=1)
    n = jnp.where((lengths[1] > lengths[0])[None], normals[1], normals[0])
    n = jnp.where(
        (lengths[2] > jnp.maximum(lengths[0], lengths[1]))[None], normals[2], n
    )
    a = jnp.stack([n[0], n[1], n[2] * z, n[2] * w])
    return _unit(a)


def _unit(a: Float[Array, "4 root problem"]) -> Float[Array, "4 root problem"]:
    return a * lax.rsqrt(jnp.maximum(jnp.sum(a * a, axis=0), TINY))[None]


def _polish(
    basis: Float[Array, "4 3 3 problem"], a: Float[Array, "4 root problem"], steps: int
):
    """Gauss-Newton on F = (E Eᵀ - tr(E Eᵀ)/2 I) E = 0 over the four coefficients, |a| =
    1."""
    basis = basis[:, :, :, None]
    identity = jnp.eye(3, dtype=a.dtype)[:, :, None, None]

    def step(_, a):
        e = jnp.sum(basis * a[:, None, None], axis=0)
        outer = jnp.sum(e[:, None] * e[None], axis=2)
        m = outer - identity * (outer[0, 0] + outer[1, 1] + outer[2, 2])[None, None] / 2
        f = jnp.sum(m[:, :, None] * e[None], axis=1)
        half = jnp.sum(basis[:, :, None] * e[None, None], axis=3)
        trace = half[:, 0, 0] + half[:, 1, 1] + half[:, 2, 2]
        dm = half + jnp.swapaxes(half, 1, 2) - identity[None] * trace[:, None, None]
        j = jnp.sum(
            dm[:, :, :, None] * e[None, None] + m[None, :, :, None] * basis[:, None],
            axis=2,
        )
        normal = jnp.sum(j[:, None] * j[None], axis=(2, 3)) + a[:, None] * a[None]
        return _unit(a - _solve_four(normal, jnp.sum(j * f[None], axis=(1, 2))))

    return lax.fori_loop(0, steps, step, a)


def _solve_four(
    n: Float[Array, "4 4 10 problem"], r: Float[Array, "4 10 problem"]
) -> Float[Array, "4 10 problem"]:
    """n⁻¹ r by elimination without pivots (n is positive definite)."""
    m = jnp.concatenate([n, r[:, None]], axis=1)
    for k in range(4):
        pivot = m[k] / jnp.maximum(m[k, k : k + 1], 1e-30)
        m = m - m[:, k : k + 1] * pivot[None]
        m = jnp.concatenate([m[:k], pivot[None], m[k + 1 :]])
    return m[:, 4]
