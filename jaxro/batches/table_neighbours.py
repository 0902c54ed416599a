"""Whether the errors of neighbouring points agree in the pairs of a table, and the
deviations that its orientations then have.

Of one pair the residuals hardly tell by how much and how far neighbours agree: the
correlation found is often 0 or 1. All pairs of a table tell it together, and it is
theirs: of one camera, one film, one way to measure. Regions of pairs whose neighbours
agree hold a half of what they promise, or less, where errors are taken as independent
(docs/reliability.md).
"""

from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Bool, Float

from ..assessment import Pattern, neighbours
from ..assessment.correlated import allow_for_neighbours
from ..geometry.elements import RelativePose
from ..geometry.linear import Linear, linearise
from ..geometry.pairs import Coordinates, Pair, mask_unusable
from ..orientation.result import Orientation
from ..xla.programs import compiled
from ..xla.settings import MOMENT, settings_for
from .batch import map_batch
from .buckets import choose
from .padding import sizes
from .ragged import Ragged

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


class Agreeing(NamedTuple):
    """A pair, its orientation, and by how much and how far neighbours agree; batches of
    them have leading axes."""

    pair: Pair
    orientation: Orientation
    rho: Float[Any, "*pairs"]
    length: Float[Any, "*pairs"]

    @property
    def x_left(self) -> Float[Any, "*pairs point"]:
        """Of the pair, by which batches are split."""
        return self.pair.x_left


def allow(
    pairs: Pair, orientations: Orientation, threads: int | None = None
) -> tuple[Orientation, Pattern | None]:
    """The orientations of a batch, (pair, point), with the deviations that they have
    where neighbours agree, and what all pairs together tell of that.

    Where their test finds nothing (`Pattern.flagged`) the orientations are returned as
    they are. Of cleaned pairs give those with the mask of the points that were kept,
    `pairs.with_mask(rejections.mask)`. The pairs must be oriented with rigorous
    residuals.
    """
    host, found = jax.tree.map(np.asarray, (pairs, orientations))
    count, points = host.x_left.shape
    flat = jax.tree.map(lambda a: a.reshape(-1), host)
    columns = [getattr(flat, name) for name in Ragged._fields if name != "begins"]
    ragged = Ragged(np.arange(count + 1) * points, *columns)
    poses = np.stack(jax.tree.leaves(found.pose), axis=-1)
    tells = np.asarray(found.usable) & (found.degrees_of_freedom >= 2)
    pattern = pool(find(ragged, poses, tells))
    if pattern is None or not pattern.flagged:
        return orientations, pattern
    told = (np.full(count, float(x)) for x in (pattern.rho, pattern.length))
    agreeing = Agreeing(pairs, orientations, *told)
    return map_batch(_allow, agreeing, threads=threads), pattern


def _allow(agreeing: Agreeing) -> Orientation:
    return allow_for_neighbours(*agreeing)
