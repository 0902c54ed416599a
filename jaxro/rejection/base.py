"""What a rejection procedure is, and what it returns."""

import abc
import dataclasses
from typing import Any, Protocol, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int

from ..geometry.elements import RelativePose, vertical
from ..geometry.pairs import Pair, double, first_points, pad, quickly, room_for
from ..orientation.orient import Orientation
from ..xla.passes import count
from ..xla.programs import compiled, is_traced
from .judgement import AbstractStep, Judgement, nothing_known

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
        "The rounds or weights did not come to rest, so that the points rejected depend "
        "on the number of rounds. Use the procedure `recommended`."
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
    """The decisions of a procedure by round, (round, ...) each.

    `happened`: whether the round took place; all other fields are zero where it did
    not. `statistic`: the test statistic of every point, infinite for a point that is
    wrong by any measure. `limit`: the value that rejects; infinite in a round that only
    iterates. `rejected`: the points this round rejects. `parallax`: the residual
    y-parallaxes of the points in use, and `elements` (phi1, kappa1, omega2, phi2,
    kappa2) the orientation by which the round judged. There may be room for more rounds
    than there can be.
    """

    happened: Bool[Array, "*pairs round"]
    statistic: Float[Array, "*pairs round point"]
    limit: Float[Array, "*pairs round"]
    rejected: Bool[Array, "*pairs round point"]
    parallax: Float[Array, "*pairs round point"]
    elements: Float[Array, "*pairs round 5"]


class Rivals(eqx.Module):
    """Other consensuses, of points that were rejected: several poses explain some of the
    points each, and none of them by accident.

    `mask`: the points of each; no point is true where there is no such consensus.
    `pose`: of each, by least squares. `probability`: that so many points agree with it by
    accident, as it is judged by (1 where there is none), and `own`, the same of the
    points that were kept, 1 where nobody asked. The last axis is that of the points or
    that of the consensuses.
    """

    mask: Bool[Array, "*pairs rival point"]
    pose: RelativePose
    probability: Float[Array, "*pairs rival"]
    own: Float[Array, "*pairs"]


def no_rivals(points: int) -> Rivals:
    """Those of a procedure that looks for none, of a pair of so many points."""
    none = jnp.zeros(0)
    return Rivals(
        mask=jnp.zeros((0, points), bool),
        pose=vertical(none),
        probability=none,
        own=jnp.ones(()),
    )


class Rejection(eqx.Module):
    """The result of a procedure; for a batch every field has leading axes.

    `mask`: the points kept. `order`: 1 for the points rejected first, 2 for the next,
    and so on; 0 for points kept. `statistic`: the test statistic of every point in the
    round that rejected it, or in the last round. `undecided`: points of which one is
    wrong, but the measurements do not tell which; they are kept. `orientation`: from
    the points `in_use`, those kept but for the undecided one that is most likely wrong.
    `unchecked`: points rejected though they fit, as no other point checks them.
    `rivals`: other consensuses; of procedures that look for none there is no place for
    them.
    """

    mask: Bool[Array, "*pairs point"]
    order: Int[Array, "*pairs point"]
    statistic: Float[Array, "*pairs point"]
    log: Log
    orientation: Orientation
    outcome: OUTCOMES
    undecided: Bool[Array, "*pairs point"]
    in_use: Bool[Array, "*pairs point"]
    unchecked: Bool[Array, "*pairs point"]
    rivals: Rivals

    def first(self, points: int) -> "Rejection":
        """The same without the places behind so many points."""
        if points == self.mask.shape[-1]:
            return self
        of_points = lambda r: [
            *(r.mask, r.order, r.statistic, r.undecided, r.in_use, r.unchecked),
            *(r.rivals.mask, r.log.statistic, r.log.rejected, r.log.parallax),
        ]
        short = eqx.tree_at(of_points, self, first_points(of_points(self), points))
        return dataclasses.replace(short, orientation=self.orientation.first(points))

    def only_if(self, fine: Bool[Array, ""], otherwise: OUTCOMES) -> "Rejection":
        """The same result, with the outcome `otherwise` if it is not `fine`. A pair
        with nothing to test keeps its outcome."""
        untested = self.outcome == OUTCOMES.nothing_to_test
        outcome = OUTCOMES.where(fine | untested, self.outcome, otherwise)
        return dataclasses.replace(self, outcome=outcome)

    def take_back(self, doubtful: Bool[Array, "point"]) -> "Rejection":
        """The same result with the doubtful points kept, and the outcome `undecided`.

        Only a finished result changes, and only if a point is doubtful. The orientation
        stays the one without the points that had been rejected.
        """
        doubtful = doubtful & (self.outcome == OUTCOMES.finished)
        any_doubt = count(doubtful) > 0
        return dataclasses.replace(
            self,
            mask=self.mask | doubtful,
            order=jnp.where(doubtful, 0, self.order),
            outcome=OUTCOMES.where(any_doubt, OUTCOMES.undecided, self.outcome),
            undecided=self.undecided | doubtful,
        )


class AbstractProcedure(eqx.Module):
    """A rule that finds wrong points in one pair. Its tolerances are its fields;
    lengths are in the unit of the coordinates.

    `procedure(pair)` calls `clean` by a program that is compiled once and serves other
    numbers of points, too; under jit, vmap and grad it is a part of the caller's.
    """

    @abc.abstractmethod
    def clean(self, pair: Pair) -> Rejection:
        """Find the wrong points of one pair; works under jit and vmap. Places of the
        pair may be masked."""

    def __call__(self, pair: Pair) -> Rejection:
        """The wrong points of one pair. Raises ValueError for a batch."""
        if pair.x_left.ndim != 1:
            raise ValueError(
                "a procedure takes one pair, but the coordinates have shape "
                f"{pair.x_left.shape}: use jax.vmap, or clean_batch"
            )
        pair = double(pair)
        points = pair.x_left.size
        if is_traced((pair, self)):
            return clean(pair, procedure=self)
        procedure, pair = take_sigma(self, pad(pair, room_for(points)))
        if isinstance(procedure, InSteps):
            found = _in_steps(pair, procedure)
        else:
            found = clean(pair, procedure=procedure)
        return found.first(points)


def take_sigma(
    procedure: AbstractProcedure, pair: Pair
) -> tuple[AbstractProcedure, Pair]:
    """The procedure without a sigma of its own, and the pair (or pairs) with it: one
    program serves those that state a sigma and those that take that of the pair."""
    sigma = getattr(procedure, "sigma", None)
    if sigma is None or pair.roots is not None:
        return procedure, pair  # that both state one is told by the procedure
    own = np.asarray(pair.sigma)
    usable = np.isfinite(own) & (own > 0)  # others say that a point is none
    stated = np.where(usable, np.asarray(sigma, own.dtype), own)
    procedure = dataclasses.replace(procedure, sigma=None)  # pyright: ignore[reportCallIssue]
    return procedure, eqx.tree_at(lambda pair: pair.sigma, pair, stated)


@runtime_checkable
class InSteps(Protocol):
    """A procedure that judges in steps, and concludes from what is known then. Each
    step and the conclusion are programs of their own: small ones, and only those that
    some pair needs."""

    def steps(self) -> list[AbstractStep]:
        """The steps in turn."""
        ...

    def is_usual(self, known: Judgement) -> Bool[Any, "*pairs"]:
        """Whether `conclude_usual` may do for pairs of which so much is known; in NumPy
        or JAX."""
        ...

    def conclude_usual(
        self, pair: Pair, known: Judgement
    ) -> tuple[Rejection, Bool[Array, ""]]:
        """The conclusion without what few pairs need, and whether it holds."""
        ...

    def conclude(self, pair: Pair, known: Judgement) -> Rejection:
        """The result that follows from what is known of a pair."""
        ...


def _in_steps(pair: Pair, procedure: InSteps) -> Rejection:
    """The result for one pair by the programs that it needs."""
    known = nothing_known(*jax.tree.map(np.asarray, (pair.focal_left, pair.mask)))
    for step in procedure.steps():
        if bool(step.is_open(known)):
            known = judge(pair, known, step=step)
            known = jax.tree.map(np.asarray, known)
    if bool(procedure.is_usual(known)):
        found, holds = conclude_usual(pair, known, procedure=procedure)
        if bool(holds):
            return found
    return conclude(pair, known, procedure=procedure)


@compiled(settings=quickly, unit="points")
def clean(pair: Pair, *, procedure: AbstractProcedure) -> Rejection:
    """The result for one pair, as a program."""
    return procedure.clean(pair)


@compiled(settings=quickly, unit="points")
def judge(pair: Pair, known: Judgement, *, step: AbstractStep) -> Judgement:
    """The judgement after a step, as a program."""
    return step.judge(pair, known)


@compiled(settings=quickly, unit="points")
def conclude_usual(
    pair: Pair, known: Judgement, *, procedure: InSteps
) -> tuple[Rejection, Bool[Array, ""]]:
    """The conclusion for the usual pair, as a program."""
    return procedure.conclude_usual(pair, known)


@compiled(settings=quickly, unit="points")
def conclude(pair: Pair, known: Judgement, *, procedure: InSteps) -> Rejection:
    """The conclusion of a procedure, as a program."""
    return procedure.conclude(pair, known)
