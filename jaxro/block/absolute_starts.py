"""The best similarities to begin with, without any knowledge of the user.

Points known in all three coordinates give the rotation in closed form (Horn
1987). Control in plan or in height alone does not: the 24 rotations of a cube, one of
which is no more than 63° away from any rotation, are tried. Of each rotation scale and
shift follow by linear least squares.
"""

import itertools
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ..adjustment import normal_equations
from ..calibration.starts import least_vector
from ..geometry import rotations as rot
from ..xla.passes import count
from .absolute_model import MeasuredModel
from .absolute_problem import solve, sum_squares
from .absolute_twin import is_minimal, twin
from .similarity import Points, Similarity

SAME = 1.25e-5
"""1 - |cos| of half the angle between two rotations that count as one: 0.6°."""

LARGEST = 15.0
"""Logarithm of the scale in the units of the adjustment, in which it is near 0."""

FULL = 3
"""Points known in all coordinates that give the rotation."""


class Search(NamedTuple):
    """The two best starts, on the first axis, and the least sum of squares of the
    mirror image of the model."""

    starts: Similarity
    mirrored: Float[Array, ""]


def search(measured: MeasuredModel) -> Search:
    """Adjust from all starts, the model and its mirror image, each point with its own
    covariance alone."""
    alone = _without_common(measured)

    def of_sign(sign: Float[Array, ""]) -> tuple[Similarity, Float[Array, " start"]]:
        one = jnp.ones_like(sign)
        mirror = jnp.stack([one, one, sign])
        seen = eqx.tree_at(
            lambda m: (m.points, m.own),
            alone,
            (alone.points * mirror[None], alone.own * mirror[None, :, None]),
        )

        def of_start(start: Similarity) -> tuple[Similarity, Float[Array, ""]]:
            found = solve(seen, start)
            solved = jax.tree.map(lambda a: a[0], found.parameters["model"])
            # what has run away has residuals that no number holds
            sound = jnp.abs(jnp.log(solved.scale)) < LARGEST
            return solved, jnp.where(sound, sum_squares(found), jnp.inf)

        return jax.lax.map(of_start, candidates(seen))

    found, squares = jax.lax.map(of_sign, jnp.array([1.0, -1.0]))
    proper = jax.tree.map(lambda a: a[0], found)
    best = jnp.argmin(squares[0])
    apart = jax.vmap(lambda q: is_apart(q, proper.quaternion[best]))(proper.quaternion)
    other = jnp.argmin(jnp.where(apart, squares[0], jnp.inf))
    first, second = (jax.tree.map(lambda a, k=k: a[k], proper) for k in (best, other))
    exact = is_minimal(measured.known)
    choose = lambda own, found: jnp.where(exact, own, found)
    second = jax.tree.map(choose, twin(measured, first), second)
    two = jax.tree.map(lambda *a: jnp.stack(a), first, second)
    return Search(two, jnp.min(squares[1]))


def is_apart(a: Float[Array, "4"], b: Float[Array, "4"]) -> Bool[Array, ""]:
    """Whether two unit quaternions are different rotations."""
    return 1 - jnp.abs(jnp.sum(a * b)) > SAME


def _without_common(measured: MeasuredModel) -> MeasuredModel:
    """The model with errors of each point alone, which have the covariance of all its
    errors."""

    def root_of(own: Array, common: Array) -> Float[Array, "3 3"]:
        c = own @ own.T + common @ common.T
        rows = [[c[i, j] for j in range(i + 1)] for i in range(3)]
        factor, _ = normal_equations.cholesky(rows)
        zero = jnp.zeros_like(c[0, 0])
        lower = [[*row[:-1], 1 / row[-1], zero, zero][:3] for row in factor]
        return jnp.stack([jnp.stack(row) for row in lower])

    own = jax.vmap(root_of)(measured.own, measured.common)
    nothing = measured.common[:, :, :0]
    return eqx.tree_at(lambda m: (m.own, m.common), measured, (own, nothing))


def candidates(measured: MeasuredModel) -> Similarity:
    """All starts, on the first axis of each array."""
    closed = closed_form(measured.points, measured.ground, measured.known)
    quaternions = jnp.concatenate([closed[None], jnp.asarray(cube())])
    return jax.vmap(lambda q: with_rotation(measured, q))(quaternions)


def cube() -> Float[np.ndarray, "24 4"]:
    """The quaternions of the rotations that turn a cube into itself."""
    found = []
    for q in itertools.product((0.0, 1.0, -1.0), repeat=4):
        entries = [entry for entry in q if entry]
        # q and -q are one rotation
        if len(entries) in (1, 2, 4) and entries[0] > 0:
            found.append(np.array(q) / np.sqrt(len(entries)))
    return np.array(found)


def with_rotation(measured: MeasuredModel, quaternion: Float[Array, "4"]) -> Similarity:
    """The scale and the shift that fit best with this rotation."""
    known, ground = measured.known, measured.ground
    turn = Similarity(jnp.ones(()), quaternion, jnp.zeros(3))
    turned = jax.vmap(turn.to_ground)(measured.points)
    (middle, apart), (ground_middle, ground_apart) = (
        _about_means(a, known) for a in (turned, ground)
    )
    product, square = jnp.sum(apart * ground_apart), jnp.sum(apart**2)
    scale = jnp.abs(product) / jnp.where(square > 0, square, 1.0)
    scale = jnp.where(scale > 0, scale, 1.0)
    return Similarity(scale, quaternion, ground_middle - scale * middle)


def _about_means(
    values: Points, known: Bool[Array, "point 3"]
) -> tuple[Float[Array, "3"], Points]:
    """The mean of each coordinate that is known, and the known ones minus it."""
    number = jnp.maximum(count(known.T), 1.0)
    middle = jnp.sum(jnp.where(known, values, 0.0), axis=0) / number
    return middle, jnp.where(known, values - middle[None], 0.0)


def closed_form(
    points: Points, ground: Points, known: Bool[Array, "point 3"]
) -> Float[Array, "4"]:
    """The rotation of the points that are known in all coordinates, with equal weights:
    the eigenvector of the largest eigenvalue of a matrix of their products (Horn 1987,
    p. 635); no rotation where there are fewer than three."""
    full = jnp.broadcast_to(jnp.all(known, axis=1)[:, None], known.shape)
    (_, a), (_, b) = (_about_means(values, full) for values in (points, ground))
    s = rot.as_matrix(a.T @ b)
    trace = s[0][0] + s[1][1] + s[2][2]
    axial = s[1][2] - s[2][1], s[2][0] - s[0][2], s[0][1] - s[1][0]
    rows = [[trace, *axial]]
    for i in range(3):
        of_row = [s[i][j] + s[j][i] for j in range(3)]
        of_row[i] = of_row[i] - trace
        rows.append([axial[i], *of_row])
    matrix = jnp.stack([jnp.stack(row) for row in rows])
    # above all eigenvalues
    bound = jnp.sqrt(jnp.sum(matrix**2))
    found = least_vector(bound * jnp.eye(4) - matrix)
    told = (jnp.sum(full[:, 0]) >= FULL) & jnp.all(jnp.isfinite(found))
    return jnp.where(told, found, jnp.array([1.0, 0.0, 0.0, 0.0]))
