"""Levelling: differences of height measured in legs, adjusted as one least-squares
network.

    h(end) - h(start) = rise + v,    Σ v² / q = min,    some heights known.

Legs that follow one another without a junction are one traverse. Its ends depend only
on the sum D of its rises, with the variance Q = Σ q. So only traverses between nodes
(known points, junctions, free ends) go through `adjustment.adjust`, and inner points
follow in closed form: with the misclosure w = h(last) - h(first) - D at the adjusted
nodes, each leg takes

    v = q w / Q,    r = q / Q times the redundancy number of the traverse,

the proportional distribution of a traverse between two known points. The network of all
legs and points has the same solution. Every leg of a traverse has the same w-test: it
shows an error in the traverse, but not in which leg.
"""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from ..adjustment import JointAdjustment, Term, adjust, critical_values as critical
from ..adjustment.critical_values import UNTESTABLE
from ..adjustment.guarded import ratio, root
from ..adjustment.results import RESULTS
from ..xla.passes import total
from .networks import (
    Network as Network,
    PerLeg,
    PerPoint,
    PerTraverse,
    network as network,
)


class Levelled(eqx.Module):
    """An adjusted network; for a batch every field has leading axes.

    Per point: `heights` and their `deviations` (0 where known), for sigma0 = 1. Per
    traverse, in its direction: `misclosure` between the adjusted nodes, number of
    `legs`, `deviation` of the sum of its legs, `redundancy`, `w`, whether it is
    `testable`, and the `detectable` error of any of its legs (infinite where it is
    not). Per leg, as they were given: `corrections` and `leg_redundancy`.

    `limit`: without an error |w| exceeds it with probability `level`. `sigma0` is
    estimated from all misclosures, and about 1 if the variances of the legs are true;
    NaN without a degree of freedom.
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
        """The traverses whose |w| exceeds the limit. Only the largest |w| is evidence
        of an error in its own traverse. If two have the same |w| (joined only by a
        spur, or a loop of two), the error can be in either."""
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
    """Heights of all points from `rises` of the legs with their `variances`.

    `known`: heights (point,), used where the network has them known. `level` and
    `power` of the test of a traverse, as in `reliability.assess`. Works under jit, vmap
    and grad; a program is compiled for every number of nodes.
    """
    known = jnp.asarray(known, float)
    rise = network.turned * jnp.asarray(rises, float)[network.leg]
    q = jnp.broadcast_to(jnp.asarray(variances, float), rise.shape)[network.leg]
    traverses = _Traverses(network.sum_legs(rise), network.sum_legs(q))
    fixed = known[network.fixed]
    # derivatives come from one step from the solution, in `_refine`, not through the
    # solver
    solved = _solve(network, *lax.stop_gradient((traverses, fixed)))
    solved = lax.stop_gradient(solved)
    nodes = _refine(network, solved, traverses, fixed)
    misclosure = nodes.difference(network) - traverses.rise
    heights, deviations = _points(network, nodes, rise, q, misclosure, known)

    r = 1 - nodes.variance_of_difference(network) / traverses.q
    testable = r > UNTESTABLE
    divisor = jnp.where(testable, r, 1.0)
    w = misclosure / jnp.sqrt(traverses.q * divisor)
    detectable = critical.delta_normal(level, power) * jnp.sqrt(traverses.q / divisor)
    share = q / traverses.q[network.traverse]
    corrections = network.turned * share * misclosure[network.traverse]
    return Levelled(
        heights=heights,
        deviations=deviations,
        misclosure=misclosure,
        legs=network.sum_legs(jnp.ones_like(rise)),
        deviation=jnp.sqrt(traverses.q),
        redundancy=r,
        w=jnp.where(testable, w, 0.0),
        testable=testable,
        detectable=jnp.where(testable, detectable, jnp.inf),
        corrections=network.as_given(corrections),
        leg_redundancy=network.as_given(share * r[network.traverse]),
        sigma0=_sigma0(misclosure, traverses.q, solved.degrees_of_freedom),
        degrees_of_freedom=solved.degrees_of_freedom,
        limit=jnp.asarray(critical.normal(level)),
        result=solved.result,
    )


class _Traverses(NamedTuple):
    """The sums of the legs of every traverse: its rise, and the variance q of this."""

    rise: PerTraverse
    q: PerTraverse


class _Nodes(NamedTuple):
    """Heights of all nodes and their cofactors."""

    heights: Float[Array, " node"]
    cofactor: Float[Array, "node node"]

    def difference(self, network: Network) -> PerTraverse:
        """h(last) - h(first) of every traverse."""
        return self.heights[network.last] - self.heights[network.first]

    def variance_of_difference(self, network: Network) -> PerTraverse:
        first, last, c = network.first, network.last, self.cofactor
        return c[first, first] + c[last, last] - 2 * c[first, last]


def _solve(network: Network, traverses: _Traverses, fixed: Array) -> JointAdjustment:
    """The free heights, from the rises of the traverses. The height of a known end is
    part of the observation."""
    count = network.free.shape[0]

    def condition(first, last, traverse):
        (first_known, first_height), (last_known, last_height), rise = traverse
        begin = jnp.where(first_known, first_height, first)
        end = jnp.where(last_known, last_height, last)
        return end - begin - rise

    def known_end(node):
        known = node >= count
        return known, jnp.where(known, fixed[jnp.maximum(node - count, 0)], 0.0)

    free = [jnp.minimum(node, count - 1) for node in (network.first, network.last)]
    measured = known_end(network.first), known_end(network.last), traverses.rise
    cofactor = (None, None, traverses.q)
    term = Term(
        condition, measured, cofactor, touches=[("height", node) for node in free]
    )
    return adjust(term, {"height": jnp.broadcast_to(fixed[0], (count,))})


def _refine(
    network: Network, solved: JointAdjustment, traverses: _Traverses, fixed: Array
) -> _Nodes:
    """The heights and the cofactor of all nodes (zero for known ones), each a Newton
    step from the solution.

    x + Q Aᵀ P (D - A x) and 2 Q - Q N Q change nothing there, and have the derivatives
    of the solution by everything measured; those through the solver would hold a
    callback, with which a compiled program cannot be stored.
    """
    count, known = network.free.shape[0], fixed.shape[0]
    nodes = jnp.arange(count + known)[None, :]
    last = jnp.where(network.last[:, None] == nodes, 1.0, 0.0)
    every = last - jnp.where(network.first[:, None] == nodes, 1.0, 0.0)
    a, q, heights = every[:, :count], solved.cofactor, solved.parameters["height"]
    rest = traverses.rise - every @ jnp.concatenate([heights, fixed])
    free = heights + q @ (a.T @ (rest / traverses.q))
    cofactor = 2 * q - q @ (a.T @ (a / traverses.q[:, None])) @ q
    return _Nodes(
        heights=jnp.concatenate([free, fixed]),
        cofactor=jnp.pad(cofactor, ((0, known), (0, known))),
    )


def _points(
    network: Network,
    nodes: _Nodes,
    rise: PerLeg,
    q: PerLeg,
    misclosure: PerTraverse,
    known: PerPoint,
) -> tuple[PerPoint, PerPoint]:
    """Heights of all points and their standard deviations."""
    traverse, c = network.traverse, nodes.cofactor
    first, last = network.first[traverse], network.last[traverse]
    before = network.running_sum(q)
    part = before / network.sum_legs(q)[traverse]
    inner = nodes.heights[first] + network.running_sum(rise)
    inner = inner + part * misclosure[traverse]
    ends = (1 - part) ** 2 * c[first, first] + part**2 * c[last, last]
    inner_q = ends + 2 * part * (1 - part) * c[first, last] + before * (1 - part)
    other = jnp.where(network.known, known, 0.0)
    heights = network.of_points(nodes.heights, inner, other)
    squares = network.of_points(jnp.diagonal(c), inner_q, jnp.zeros_like(heights))
    return heights, root(squares)


def _sigma0(
    misclosure: PerTraverse, q: PerTraverse, freedom: Int[Array, ""]
) -> Float[Array, ""]:
    squares, checked = total(misclosure**2 / q), freedom > 0
    variance = ratio(squares, freedom.astype(squares.dtype), checked)
    return jnp.where(checked, root(variance), jnp.nan)
