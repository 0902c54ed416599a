"""What every rejection procedure returns, and the round they share."""

import abc
import dataclasses
from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int

from ..adjustment.normal_equations import steps
from ..adjustment.residuals import Residuals
from ..geometry import coplanarity
from ..geometry.elements import (
    AbstractElements,
    IndependentElements,
    RelativePose,
    convert,
)
from ..geometry.pairs import Pair
from ..orientation.orient import orient
from ..orientation.result import Orientation
from ..orientation.results import is_usable
from ..xla.kernels import while_loop
from ..xla.passes import count, total

PointValues = Float[Array, "*pairs point"]


class OUTCOMES(optx.RESULTS):  # pyright: ignore[reportGeneralTypeIssues]
    """How a procedure ended."""

    finished = ""
    operator_needed = (
        "Six points are left and their mean residual parallax is still above the "
        "tolerance: an operator has to look "
        "at this pair."
    )
    nothing_to_test = "The procedure does not apply: too few points to reject any."
    no_consensus = (
        "No orientation was found that so many points agree with that it cannot be an "
        "accident: what is kept and "
        "rejected here proves nothing. Measure more points, and see whether the "
        "standard deviation is the right one."
    )
    did_not_rest = (
        "The weights did not come to rest, so that the points rejected depend on the "
        "number of rounds. Use another "
        "weight function, or the procedure `recommended`."
    )
    no_choice = (
        "No choice of so few omissions as are tried passes the global test: more "
        "points are wrong, or the standard "
        "deviation is too small. Use the procedure `recommended`."
    )
    undecided = (
        "One more point is wrong, and the others do not tell which: leaving out any "
        "one of those that are named "
        "explains the misfit as well, so that none of them is rejected. Measure them "
        "again, or more points beside them."
    )
    not_oriented = (
        "The points that were kept do not orient the pair; see the result of its "
        "orientation."
    )


class Log(eqx.Module):
    """The decisions by round, (round, ...) each; rounds that did not take place are
    zero.

    A round with an infinite limit is an iteration and no decision.

    `statistic` of every point (inf: wrong by any measure), the `limit` it was held
    against, the points `rejected`, the residual `parallax` (of points in use) and the
    `elements` (phi1, kappa1, omega2, phi2, kappa2) it was judged by.
    """

    happened: Bool[Array, "*pairs round"]
    statistic: Float[Array, "*pairs round point"]
    limit: Float[Array, "*pairs round"]
    rejected: Bool[Array, "*pairs round point"]
    parallax: Float[Array, "*pairs round point"]
    elements: Float[Array, "*pairs round 5"]


class Rejection(eqx.Module):
    """What a procedure decided; for a batch every field has leading axes.

    `mask`: points kept. `order`: 1 for the points rejected first, 2 for the next, ...;
    0 for those kept. `statistic`: of every point, in the round that rejected it or else
    in the last one. `orientation`: of the points kept. `undecided`: points of which one
    is wrong, though nothing tells which; they are kept.
    """

    mask: Bool[Array, "*pairs point"]
    order: Int[Array, "*pairs point"]
    statistic: Float[Array, "*pairs point"]
    log: Log
    orientation: Orientation
    outcome: OUTCOMES
    undecided: Bool[Array, "*pairs point"]

    def only_if(self, fine: Bool[Array, ""], otherwise: OUTCOMES) -> "Rejection":
        """The same decision, with another outcome where it is not fine and there was
        something to test."""
        outcome = OUTCOMES.where(
            fine | (self.outcome == OUTCOMES.nothing_to_test), self.outcome, otherwise
        )
        return dataclasses.replace(self, outcome=outcome)

    def taking_back(self, named: Bool[Array, "point"]) -> "Rejection":
        """The same decision, if it is finished, with the outcome `undecided` between
        the points named, none of which is rejected. The orientation stays the one
        without those that were."""
        finished = self.outcome == OUTCOMES.finished
        named = named & finished
        any_named = count(named) > 0
        return dataclasses.replace(
            self,
            mask=self.mask | named,
            order=jnp.where(named, 0, self.order),
            outcome=OUTCOMES.where(any_named, OUTCOMES.undecided, self.outcome),
            undecided=self.undecided | named,
        )


class AbstractProcedure(eqx.Module):
    """A rule that finds wrong points in one pair; tolerances are its fields, lengths in
    the unit of the coordinates."""

    @abc.abstractmethod
    def __call__(self, pair: Pair) -> Rejection:
        """Judge one pair; works under jit and vmap."""


class Round(NamedTuple):
    """One judgement of the points in use: `rejected` are those to leave out now."""

    statistic: PointValues
    limit: Float[Array, "..."]
    rejected: Bool[Array, "*pairs point"]
    parallax: PointValues
    elements: Float[Array, "*pairs 5"]


class History(NamedTuple):
    """What is known after some rounds."""

    mask: Bool[Array, "point"]
    order: Int[Array, "point"]
    statistic: PointValues
    log: Log
    rounds: Int[Array, ""]
    rejections: Int[Array, ""]


def began(pair: Pair, rounds: int) -> History:
    """No round yet, with room for `rounds` in the log."""
    n = pair.x_left.shape[0]
    zero = pair.focal_left * 0
    wide = jnp.zeros((rounds, n)) + zero
    log = Log(
        wide[:, 0] > 1, wide, wide[:, 0], wide > 1, wide, jnp.zeros((rounds, 5)) + zero
    )
    none = jnp.zeros_like(pair.mask, int)
    return History(pair.mask, none, pair.x_left * 0, log, jnp.sum(none), jnp.sum(none))


def recorded(
    history: History, new: Round, active: Bool[Array, ""] | bool = True
) -> History:
    """The history after one more round (unchanged where it is not `active`)."""
    here = (jnp.arange(history.log.limit.shape[0]) == history.rounds) & active
    log = Log(
        history.log.happened | here,
        *(
            jnp.where(here.reshape(-1, *(1,) * jnp.ndim(row)), row, old)
            for old, row in (
                (history.log.statistic, new.statistic),
                (history.log.limit, new.limit),
                (history.log.rejected, new.rejected),
                (history.log.parallax, new.parallax),
                (history.log.elements, new.elements),
            )
        ),
    )
    out = new.rejected & history.mask & active
    judged = history.mask & active & jnp.isfinite(new.limit)
    rejections = history.rejections + jnp.where(count(out) > 0, 1, 0)
    return History(
        history.mask & ~out,
        jnp.where(out, rejections, history.order),
        jnp.where(judged, new.statistic, history.statistic),
        log,
        history.rounds + jnp.where(active, 1, 0),
        rejections,
    )


def repeated(
    judge: Callable[[Bool[Array, "point"], History], Round], history: History
) -> History:
    """Rounds until one rejects nothing, or the log is full."""
    most = history.log.limit.shape[0]

    def more(state):
        history, busy = state
        return busy & (history.rounds < most)

    def body(state):
        history, _ = state
        new = judge(history.mask, history)
        return recorded(history, new), count(new.rejected) > 0

    start = history, jnp.asarray(most > 0) & (count(history.mask) > 0)
    return while_loop(more, body, start, jnp.sum(history.log.limit))[
        0
    ]  # any number that differs from pair to pair


def largest(values: PointValues, use: Bool[Array, "point"]) -> Bool[Array, "point"]:
    """Whether a point has the largest value of those in use; of equal ones the
    first."""
    return use & (ranks(values, use) == 0)


def ranks(values: PointValues, use: Bool[Array, "point"]) -> Int[Array, "point"]:
    """How many of the points in use have a larger value (or an equal one and stand
    before)."""
    index = jnp.arange(values.shape[0])
    before = (values[None, :] > values[:, None]) | (
        (values[None, :] == values[:, None]) & (index[None, :] < index[:, None])
    )
    return jnp.sum(jnp.where(before & use[None, :], 1, 0), axis=1)


def at_most(
    rejected: Bool[Array, "point"],
    values: PointValues,
    use: Bool[Array, "point"],
    least: int,
):
    """The rejected points of largest value, so many that `least` points stay."""
    allowed = jnp.sum(jnp.where(use, 1, 0)) - least
    return rejected & (ranks(values, rejected) < allowed)


def mean_of(values: PointValues, use: Bool[Array, "point"]) -> Float[Array, ""]:
    """Mean over the points in use."""
    return total(jnp.where(use, values, 0.0)) / jnp.maximum(count(use), 1.0)


def zero_elements(pair: Pair) -> IndependentElements:
    """Where the papers begin."""
    zero = jnp.zeros_like(pair.focal_left)
    return IndependentElements(zero, zero, zero, zero, zero)


def by_parallax(
    pair: Pair,
    mask: Bool[Array, "point"],
    start: AbstractElements | None = None,
    max_steps: int = 30,
) -> Orientation:
    """The strict orientation of the papers: q of unit weight, independent elements,
    from zero if no start is given."""
    return orient(
        pair.with_sigma(1.0).with_mask(mask),
        elements=IndependentElements,
        residual=coplanarity.parallax,
        start=zero_elements(pair) if start is None else start,
        max_steps=max_steps,
    )


def parallaxes(
    pair: Pair, mask: Bool[Array, "point"], elements: AbstractElements
) -> PointValues:
    """q of the points in use at given elements."""
    return residuals_at(pair, mask, elements)((jnp.zeros_like(pair.focal_left),) * 5)


def iterated(
    pair: Pair, mask: Bool[Array, "point"], elements: AbstractElements
) -> AbstractElements:
    """The elements after one iteration of the strict solution."""
    zero = (jnp.zeros_like(pair.focal_left),) * 5
    return elements.move(
        steps(residuals_at(pair, mask, elements), zero, 1, float("inf"))
    )


def residuals_at(
    pair: Pair, mask: Bool[Array, "point"], elements: AbstractElements
) -> Residuals:
    """The parallaxes of the points in use as a function of a displacement of the
    elements."""
    unit = pair.with_sigma(1.0).with_mask(mask)
    return Residuals(coplanarity.parallax(unit), elements)


def values(elements: AbstractElements) -> Float[Array, "*pairs 5"]:
    """The five elements as an array, for the log."""
    return jnp.stack(elements.values(), axis=-1)


def independent(pose: RelativePose) -> Float[Array, "*pairs 5"]:
    """The independent elements of a pose, for the log."""
    return values(convert(pose, IndependentElements, jnp.ones_like(pose.bx)))


def ended(
    history: History,
    orientation: Orientation,
    outcome: OUTCOMES,
    undecided: Bool[Array, "point"] | None = None,
) -> Rejection:
    """The verdict. Where the procedure finished, `not_oriented` if the points kept do
    not orient the pair, and `undecided` if there are such points."""
    none = jnp.zeros_like(history.mask)
    fine = outcome == OUTCOMES.finished
    named = none if undecided is None else undecided & fine
    outcome = OUTCOMES.where(count(named) > 0, OUTCOMES.undecided, outcome)
    outcome = OUTCOMES.where(
        fine & ~is_usable(orientation.result), OUTCOMES.not_oriented, outcome
    )
    return Rejection(
        mask=history.mask,
        order=history.order,
        statistic=history.statistic,
        log=history.log,
        orientation=orientation,
        outcome=outcome,
        undecided=named,
    )


def finished(pair: Pair) -> OUTCOMES:
    """The ordinary outcome, of the batch shape of the pair."""
    fine = jnp.ones_like(pair.focal_left, bool)
    return OUTCOMES.where(fine, OUTCOMES.finished, OUTCOMES.nothing_to_test)
