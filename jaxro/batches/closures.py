"""Triplets of photos that do not close: what pairs have in common is in the deviations
of none.

Of three photos of which each two are a pair the rotations close, R_ab R_bc = R_ac, but
for the errors of the three orientations. With w the small turns of the right photos,

    R_ab R_bc R_acᵀ = exp(c),    c = R_ab w_ab + R_ac w_bc - R_ac w_ac,

and c has the covariance that follows from the joint one of the three (`joint`): pairs
that share measurements err alike, and close better than independent ones. Over all
triplets

    ratio = Σ cᵀ C⁻¹ c / (3 · triplets)

is 1 where the deviations are right. Σ cᵀ C⁻¹ c has the variance 2 Σ |C_s^-½ C_st C_t^-½|²
over all two triplets, from which Satterthwaite (1946) takes the degrees of freedom.
Errors of the lens or of the camera that all pairs have do not cancel in a triplet, and
only there are they seen.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..adjustment import critical_values as critical
from ..geometry import rotations as rot
from ..geometry.elements import AbstractElements
from ..orientation.model_errors import root as lower_root
from ..orientation.result import Orientation
from ..xla.programs import compiled
from .buckets import choose, rows_of
from .joint import joint_root
from .ragged import Ragged

MOST = 300
"""Triplets that are looked at; of more every second, third, ... one."""

SURE = 0.001
"""Probability below which triplets are said not to close."""


class Closures(NamedTuple):
    """Closures of triplets, ab, bc and ac being the numbers of their `pairs`: the
    `angles` of c (rad) and `squares` cᵀ C⁻¹ c of each, their pooled `ratio` to what they
    should be, its degrees of `freedom`, and the `probability` of a larger one."""

    photos: tuple[tuple[str, str, str], ...]
    pairs: Int[np.ndarray, "triplet 3"]
    angles: Float[np.ndarray, " triplet"]
    squares: Float[np.ndarray, " triplet"]
    ratio: float
    freedom: float
    probability: float

    @property
    def open(self) -> bool:
        """Whether they do not close beyond chance."""
        return self.probability < SURE

    @property
    def worst(self) -> int:
        """The triplet that closes worst for what its pairs are worth."""
        return int(np.argmax(self.squares))


def close_triplets(
    left: Sequence[str],
    right: Sequence[str],
    pairs: Ragged,
    oriented: Orientation,
    *,
    sigma_known: bool = False,
) -> Closures | None:
    """How the triplets of photos close among oriented pairs, of which `left` and `right`
    name the photos; None where there is no triplet.

    `sigma_known`: whether the sigmas of the pairs are standard deviations; without it
    the mean sigma0 of the pairs is taken for all of them.
    """
    found = jax.tree.map(np.asarray, oriented)
    columns = found.elements, found.cofactor, found.sigma0, found.degrees_of_freedom
    usable = np.asarray(found.usable)
    return close(left, right, pairs, *columns, usable, sigma_known=sigma_known)


def close(
    left: Sequence[str],
    right: Sequence[str],
    pairs: Ragged,
    elements: AbstractElements,
    cofactor: Float[np.ndarray, "pair 5 5"],
    sigma0: Float[np.ndarray, " pair"],
    freedom: Int[np.ndarray, " pair"],
    usable: Bool[np.ndarray, " pair"],
    *,
    sigma_known: bool,
) -> Closures | None:
    """The same of the columns of an orientation."""
    usable = usable & np.all(np.isfinite(lower_root(cofactor)), axis=(1, 2))
    photos, members, sides = _find_triplets(left, right, usable)
    checks = freedom[np.unique(members)]
    if not len(members) or not (sigma_known or np.any(checks)):
        return None
    own, place = np.unique(members, return_inverse=True)
    members = place.reshape(members.shape)
    of_own = lambda names: [names[k] for k in own.tolist()]
    chosen = jax.tree.map(lambda a: np.asarray(a)[own], elements)
    part = choose(pairs, own, rows_of(pairs, own))
    root = joint_root(of_own(left), of_own(right), part, chosen, cofactor[own])
    # repeated up to a power of two, so that tables of different lengths share a program
    room = np.minimum(np.arange(1 << (len(own) - 1).bit_length()), len(own) - 1)
    found = _turns(jax.tree.map(lambda a: a[room], chosen))
    rotations, turns = (np.asarray(a)[: len(own)] for a in found)
    angles, design = _design(members, sides, rotations, turns)
    checked = np.where(checks > 0, sigma0[own] ** 2 * checks, 0.0)
    unit = 1.0 if sigma_known else np.sum(checked) / np.sum(checks)
    white, squares = _whiten(angles, design @ root)
    # the covariance of what each triplet on its own takes for independent
    agree = white @ white.T
    total = 3 * int(np.sum(np.isfinite(squares)))
    if not total:
        return None
    squares = np.nan_to_num(squares)
    degrees = total**2 / float(np.sum(agree.data**2))
    ratio = float(np.sum(squares) / unit / total)
    chance = (
        critical.chi_squared_p(degrees * ratio, degrees)
        if sigma_known
        else critical.fisher_p(ratio, degrees, np.sum(checks))
    )
    return Closures(
        photos=photos,
        pairs=own[members],
        angles=np.linalg.norm(angles, axis=1),
        squares=squares / unit,
        ratio=ratio,
        freedom=degrees,
        probability=float(chance),
    )


def _find_triplets(
    left: Sequence[str], right: Sequence[str], usable: Bool[np.ndarray, " pair"]
) -> tuple[
    tuple[tuple[str, str, str], ...],
    Int[np.ndarray, "triplet 3"],
    Bool[np.ndarray, "triplet 3"],
]:
    """Photos a < b < c, the pairs ab, bc, ac, and whether each has its photos the other
    way round. Of two pairs of the same photos the first one counts."""
    number: dict[tuple[str, str], tuple[int, bool]] = {}
    beside: dict[str, set[str]] = {}
    for k in np.flatnonzero(usable).tolist():
        one, other = left[k], right[k]
        if one != other:
            first, second = min(one, other), max(one, other)
            number.setdefault((first, second), (k, one > other))
            beside.setdefault(first, set()).add(second)
    photos = [
        (a, b, c) for a, b in number for c in sorted(beside[a] & beside.get(b, set()))
    ]
    photos = photos[:: max(1, -(-len(photos) // MOST))]
    found = [[number[a, b], number[b, c], number[a, c]] for a, b, c in photos]
    both = np.array(found, int).reshape(-1, 3, 2)
    return tuple(photos), both[:, :, 0], both[:, :, 1].astype(bool)


@compiled
def _turns(
    elements: AbstractElements,
) -> tuple[Float[Array, "pair 3 3"], Float[Array, "pair 3 5"]]:
    """R, and the small turns of the right photo, about its own axes, by the elements."""

    def of_pair(elements: AbstractElements) -> tuple[Array, Array]:
        def rotation(step: Array) -> Float[Array, "3 3"]:
            return rot.as_array(elements.move(tuple(step)).normalise().relative()[0])

        none = jnp.zeros(5)
        at, slope = rotation(none), jax.jacfwd(rotation)(none)
        turned = jnp.einsum("ji,jkp->ikp", at, slope)
        return at, jnp.stack([turned[2, 1], turned[0, 2], turned[1, 0]])

    return jax.vmap(of_pair)(elements)


def _design(
    members: Int[np.ndarray, "triplet 3"],
    sides: Bool[np.ndarray, "triplet 3"],
    rotations: Float[np.ndarray, "pair 3 3"],
    turns: Float[np.ndarray, "pair 3 5"],
) -> tuple[Float[np.ndarray, "triplet 3"], Any]:
    """c of every triplet, and its derivatives by the elements of all pairs, a sparse
    matrix (3 · triplet, 5 · pair)."""
    from scipy.sparse import coo_array
    from scipy.spatial.transform import Rotation

    each = rotations[members]
    turned = sides[:, :, None, None]
    # a pair the other way round: exp(-w) Rᵀ = Rᵀ exp(-R w)
    ahead = np.where(turned, np.swapaxes(each, 2, 3), each)
    own = np.where(turned, -each, np.eye(3)) @ turns[members]
    ab, bc, ac = (ahead[:, k] for k in range(3))
    closing = ab @ bc @ np.swapaxes(ac, 1, 2)
    # to the axes of photo a: exp(c) = R_ab exp(w) R_bc ..., at R_ab R_bc = R_ac
    before = np.stack([ab, ac, -ac], axis=1)
    entries = before @ own
    count, pairs = len(members), len(rotations)
    lines = np.arange(3 * count).reshape(count, 1, 3, 1)
    columns = 5 * members[:, :, None, None] + np.arange(5)
    lines, columns = np.broadcast_arrays(lines, columns)
    places = lines.ravel(), columns.ravel()
    design = coo_array((entries.ravel(), places), (3 * count, 5 * pairs)).tocsr()
    return Rotation.from_matrix(closing).as_rotvec(), design


def _whiten(
    closures: Float[np.ndarray, "triplet 3"], root: Any
) -> tuple[Any, Float[np.ndarray, " triplet"]]:
    """The root of the covariance of all closures in units of each triplet's own, and
    cᵀ C⁻¹ c; D Dᵀ is their covariance. Zero and NaN of triplets that have none, such as
    three times one photo."""
    from scipy.sparse import block_diag

    parts = [root[3 * k : 3 * k + 3] for k in range(len(closures))]
    own = np.array([(part @ part.T).toarray() for part in parts])
    lower = lower_root(own)
    there = np.all(np.isfinite(lower), axis=(1, 2))
    inverse = np.linalg.inv(np.where(there[:, None, None], lower, np.eye(3)))
    inverse[~there] = 0.0
    white = (block_diag(list(inverse)) @ root).tocsr()
    squares = np.sum(np.einsum("tij,tj->ti", inverse, closures) ** 2, axis=1)
    return white, np.where(there, squares, np.nan)
