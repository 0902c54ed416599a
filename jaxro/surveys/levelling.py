"""Levelling: differences of height measured in legs, adjusted as one least-squares
network.

    h(end) - h(start) = rise + v,    Σ v² / q = min,    some heights known.

Legs that follow one another without a junction are one traverse, whose sum D with Q = Σ
q is all that its ends feel of it. So only traverses between nodes (known points,
junctions, free ends) go through `adjustment.adjust`, and inner points follow in closed
form: with the misclosure w = h(last) - h(first) - D at the adjusted nodes, each leg
takes

    v = q w / Q,    r = q / Q times the redundancy number of the traverse,

the proportional distribution of a traverse between two known points. The same numbers
come out of the network of all legs and points. Every leg of a traverse has the same
w-test: an error in one is seen in its traverse, not in which leg.
"""

from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.ops import segment_sum
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from ..adjustment import JointAdjustment, Term, adjust, critical_values as critical
from ..adjustment.guarded import root
from ..adjustment.results import RESULTS
from ..assessment.reliability import UNTESTABLE
from ..xla.passes import total

Places = Sequence[int] | np.ndarray | Array
Flags = Sequence[bool] | np.ndarray | Array
PerPoint = Float[Array, "*batch point"]
PerTraverse = Float[Array, "*batch traverse"]
PerLeg = Float[Array, "*batch leg"]


class Network(eqx.Module):
    """How legs hang together, their order that of the traverses: `leg` is the place of
    each among those given, `turned` -1 where it runs against its traverse, `after` the
    point it leads to, `traverse` the traverse it is part of.

    `first`, `last`: nodes at the ends of every traverse, places in `nodes`, whose
    points are the `free` ones, then the known ones.
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


class Levelled(eqx.Module):
    """An adjusted network; for a batch every field has leading axes. Per point:
    `heights` and their `deviations` (0 where known), for sigma0 = 1. Per traverse, in
    its direction: `misclosure` left between the adjusted nodes, number of `legs` and
    `deviation` of its sum, `redundancy`, `w`, whether it is `testable`, and the
    `detectable` error of any of its legs (infinite where it is not). Per leg, as they
    were given: `corrections` and `leg_redundancy`.

    `limit`: what |w| exceeds with probability `level` without an error. `sigma0` is
    estimated from all misclosures, 1 where the variances of the legs are true; NaN
    without a degree of freedom.
    """

    heights: PerPoint
    deviations: PerPoint
    misclosure: PerTraverse
    legs: PerTraverse
    deviation: PerTraverse
    redundancy: PerTraverse
    w: PerTraverse
    testable: Bool[Array, "*batch traverse"]
    detectable: PerTraverse
    corrections: PerLeg
    leg_redundancy: PerLeg
    sigma0: Float[Array, "*batch"]
    degrees_of_freedom: Int[Array, "*batch"]
    limit: Float[Array, "*batch"]
    result: RESULTS

    @property
    def suspicious(self) -> Bool[Array, "*batch traverse"]:
        """The traverses whose |w| exceeds the limit. Only the largest is evidence of an
        error in its own traverse. If two have the same |w| (joined only by a spur, or a
        loop of two), the error can be in either."""
        return self.testable & (jnp.abs(self.w) > self.limit[..., None])


def adjust_heights(
    network: Network,
    rises: ArrayLike,
    variances: ArrayLike,
    known: ArrayLike,
    *,
    level: float = 0.001,
    power: float = 0.80,
) -> Levelled:
    """Heights of all points from `rises` of the legs with their `variances`; `known`:
    heights (point,), used where the network has them known. `level` and `power` of the
    test of a traverse, as in `reliability.assess`.

    Works under jit, vmap and grad. A program is compiled for every number of nodes, in
    about a second.
    """
    known = jnp.asarray(known, float)
    rise = network.turned * jnp.asarray(rises, float)[network.leg]
    q = jnp.broadcast_to(jnp.asarray(variances, float), rise.shape)[network.leg]
    count = network.first.shape[0]
    together = lambda a: segment_sum(a, network.traverse, count)
    whole, whole_q = together(rise), together(q)
    fixed = known[network.fixed]
    # derivatives come from one step from the solution, in `_refined`, not through the
    # solver
    solved = lax.stop_gradient(
        _solved(network, *lax.stop_gradient((whole, whole_q, fixed)))
    )
    free, cofactor = _refined(network, solved, whole, whole_q, fixed)
    nodes = jnp.concatenate([free, fixed])
    w = nodes[network.last] - nodes[network.first] - whole

    before = jnp.cumsum(together(jnp.ones_like(rise))).astype(int)[network.traverse] - 1
    along = lambda a: _within(jnp.cumsum(a), before, together(a)[network.traverse])
    done, done_q = along(rise), along(q)
    part = done_q / whole_q[network.traverse]
    inner = nodes[network.first][network.traverse] + done + part * w[network.traverse]
    heights = (
        jnp.where(network.known, known, 0.0)
        .at[network.after]
        .set(inner)
        .at[network.nodes]
        .set(nodes)
    )

    a, b = network.first[network.traverse], network.last[network.traverse]
    inner_q = (
        (1 - part) ** 2 * cofactor[a, a]
        + part**2 * cofactor[b, b]
        + 2 * part * (1 - part) * cofactor[a, b]
    )
    inner_q = inner_q + done_q * (1 - part)
    squares = (
        jnp.zeros_like(heights)
        .at[network.after]
        .set(inner_q)
        .at[network.nodes]
        .set(jnp.diagonal(cofactor))
    )

    first, last = network.first, network.last
    r = (
        1
        - (cofactor[first, first] + cofactor[last, last] - 2 * cofactor[first, last])
        / whole_q
    )
    checked = solved.degrees_of_freedom > 0
    variance = total(w**2 / whole_q) / jnp.where(
        checked, solved.degrees_of_freedom, 1
    ).astype(w.dtype)
    testable = r > UNTESTABLE
    safe = jnp.where(testable, r, 1.0)
    share = q / whole_q[network.traverse]
    back = lambda a: jnp.zeros_like(a).at[network.leg].set(a)
    return Levelled(
        heights,
        root(squares),
        w,
        together(jnp.ones_like(rise)),
        jnp.sqrt(whole_q),
        r,
        jnp.where(testable, w / jnp.sqrt(whole_q * safe), 0.0),
        testable,
        jnp.where(
            testable,
            critical.delta_normal(level, power) * jnp.sqrt(whole_q / safe),
            jnp.inf,
        ),
        back(network.turned * share * w[network.traverse]),
        back(share * r[network.traverse]),
        jnp.where(checked, root(variance), jnp.nan),
        solved.degrees_of_freedom,
        critical.normal(level),
        solved.result,
    )


def _within(running: Array, end: Int[Array, " leg"], whole: Array) -> Array:
    """Running sums from the start of each traverse: those of all legs less what was
    summed before it."""
    return running - running[end] + whole


def _solved(
    network: Network, rise: PerTraverse, q: PerTraverse, fixed: Array
) -> JointAdjustment:
    """The free heights, from the rises of the traverses. An end whose height is known
    is part of what is measured."""
    count = network.free.shape[0]

    def condition(first, last, traverse):
        (first_known, first_height), (last_known, last_height), rise = traverse
        return (
            jnp.where(last_known, last_height, last)
            - jnp.where(first_known, first_height, first)
            - rise
        )

    def end(node):
        return node >= count, jnp.where(
            node >= count, fixed[jnp.maximum(node - count, 0)], 0.0
        )

    ends = [
        ("height", jnp.minimum(node, count - 1))
        for node in (network.first, network.last)
    ]
    measured = end(network.first), end(network.last), rise
    term = Term(condition, measured, (None, None, q), touches=ends)
    return adjust(term, {"height": jnp.broadcast_to(fixed[0], (count,))})


def _refined(
    network: Network, solved: JointAdjustment, whole: Array, q: Array, fixed: Array
) -> tuple[Float[Array, " free"], Float[Array, "node node"]]:
    """The free heights and the cofactor of all nodes (zero for known ones), each a
    Newton step from the solution.

    x + Q Aᵀ P (D - A x) and 2 Q - Q N Q change nothing there, and have the derivatives
    of the solution by everything measured; those through the solver would hold a
    callback, with which a compiled program cannot be stored.
    """
    nodes = jnp.arange(network.free.shape[0] + fixed.shape[0])[None, :]
    every = jnp.where(network.last[:, None] == nodes, 1.0, 0.0) - jnp.where(
        network.first[:, None] == nodes, 1.0, 0.0
    )
    a = every[:, : network.free.shape[0]]
    heights = solved.parameters["height"]
    rest = whole - every @ jnp.concatenate([heights, fixed])
    cofactor = (
        2 * solved.cofactor
        - solved.cofactor @ (a.T @ (a / q[:, None])) @ solved.cofactor
    )
    free = heights + solved.cofactor @ (a.T @ (rest / q))
    return free, jnp.pad(cofactor, ((0, fixed.shape[0]), (0, fixed.shape[0])))


def unconnected(start: Places, end: Places, known: Flags) -> np.ndarray:
    """Numbers of the points that no legs join to a known one: their heights are not
    determined."""
    reached = np.array(known, bool)
    ends = np.stack([np.asarray(start), np.asarray(end)])
    while True:
        new = reached[ends].any(axis=0) & ~reached[ends].all(axis=0)
        if not new.any():
            return np.flatnonzero(~reached)
        reached[ends[:, new]] = True


def network(start: Places, end: Places, known: Flags) -> Network:
    """The network of legs from points `start` to `end`, (leg,) each, where `known`
    (point,) says whose height is known.

    Raises ValueError where a leg leads nowhere, points are `unconnected`, or no height
    is sought.
    """
    starts, ends, known = (
        np.asarray(start, int),
        np.asarray(end, int),
        np.asarray(known, bool),
    )
    if np.any(starts == ends):
        raise ValueError(
            f"network: leg {np.flatnonzero(starts == ends)[0]} ends where it starts"
        )
    if (lost := unconnected(starts, ends, known)).size:
        raise ValueError(
            f"network: no legs join the points {lost.tolist()} to one whose height is "
            "known"
        )
    if known.all():
        raise ValueError("network: the heights of all points are known")
    degree = np.bincount(np.concatenate([starts, ends]), minlength=len(known))
    node = known | (degree != 2)
    traverses = _traverses(starts, ends, node)
    if not (
        node & ~known
        # between known points alone: one inner point becomes a node, the same least squares
    ).any():
        longest = max(traverses, key=len)
        node[longest[(len(longest) - 1) // 2][2]] = True
        traverses = _traverses(starts, ends, node)
    free, fixed = np.flatnonzero(node & ~known), np.flatnonzero(known)
    place = np.zeros(len(known), int)
    place[np.concatenate([free, fixed])] = np.arange(len(free) + len(fixed))
    legs = [leg for traverse in traverses for leg in traverse]
    came_from = [starts[t[0][0]] if t[0][1] > 0 else ends[t[0][0]] for t in traverses]
    return Network(
        jnp.array([leg for leg, _, _ in legs]),
        jnp.array([turned for _, turned, _ in legs]),
        jnp.array([after for _, _, after in legs]),
        jnp.array([i for i, traverse in enumerate(traverses) for _ in traverse]),
        jnp.array(place[came_from]),
        jnp.array(place[[t[-1][2] for t in traverses]]),
        jnp.array(free),
        jnp.array(fixed),
        jnp.array(known),
    )


def _traverses(
    starts: np.ndarray, ends: np.ndarray, node: np.ndarray
) -> list[list[tuple[int, float, int]]]:
    """Chains of legs between nodes: (leg, direction, point it leads to)."""
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
                point = int(ends[leg] if forward else starts[leg])
                traverse.append((leg, 1.0 if forward else -1.0, point))
                if not node[point]:
                    leg = next(other for other in at[point] if other != leg)
            if traverse:
                found.append(traverse)
    return found
