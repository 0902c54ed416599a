"""Which members of a family are linked, and the factorised matrix of their normal
equations with everything that is read of it: solutions, parts of the inverse, and the
products of the whole inverse by some columns.

Everything here is NumPy on the host: it calls LAPACK, which compiled programs must not.
"""

from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol, runtime_checkable

import jax
import numpy as np
from jaxtyping import Bool, Float, Int

from . import block_tridiagonal as tridiagonal
from .block_tridiagonal import Levels, Singular as Singular

CHUNK = 1 << 14
"""Pairs of sightings that are worked on at once."""

BEYOND = 1 << 30
"""A slot that there is not."""


SMALL, LEAST_ROOM = 1 << 12, 16
"""Up to so many things the next power of two has room for them, from so many on."""


def room_for(number: int) -> int:
    """Room for a number of things, so that problems of nearly the same size share their
    programs: of many, which take long to work on, at most a quarter more."""
    octave = max(number - 1, 0).bit_length()
    if number <= SMALL:
        return max(LEAST_ROOM, 1 << octave)
    step = 1 << octave - 3
    return -(-number // step) * step


class Pattern(NamedTuple):
    """Where the blocks of the matrix come from.

    A sighting is a group that touches an eliminated and a linked block: `point` and
    `block`. Two sightings `p`, `q` of one point go to a `slot` (in chunks; beyond the
    last slot where there are no more); `both` where they are of two different blocks.
    `direct`: the slots of groups that touch two linked blocks.
    """

    point: Int[np.ndarray, " sighting"]
    block: Int[np.ndarray, " sighting"]
    p: Int[np.ndarray, "chunk pair"]
    q: Int[np.ndarray, "chunk pair"]
    slot: Int[np.ndarray, "chunk pair"]
    both: Bool[np.ndarray, "chunk pair"]
    direct: tuple[Int[np.ndarray, " group"], ...]


class Slots(NamedTuple):
    """Slot s holds the block N[first[s], second[s]], first >= second; the slots of the
    diagonal come first."""

    first: Int[np.ndarray, " slot"]
    second: Int[np.ndarray, " slot"]


class Reduced(NamedTuple):
    """The normal equations after the elimination: the blocks of S, its right-hand side,
    B, C and the right-hand side of the common parameters."""

    blocks: Float[jax.Array, "slot d d"]
    h: Float[jax.Array, "block d"]
    border: Float[jax.Array, "block d c"]
    common: Float[jax.Array, "c c"]
    b: Float[jax.Array, " c"]


class Carried(NamedTuple):
    """What leads from the reduced system back to the eliminated blocks: V⁻¹ with the
    least pivot of each V, g, X, and W of each sighting; and of the whole system the
    right-hand sides and the diagonals, of which the promise of a step is made."""

    inverse: Float[jax.Array, "point p p"]
    pivots: Float[jax.Array, " point"]
    g: Float[jax.Array, "point p"]
    x: Float[jax.Array, "point p c"]
    w: Float[jax.Array, "sighting p d"]
    right: tuple[Float[jax.Array, "block d"], Float[jax.Array, " c"]]
    diagonals: tuple[
        Float[jax.Array, "block d"], Float[jax.Array, " c"], Float[jax.Array, "point p"]
    ]


class Anchor(NamedTuple):
    """A direction in which a member is held while a free network is solved."""

    block: int
    direction: Float[np.ndarray, " d"]


class Datum(NamedTuple):
    """What a free network is referred to: `rows` times the step of the linked blocks
    is to become `rest`. The `anchors`, as many, determine the solution that is moved
    there."""

    rows: Float[np.ndarray, "k block d"]
    rest: Float[np.ndarray, " k"]
    anchors: tuple[Anchor, ...]


def pattern(
    point: Int[np.ndarray, " sighting"],
    block: Int[np.ndarray, " sighting"],
    use: Bool[np.ndarray, " sighting"],
    direct: list[tuple[Int[np.ndarray, " group"], Int[np.ndarray, " group"]]],
    blocks: int,
) -> tuple[Pattern, Slots]:
    """The `Pattern` of sightings, of which some are in use, and of groups that touch
    two linked blocks."""
    order = np.flatnonzero(use)
    order = order[np.argsort(point[order], kind="stable")]
    pairs = [np.stack([order, order])]
    for lag in range(1, len(order)):
        p, q = order[lag:], order[:-lag]
        same = point[p] == point[q]
        if not np.any(same):
            break
        p, q = p[same], q[same]
        swap = block[p] < block[q]
        pairs.append(np.stack([np.where(swap, q, p), np.where(swap, p, q)]))
        again = block[p] == block[q]
        pairs.append(np.stack([q[again], p[again]]))
    p, q = np.concatenate(pairs, axis=1)
    keys = [block[p] * blocks + block[q]]
    keys += [np.maximum(a, b) * blocks + np.minimum(a, b) for a, b in direct]
    own = np.arange(blocks) * (blocks + 1)
    apart = np.setdiff1d(np.concatenate(keys), own)
    every = np.concatenate([own, apart])
    sorted_slots = np.argsort(every)
    find = lambda key: sorted_slots[np.searchsorted(every, key, sorter=sorted_slots)]
    slot = find(keys[0])
    by_slot = np.argsort(slot, kind="stable")
    p, q, slot = p[by_slot], q[by_slot], slot[by_slot]
    chunk = min(CHUNK, room_for(len(p)))
    missing = -(-room_for(len(p)) // chunk) * chunk - len(p)
    in_chunks = lambda a, none: np.pad(a, (0, missing), constant_values=none).reshape(
        -1, chunk
    )
    meets = Pattern(
        point=point,
        block=block,
        p=in_chunks(p, 0),
        q=in_chunks(q, 0),
        slot=in_chunks(slot, BEYOND),
        both=in_chunks(block[p] != block[q], False),
        direct=tuple(find(key) for key in keys[1:]),
    )
    return meets, Slots(every // blocks, every % blocks)


@dataclass
class Factored:
    """The factorised matrix of linked and common parameters.

    `by_border`: S⁻¹ B, in the order of the places; `corner`: the cofactors of the
    common parameters; `free` is None unless the network is free.
    """

    levels: Levels
    factor: tridiagonal.Factor
    by_border: Float[np.ndarray, "row c"]
    corner: Float[np.ndarray, "c c"]
    size: int
    pivot: float
    free: "Free | None" = None

    def solve(
        self,
        right: Float[np.ndarray, "block d k"],
        common: Float[np.ndarray, "c k"],
    ) -> tuple[Float[np.ndarray, "block d k"], Float[np.ndarray, "c k"]]:
        """The cofactors times some right-hand sides; of a free network those of its
        datum."""
        if self.free is None:
            return self._solve(right, common)
        x, c = self._solve(*self.free.balance(right, common))
        return self.free.move(x, c, to_rest=False)

    def step(
        self, right: Float[np.ndarray, "block d"], common: Float[np.ndarray, " c"]
    ) -> tuple[Float[np.ndarray, "block d"], Float[np.ndarray, " c"]]:
        """The solution that brings a free network to its datum."""
        x, c = self._solve(right[:, :, None], common[:, None])
        if self.free is not None:
            x, c = self.free.move(x, c, to_rest=True)
        return x[:, :, 0], c[:, 0]

    def select(
        self, slots: Slots
    ) -> tuple[
        Float[np.ndarray, "slot d d"],
        Float[np.ndarray, "block d c"],
        Float[np.ndarray, "c c"],
    ]:
        """The cofactors Q[first, second] of linked members, of each of them with the
        common parameters, and of these."""
        first, second = slots
        inverse = tridiagonal.select_inverse(self.factor)
        q = tridiagonal.read_blocks(self.levels, inverse, first, second, self.size)
        y = self._by_member(self.by_border)
        crossed = -y @ self.corner
        q = q - np.einsum("sic,sjc->sij", crossed[first], y[second])
        if self.free is None:
            return q, crossed, self.corner
        free, rows = self.free, len(self.levels.order) * self.size
        at = lambda a: self._by_member(a[:rows], ordered=False)
        links = at(free.movements), at(free.spread)
        common = free.movements[rows:], free.spread[rows:]
        of = lambda slots: (links[0][slots], links[1][slots])
        return (
            q + free.correction(of(first), of(second)),
            crossed + free.correction(links, common),
            self.corner + free.correction(common, common),
        )

    def _solve(self, right, common):
        n, d, k = right.shape
        x = right[self.levels.order].reshape(n * d, k)
        x = tridiagonal.solve(self.factor, x)
        ordered = right[self.levels.order].reshape(n * d, k)
        c = self.corner @ (common - self.by_border.T @ ordered)
        return self._by_member(x - self.by_border @ c), c

    def _by_member(self, rows, ordered: bool = True):
        """Rows in the order of the places as (member, d, column)."""
        parts = rows.reshape(len(self.levels.order), self.size, -1)
        return parts[self.levels.place] if ordered else parts


def change_datum(
    one: tuple[np.ndarray, np.ndarray],
    other: tuple[np.ndarray, np.ndarray],
    held: Float[np.ndarray, "k k"],
    across: Float[np.ndarray, "k k"],
) -> np.ndarray:
    """P Q Pᵀ - Q, P = 1 - G K R, between parameters that are given by their rows of G and
    of F = Q Rᵀ; `held`: K = (R G)⁻¹; `across`: R F."""
    (g, f), (g_other, f_other) = one, other
    turned = lambda a: np.swapaxes(a, -1, -2)
    twice = g @ (held @ across @ held.T) @ turned(g_other)
    once = g @ held @ turned(f_other)
    return twice - once - f @ held.T @ turned(g_other)


@dataclass
class Free:
    """What a free network can do without any residual changing: the `movements` G; K =
    (R G)⁻¹ with the rows R of the datum, which turns what is missing to the datum into
    a movement; and `spread`, F = Q Rᵀ, with the cofactors Q of the anchored network.
    Those of the datum are P Q Pᵀ, P = 1 - G K R.
    """

    datum: Datum
    movements: Float[np.ndarray, "number k"]
    held: Float[np.ndarray, "k k"]
    spread: Float[np.ndarray, "number k"]

    @property
    def rows(self) -> Float[np.ndarray, "k row"]:
        """R, of the linked parameters."""
        return self.datum.rows.reshape(len(self.datum.rest), -1)

    def move(self, x, c, *, to_rest: bool):
        """A solution, moved to the datum's rest, or to zero."""
        flat = x.reshape(self.rows.shape[1], -1)
        missing = -self.rows @ flat
        if to_rest:
            missing = missing + self.datum.rest[:, None]
        moved = self.movements @ (self.held @ missing)
        return x + moved[: len(flat)].reshape(x.shape), c + moved[len(flat) :]

    def balance(self, right, common):
        """Pᵀ times right-hand sides: without what would move the network."""
        flat = right.reshape(self.rows.shape[1], -1)
        both = np.concatenate([flat, common])
        less = self.rows.T @ (self.held.T @ (self.movements.T @ both))
        return right - less.reshape(right.shape), common

    def correction(self, one, other):
        """P Q Pᵀ - Q between parameters, each given by their rows of G and of F."""
        across = self.rows @ self.spread[: self.rows.shape[1]]
        return change_datum(one, other, self.held, across)


def factorise(
    reduced: Reduced, of: Slots, levels: Levels, datum: Datum | None = None
) -> Factored:
    """The `Factored` matrix. Raises `Singular` where it is not positive definite."""
    blocks = np.array(reduced.blocks)[: len(of.first)]
    border = np.asarray(reduced.border)
    n, d, c = border.shape
    held = []
    for block, direction in () if datum is None else datum.anchors:
        weight = direction @ (np.diagonal(blocks[block]) * direction)
        held.append((block, direction * np.sqrt(weight)))
    for block, row in held:
        blocks[block] += np.outer(row, row)
    parts = tridiagonal.assemble(levels, of.first, of.second, blocks)
    factor = tridiagonal.factorise(*parts)
    by_border = tridiagonal.solve(factor, border[levels.order].reshape(n * d, c))
    ordered = border[levels.order].reshape(n * d, c)
    corner, pivot = _inverse(np.asarray(reduced.common) - ordered.T @ by_border)
    pivot = min(pivot, factor.pivot)
    found = Factored(levels, factor, by_border, corner, d, pivot)
    if datum is None:
        return found
    # what the anchors hold alone is what the network leaves free
    k = len(held)
    right = np.zeros((n, d, k))
    for j, (block, row) in enumerate(held):
        right[block, :, j] = row
    none = np.zeros((c, k))
    flat = lambda x, c: np.concatenate([x.reshape(n * d, -1), c])
    movements = flat(*found.solve(right, none))
    spread = flat(*found.solve(np.moveaxis(datum.rows, 0, 2), none))
    try:
        inverse = np.linalg.inv(datum.rows.reshape(k, -1) @ movements[: n * d])
    except np.linalg.LinAlgError:
        raise Singular from None
    found.free = Free(datum, movements, inverse, spread)
    return found


def _inverse(matrix: Float[np.ndarray, "c c"]) -> tuple[np.ndarray, float]:
    """The inverse of a small positive definite matrix, and its least pivot."""
    if len(matrix) == 0:
        return matrix, np.inf
    scale = np.sqrt(np.maximum(np.diagonal(matrix), np.finfo(float).tiny))
    try:
        factor = np.linalg.cholesky(matrix / np.outer(scale, scale))
    except np.linalg.LinAlgError:
        raise Singular from None
    half = np.linalg.inv(factor) / scale
    return half.T @ half, float(np.min(np.diagonal(factor)) ** 2)


@runtime_checkable
class CofactorMatrix(Protocol):
    """The cofactors of all parameters: linked, common, eliminated."""

    def times(self, right: Float[np.ndarray, "row k"]) -> Float[np.ndarray, "row k"]:
        """The matrix times some columns."""
        ...

    def between(self, rows: Int[np.ndarray, " k"]) -> Float[np.ndarray, "k k"]:
        """Its part between some parameters."""
        ...

    @property
    def number(self) -> int:
        """Of all parameters."""
        ...


class Cofactors:
    """The cofactor matrix Q of all parameters, (linked, common, eliminated) one after
    the other, members of a family in their order. It is dense and never written down:
    it is multiplied by columns, through the factor."""

    def __init__(self, factored: Factored, carried: Carried, of: Pattern):
        from scipy.sparse import coo_array

        self._factored = factored
        self._inverse, x, w = (
            np.asarray(a) for a in (carried.inverse, carried.x, carried.w)
        )
        points, p, c = x.shape
        self._shape = len(factored.levels.order), factored.size
        self._x = x.reshape(points * p, c)
        number = lambda member, size: member[:, None] * size + np.arange(size)[None]
        rows = number(of.point, p)[:, :, None]
        columns = number(of.block, factored.size)[:, None, :]
        rows, columns = np.broadcast_arrays(rows, columns)
        at = rows.ravel(), columns.ravel()
        shape = points * p, self._shape[0] * self._shape[1]
        self._w: Any = coo_array((w.ravel(), at), shape).tocsr()

    @property
    def number(self) -> int:
        """Of all parameters."""
        return sum(self._w.shape) + self._x.shape[1]

    def times(self, right: Float[np.ndarray, "row k"]) -> Float[np.ndarray, "row k"]:
        """Q times some columns; of a free network the Q of its datum."""
        (n, d), k = self._shape, right.shape[1]
        ends = n * d, n * d + self._x.shape[1]
        linked, common, own = np.split(right, ends)
        less = self._without(own)
        h = linked - self._w.T @ less
        x, c = self._factored.solve(h.reshape(n, d, k), common - self._x.T @ less)
        x = x.reshape(n * d, k)
        return np.concatenate([x, c, self._without(own - self._w @ x - self._x @ c)])

    def between(self, rows: Int[np.ndarray, " k"]) -> Float[np.ndarray, "k k"]:
        """Q of some parameters."""
        unit = np.zeros((self.number, len(rows)))
        unit[rows, np.arange(len(rows))] = 1.0
        q = self.times(unit)[rows]
        return (q + q.T) / 2

    def _without(self, own):
        """V⁻¹ times columns of the eliminated parameters."""
        parts = own.reshape(*self._inverse.shape[:2], -1)
        return (self._inverse @ parts).reshape(own.shape)
