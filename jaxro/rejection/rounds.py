"""Rounds of judgement: the log of a procedure, and the result at its end.

A procedure that judges once calls `conclude_round`. One that rejects point by point
calls `repeat_rounds` and `conclude`.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ..geometry.elements import (
    AbstractElements,
    IndependentElements,
    RelativePose,
    convert,
)
from ..geometry.pairs import Pair
from ..orientation.orient import Orientation
from ..orientation.results import is_usable
from ..xla.kernels import while_loop
from ..xla.passes import count
from .base import OUTCOMES, Log, PointValues, Rejection, no_rivals


class Round(NamedTuple):
    """One judgement of the points in use, with the fields of `Log`: the `statistic` of
    every point, the `limit` it was compared with (one number), the points to leave out
    now (one or several), the residual parallaxes and the elements of the orientation
    that judged."""

    statistic: PointValues
    limit: Float[Array, "..."]
    rejected: Bool[Array, "*pairs point"]
    parallax: PointValues
    elements: Float[Array, "*pairs 5"]


class History(NamedTuple):
    """The state of a procedure after some rounds: the points in use, the fields of
    `Rejection`, and how many rounds there were and how many of them rejected a
    point."""

    mask: Bool[Array, "point"]
    order: Int[Array, "point"]
    statistic: PointValues
    log: Log
    rounds: Int[Array, ""]
    rejections: Int[Array, ""]


def empty_history(pair: Pair, rounds: int) -> History:
    """The state before the first round, with room for `rounds` in the log."""
    # every array depends on the pair, so that all of a batch have its axis
    zero = pair.focal_left * 0
    by_point = jnp.zeros((rounds, pair.x_left.shape[0])) + zero
    by_round = by_point[:, 0]
    log = Log(
        happened=by_round > 1,
        statistic=by_point,
        limit=by_round,
        rejected=by_point > 1,
        parallax=by_point,
        elements=jnp.zeros((rounds, 5)) + zero,
    )
    order = jnp.zeros_like(pair.mask, int)
    none = jnp.sum(order)
    return History(
        mask=pair.mask,
        order=order,
        statistic=pair.x_left * 0,
        log=log,
        rounds=none,
        rejections=none,
    )


def add_round(
    history: History, new: Round, active: Bool[Array, ""] | bool = True
) -> History:
    """The state after one more round; unchanged where the round is not `active`."""
    log = history.log
    slots = jnp.arange(log.limit.shape[0])
    here = (slots == history.rounds) & active

    def write(old: Array, row: Array) -> Array:
        place = here.reshape(-1, *(1,) * jnp.ndim(row))
        return jnp.where(place, row, old)

    out = new.rejected & history.mask & active
    judged = history.mask & active & jnp.isfinite(new.limit)
    rejections = history.rejections + jnp.where(count(out) > 0, 1, 0)
    return History(
        mask=history.mask & ~out,
        order=jnp.where(out, rejections, history.order),
        statistic=jnp.where(judged, new.statistic, history.statistic),
        log=Log(
            happened=log.happened | here,
            statistic=write(log.statistic, new.statistic),
            limit=write(log.limit, new.limit),
            rejected=write(log.rejected, new.rejected),
            parallax=write(log.parallax, new.parallax),
            elements=write(log.elements, new.elements),
        ),
        rounds=history.rounds + jnp.where(active, 1, 0),
        rejections=rejections,
    )


def repeat_rounds(
    judge: Callable[[Bool[Array, "point"]], Round], pair: Pair, most: int
) -> History:
    """Rounds judge(points in use), until one rejects nothing, `most` at most. How many
    points are kept is the business of `judge`."""

    def more(state):
        history, rejecting = state
        return rejecting & (history.rounds < most)

    def body(state):
        history, _ = state
        new = judge(history.mask)
        return add_round(history, new), count(new.rejected) > 0

    history = empty_history(pair, most)
    start = history, count(history.mask) > 0
    # any number that differs from pair to pair
    own = jnp.sum(history.log.limit)
    return while_loop(more, body, start, own)[0]


def rounds_of_one(pair: Pair, least: int) -> int:
    """Rounds that reject one point each until `least` points are left, and one more."""
    return max(pair.x_left.shape[0] - least, 0) + 1


def conclude(
    history: History,
    orientation: Orientation,
    outcome: OUTCOMES,
    undecided: Bool[Array, "point"] | None = None,
) -> Rejection:
    """The result after the last round, with the orientation of the points kept.

    A procedure that finished has the outcome `not_oriented` if that orientation is of
    no use, and else `undecided` if there are undecided points.
    """
    fine = outcome == OUTCOMES.finished
    doubtful = jnp.zeros_like(history.mask)
    if undecided is not None:
        doubtful = undecided & fine
    outcome = OUTCOMES.where(count(doubtful) > 0, OUTCOMES.undecided, outcome)
    useless = fine & ~is_usable(orientation.result)
    return Rejection(
        mask=history.mask,
        order=history.order,
        statistic=history.statistic,
        log=history.log,
        orientation=orientation,
        outcome=OUTCOMES.where(useless, OUTCOMES.not_oriented, outcome),
        undecided=doubtful,
        in_use=history.mask,
        unchecked=history.mask & False,
        rivals=no_rivals(history.mask.shape[0]),
    )


def conclude_round(
    pair: Pair, only: Round, orientation: Orientation, outcome: OUTCOMES
) -> Rejection:
    """The result of a procedure that judges in a single round."""
    history = add_round(empty_history(pair, 1), only)
    return conclude(history, orientation, outcome)


def finished_outcome(pair: Pair) -> OUTCOMES:
    """The ordinary outcome, in the batch shape of the pair."""
    fine = jnp.ones_like(pair.focal_left, bool)
    return finished_if(fine)


def finished_if(enough: Bool[Array, "..."]) -> OUTCOMES:
    """The ordinary outcome if there are enough points, else `nothing_to_test`."""
    return OUTCOMES.where(enough, OUTCOMES.finished, OUTCOMES.nothing_to_test)


def largest(values: PointValues, use: Bool[Array, "point"]) -> Bool[Array, "point"]:
    """Whether a point has the largest value of those in use; the first of equal
    ones."""
    return use & (ranks(values, use) == 0)


def ranks(values: PointValues, use: Bool[Array, "point"]) -> Int[Array, "point"]:
    """How many points in use have a larger value, or an equal value and a lower
    index."""
    index = jnp.arange(values.shape[0])
    larger = values[None, :] > values[:, None]
    equal = values[None, :] == values[:, None]
    earlier = index[None, :] < index[:, None]
    before = larger | (equal & earlier)
    return jnp.sum(jnp.where(before & use[None, :], 1, 0), axis=1)


def keep_at_least(
    least: int,
    rejected: Bool[Array, "point"],
    values: PointValues,
    use: Bool[Array, "point"],
) -> Bool[Array, "point"]:
    """The rejected points of largest value, at most so many that `least` of the points
    in use stay."""
    allowed = jnp.sum(jnp.where(use, 1, 0)) - least
    return rejected & (ranks(values, rejected) < allowed)


def element_values(elements: AbstractElements) -> Float[Array, "*pairs 5"]:
    """The five elements as an array, for the log."""
    return jnp.stack(elements.values(), axis=-1)


def independent_values(pose: RelativePose) -> Float[Array, "*pairs 5"]:
    """The independent elements of a pose as an array, for the log."""
    length = jnp.ones_like(pose.bx)
    return element_values(convert(pose, IndependentElements, length))
