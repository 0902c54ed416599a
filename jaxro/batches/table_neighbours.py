"""Whether the errors of neighbouring points agree in the pairs of a table, and the
deviations that its orientations then have.

Of one pair the residuals hardly tell by how much and how far neighbours agree: the
correlation found is often 0 or 1. All pairs of a table tell it together, and it is
theirs: of one camera, one film, one way to measure. Regions of pairs whose neighbours
agree hold a half of what they promise, or less, where errors are taken as independent
(docs/reliability.md).
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..assessment import Pattern, neighbours
from ..assessment.correlated import grown_cofactor
from ..geometry.elements import AbstractElements, RelativePose
from ..geometry.linear import Linear, linearise
from ..geometry.pairs import Coordinates, Pair, mask_unusable
from ..orientation.result import Orientation
from ..xla.programs import compiled
from ..xla.settings import MOMENT, settings_for
from .batch import map_batch
from .buckets import by_size, choose
from .padding import plan_for, sizes
from .ragged import Ragged

AT_ONCE = 1 << 16
"""Points of the pairs that are worked on together."""

PAIRS, POINTS = 100, 200
"""Pairs of a table whose residuals are looked at, at most, and points of each: of more,
every second, third, ... one."""


def find(
    pairs: Ragged,
    poses: Float[np.ndarray, "pair 7"],
    tells: Bool[np.ndarray, " pair"],
) -> dict[int, Pattern]:
    """The test of each of some pairs at their poses, by the numbers of the pairs:
    `tells`, those that are usable and have two degrees of freedom."""
    count = len(pairs.lengths)
    chosen = np.arange(0, count, max(1, -(-count // PAIRS)))
    chosen = chosen[tells[chosen]]
    if not chosen.size:
        return {}
    rows = []
    for begin, end in zip(pairs.begins[chosen], pairs.begins[chosen + 1], strict=True):
        used = begin + np.flatnonzero(pairs.mask[begin:end])
        rows.append(used[:: -(-len(used) // POINTS)])
    thinned = choose(pairs, chosen, rows)
    lengths = thinned.lengths
    batch = thinned.pad_to(np.arange(len(chosen)), sizes(lengths, 1)[0])
    conditions = jax.tree.map(np.asarray, _linearise(batch, poses[chosen]))
    return {
        int(number): neighbours.of_linear(
            *jax.tree.map(lambda a, k=k, n=n: a[k, :n], conditions)
        )
        for k, (number, n) in enumerate(zip(chosen, lengths, strict=True))
    }


@compiled(settings=lambda pairs, _: settings_for(pairs.x_left.size, MOMENT))
def _linearise(
    pairs: Pair, poses: Float[Array, "pair 7"]
) -> tuple[Linear, Coordinates]:
    """The linearised conditions of pairs at their poses, and the coordinates."""

    def one(pair: Pair, pose: Float[Array, "7"]) -> tuple[Linear, Coordinates]:
        used = mask_unusable(pair)[0]
        return linearise(used, RelativePose(*pose)), used.coordinates

    return jax.vmap(one)(pairs, poses)


def pool(patterns: dict[int, Pattern]) -> Pattern | None:
    """What all pairs tell together; None where none tells anything."""
    if not patterns:
        return None
    each = list(patterns.values())
    return neighbours.pool(jax.tree.map(lambda *a: np.stack(a), *each))


def allow(
    pairs: Pair | Ragged, orientations: Orientation
) -> tuple[Orientation, Pattern | None]:
    """The orientations of a batch, (pair, point), or of pairs of any lengths, with the
    deviations that they have where neighbours agree, and what all pairs together tell
    of that.

    Where their test is not sure of it (`Pattern.sure`) the orientations are returned as
    they are. Of cleaned pairs give those with the mask of the points that were kept,
    `pairs.with_mask(rejections.mask)`. The pairs must be oriented with rigorous
    residuals.
    """
    found = jax.tree.map(np.asarray, orientations)
    ragged = pairs if isinstance(pairs, Ragged) else _one_behind_the_other(pairs)
    poses = np.stack(jax.tree.leaves(found.pose), axis=-1)
    tells = np.asarray(found.usable) & (found.degrees_of_freedom >= 2)
    pattern = pool(find(ragged, poses, tells))
    if pattern is None or not pattern.sure:
        return orientations, pattern
    asked = found.elements, found.cofactor, found.degrees_of_freedom
    grown = grow(ragged, *asked, pattern)
    return eqx.tree_at(lambda o: o.cofactor, orientations, grown), pattern


def grow(
    pairs: Ragged,
    elements: AbstractElements,
    cofactor: Float[np.ndarray, "pair 5 5"],
    freedom: Int[np.ndarray, " pair"],
    pattern: Pattern,
) -> Float[np.ndarray, "pair 5 5"]:
    """The cofactors of the elements of oriented pairs where neighbours agree as this
    pattern says; `freedom`: their degrees of freedom."""
    told = (np.full(len(freedom), float(x)) for x in (pattern.rho, pattern.length))
    of_pairs = (elements, cofactor, freedom, *told)
    grown = np.array(cofactor)
    most = lambda size: max(1, AT_ONCE // size)
    for members, size in by_size(pairs, plan_for(pairs.lengths), most):
        own = jax.tree.map(lambda a, members=members: np.asarray(a)[members], of_pairs)
        agreeing = _Agreeing(pairs.pad_to(members, size), *own)
        grown[members] = np.asarray(map_batch(_grow, agreeing))
    return grown


class _Agreeing(NamedTuple):
    """What `grown_cofactor` takes, of one pair or of a batch."""

    pair: Pair
    elements: AbstractElements
    cofactor: Float[Any, "*pairs 5 5"]
    freedom: Int[Any, "*pairs"]
    rho: Float[Any, "*pairs"]
    length: Float[Any, "*pairs"]

    @property
    def x_left(self) -> Float[Any, "*pairs point"]:
        """Of the pair, by which batches are split."""
        return self.pair.x_left


def _grow(agreeing: _Agreeing) -> Float[Array, "5 5"]:
    return grown_cofactor(*agreeing)


def _one_behind_the_other(pairs: Pair) -> Ragged:
    """A batch, (pair, point)."""
    count, points = pairs.x_left.shape
    flat = jax.tree.map(lambda a: np.asarray(a).reshape(-1), pairs)
    columns = [getattr(flat, name) for name in Ragged._fields if name != "begins"]
    return Ragged(np.arange(count + 1) * points, *columns)
