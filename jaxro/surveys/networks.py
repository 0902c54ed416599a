"""Networks of levelling: how legs between points form traverses between nodes.

Nodes are the known points, the junctions of more than two legs, and free ends. The legs
between two nodes are one traverse.
"""

from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.ops import segment_sum
from jaxtyping import Array, Bool, Float, Int

Places = Sequence[int] | np.ndarray | Array
Flags = Sequence[bool] | np.ndarray | Array
PerPoint = Float[Array, "*batch point"]
PerTraverse = Float[Array, "*batch traverse"]
PerLeg = Float[Array, "*batch leg"]


class Network(eqx.Module):
    """How the legs of a network form traverses.

    Legs are in the order of the traverses: `leg` is the place of each among those
    given, `turned` -1 if it runs against its traverse, else 1, `after` the point it
    leads to, `traverse` the traverse it is part of. `first`, `last`: nodes at the ends
    of every traverse, as places in `nodes`, which has the `free` points and then the
    `fixed` ones. `known`: whether the height of a point is known.
    """

    leg: Int[Array, " leg"]
    turned: Float[Array, " leg"]
    after: Int[Array, " leg"]
    traverse: Int[Array, " leg"]
    first: Int[Array, " traverse"]
    last: Int[Array, " traverse"]
    free: Int[Array, " free"]
    fixed: Int[Array, " fixed"]
    known: Bool[Array, " point"]

    @property
    def nodes(self) -> Int[Array, " node"]:
        """The points of all nodes."""
        return jnp.concatenate([self.free, self.fixed])

    def sum_legs(self, values: PerLeg) -> PerTraverse:
        """Sums of numbers of the legs over every traverse."""
        return segment_sum(values, self.traverse, self.first.shape[0])

    def running_sum(self, values: PerLeg) -> PerLeg:
        """Sums of numbers of the legs from the start of their traverse."""
        legs = self.sum_legs(jnp.ones_like(values))
        end = (jnp.cumsum(legs).astype(int) - 1)[self.traverse]
        running = jnp.cumsum(values)
        return running - running[end] + self.sum_legs(values)[self.traverse]

    def as_given(self, values: PerLeg) -> PerLeg:
        """Numbers of the legs in the order in which these were given."""
        return jnp.zeros_like(values).at[self.leg].set(values)

    def of_points(self, nodes: Array, inner: PerLeg, other: PerPoint) -> PerPoint:
        """Numbers of the nodes, and of the points to which the legs lead, as numbers of
        all points; `other` where a point is neither."""
        return other.at[self.after].set(inner).at[self.nodes].set(nodes)


def unconnected_points(start: Places, end: Places, known: Flags) -> np.ndarray:
    """Numbers of the points that no legs join to a known point: their heights are not
    determined."""
    reached = np.array(known, bool)
    ends = np.stack([np.asarray(start), np.asarray(end)])
    while True:
        new = reached[ends].any(axis=0) & ~reached[ends].all(axis=0)
        if not new.any():
            return np.flatnonzero(~reached)
        reached[ends[:, new]] = True


def network(start: Places, end: Places, known: Flags) -> Network:
    """The network of legs from points `start` to `end`, (leg,) each; `known` (point,)
    says whose height is known.

    Raises ValueError if a leg ends where it starts, if no legs join a point to a known
    one, and if all heights are known.
    """
    starts, ends = np.asarray(start, int), np.asarray(end, int)
    known = np.asarray(known, bool)
    if np.any(starts == ends):
        raise ValueError(
            f"network: leg {np.flatnonzero(starts == ends)[0]} ends where it starts"
        )
    if (lost := unconnected_points(starts, ends, known)).size:
        raise ValueError(
            f"network: no legs join the points {lost.tolist()} to one whose height is "
            "known"
        )
    if known.all():
        raise ValueError("network: the heights of all points are known")
    degree = np.bincount(np.concatenate([starts, ends]), minlength=len(known))
    node = known | (degree != 2)
    traverses = _traverses(starts, ends, node)
    if not np.any(node & ~known):
        # the adjustment needs a free node: an inner point of the longest traverse
        # becomes one, which changes nothing in the solution
        longest = max(traverses, key=len)
        node[longest[(len(longest) - 1) // 2].after] = True
        traverses = _traverses(starts, ends, node)
    free, fixed = np.flatnonzero(node & ~known), np.flatnonzero(known)
    place = np.zeros(len(known), int)
    place[np.concatenate([free, fixed])] = np.arange(len(free) + len(fixed))
    steps = [step for traverse in traverses for step in traverse]
    numbers = [i for i, traverse in enumerate(traverses) for _ in traverse]
    return Network(
        leg=jnp.array([step.leg for step in steps]),
        turned=jnp.array([step.turned for step in steps]),
        after=jnp.array([step.after for step in steps]),
        traverse=jnp.array(numbers),
        first=jnp.array(place[[traverse[0].before for traverse in traverses]]),
        last=jnp.array(place[[traverse[-1].after for traverse in traverses]]),
        free=jnp.array(free),
        fixed=jnp.array(fixed),
        known=jnp.array(known),
    )


class _Step(NamedTuple):
    """A leg of a traverse, the points before and after it in the direction of the
    traverse, and `turned` -1 if the leg runs against it, else 1."""

    leg: int
    turned: float
    before: int
    after: int


def _traverses(
    starts: np.ndarray, ends: np.ndarray, node: np.ndarray
) -> list[list[_Step]]:
    """Chains of legs between nodes."""
    at: dict[int, list[int]] = {}
    for leg, both in enumerate(zip(starts.tolist(), ends.tolist(), strict=True)):
        for point in both:
            at.setdefault(point, []).append(leg)
    used, found = set(), []
    for begin in np.flatnonzero(node).tolist():
        for leg in at.get(begin, []):
            point, traverse = begin, []
            while leg not in used:
                used.add(leg)
                forward = int(starts[leg]) == point
                after = int(ends[leg] if forward else starts[leg])
                traverse.append(_Step(leg, 1.0 if forward else -1.0, point, after))
                point = after
                if not node[point]:
                    leg = next(other for other in at[point] if other != leg)
            if traverse:
                found.append(traverse)
    return found
