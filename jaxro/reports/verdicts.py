"""What a procedure decided about each pair, and the files that say so: cleaned.csv,
decisions.csv, decisions.json.

* cleaned.csv: every row of the input in its order; kept, rejected or undecided (kept,
  though one of the points of its pair that are so named is wrong), when (1: first), the
  statistic and its limit in the round that decided, and the y-parallax q at the
  orientation of the points kept, of rejected points as well.
* decisions.csv: every point in use in every round. Without a limit the round was an
  iteration and no decision.
* decisions.json: the procedure with its tolerances; of each pair the outcome, the
  points in the order of rejection (those of one list went together), those of them
  that fit but that no other point checks, the undecided points, the elements by
  round, and, where other points agree with another pose, all solutions: of each its
  points, its pose, and the probability that they agree by accident.

What a statistic is, and its unit, says the procedure; inf: wrong by any measure. A
point that `recommended` rejected with a statistic below its limit fits, but no other
point checks it.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..geometry.elements import IndependentElements
from ..orientation.pure_rotation import ANGLES
from ..rejection import Rejection
from ..tables.measured import Table, take
from .columns import CLEANED, OUTCOME_ADVICE, OUTCOME_NAMES, ROUNDS, Column, Units
from .files import json_text, table_text
from .reader import report_numbers

Either = Array | np.ndarray


class Decision(NamedTuple):
    """The part of a `Rejection` that is always wanted, with the limit of every
    point."""

    kept: Bool[Either, "point"]
    order: Int[Either, "point"]
    statistic: Float[Either, "point"]
    limit: Float[Either, "point"]
    undecided: Bool[Either, "point"]
    in_use: Bool[Either, "point"]
    unchecked: Bool[Either, "point"]
    rivals: Bool[Either, "point rival"]
    outcome: Int[Either, ""]


def decision(found: Rejection) -> Decision:
    """What was decided, and by which limit."""
    log = found.log
    number = jnp.arange(log.limit.shape[0])
    last = jnp.max(jnp.where(log.happened & jnp.isfinite(log.limit), number, -1))
    when = jnp.where(
        jnp.any(log.rejected, axis=0), jnp.argmax(log.rejected, axis=0), last
    )
    limit = jnp.where(when >= 0, log.limit[when], jnp.inf)
    statistic = jnp.where(unusable(found.mask, found.order), jnp.inf, found.statistic)
    return Decision(
        kept=found.mask,
        order=found.order,
        statistic=statistic,
        limit=limit,
        undecided=found.undecided,
        in_use=found.in_use,
        unchecked=found.unchecked,
        rivals=found.rivals.mask.T,
        outcome=found.outcome._value,
    )


def unusable(kept: Either, order: Either) -> Either:
    """The points that went without a round, because they hold no numbers or were masked
    before."""
    return ~kept & (order == 0)


def without_log(found: Rejection) -> tuple[Any, dict[str, Any]]:
    """The outcome of a pair, and what is told of its consensuses; the decision about every
    point."""
    of_points = decision(found)._asdict()
    rivals, own = found.rivals, found.orientation.pose
    poses = jax.tree.map(lambda a, b: jnp.append(a, b), own, rivals.pose)
    told = {
        "probability": jnp.append(rivals.own, rivals.probability),
        "pose": jax.vmap(report_numbers)(poses, poses),
    }
    return {"outcome": of_points.pop("outcome"), "rivals": told}, of_points


def with_log(found: Rejection) -> tuple[dict[str, Any], dict[str, Any]]:
    """The same, and the rounds that led to it: numbers of points have the round on
    their second axis."""
    of_pair, of_points = without_log(found)
    log = found.log
    of_rounds = {"happened": log.happened, "limit": log.limit, "elements": log.elements}
    by_point = {
        "statistic": log.statistic.T,
        "rejected": log.rejected.T,
        "parallax": log.parallax.T,
    }
    return of_pair | {"rounds": of_rounds}, of_points | {"rounds": by_point}


class Rounds(NamedTuple):
    """Every point in use in every round: the `rows` of the points, the other `columns`
    by name; `elements` (round, 5) of every pair."""

    rows: Int[np.ndarray, " entry"]
    columns: dict[str, np.ndarray]
    elements: list[Float[np.ndarray, "round 5"]]


def read_rounds(of_pair: dict[str, Any], of_points: dict[str, Any]) -> Rounds:
    """The rounds of one pair that took place, from what `with_log` tells of it; rows
    are counted in the pair."""
    happened = np.flatnonzero(of_pair["happened"])
    log = {name: values[:, happened].T for name, values in of_points.items()}
    rejected_before = np.cumsum(log["rejected"], axis=0) > log["rejected"]
    number, point = np.nonzero(~rejected_before)
    columns = {name: values[number, point] for name, values in log.items()}
    columns |= {"round": number + 1, "limit": of_pair["limit"][happened][number]}
    return Rounds(point, columns, [of_pair["elements"][happened]])


def join_rounds(each: Sequence[Rounds], begins: Int[np.ndarray, " pair"]) -> Rounds:
    """The rounds of all pairs, whose points begin with these rows."""
    rows = [one.rows + begin for one, begin in zip(each, begins, strict=True)]
    columns = {
        name: np.concatenate([one.columns[name] for one in each])
        for name in each[0].columns
    }
    return Rounds(
        np.concatenate(rows), columns, [e for one in each for e in one.elements]
    )


class Solution(NamedTuple):
    """A consensus of a pair: its points, its pose (numbers by name: the unit base, angles
    in degrees), and the probability that they agree by accident."""

    rows: Int[np.ndarray, " some"]
    pose: dict[str, float]
    probability: float


@dataclass(frozen=True)
class Verdicts:
    """Pairs with the decision about their points, all of which `table` holds.

    `outcome`: numbers of `OUTCOMES`. `of_points`: the columns of a `Decision`, and q,
    the y-parallax at the orientation of the points kept. `rivals`: the columns of the
    consensuses, which `without_log` tells. `rounds`: if asked for.
    """

    table: Table
    outcome: Int[np.ndarray, " pair"]
    of_points: dict[str, np.ndarray]
    rivals: dict[str, np.ndarray]
    rounds: Rounds | None = None

    @cached_property
    def outcomes(self) -> list[str]:
        """The names of the outcomes."""
        return [OUTCOME_NAMES[number] for number in self.outcome.tolist()]

    @cached_property
    def rejected(self) -> Int[np.ndarray, " some"]:
        """The rows that were rejected: pair by pair, first ones first."""
        out = np.flatnonzero(~self.of_points["kept"])
        order = self.of_points["order"][out]
        return out[np.lexsort((order, self.table.owners[out]))]

    @cached_property
    def undecided(self) -> dict[int, list[str]]:
        """By the number of the pair the points of which one is wrong, none rejected."""
        named: dict[int, list[str]] = {}
        for row in np.flatnonzero(self.of_points["undecided"]):
            named.setdefault(int(self.table.owners[row]), []).append(
                str(self.table.points[row])
            )
        return named

    @cached_property
    def solutions(self) -> dict[int, list[Solution]]:
        """By the number of the pair its solutions, the points kept first; of pairs that
        have more than this one."""
        owners, of_rival = self.table.owners, self.of_points["rivals"]
        pairs = np.unique(owners[np.any(of_rival, axis=1)]).tolist()
        return {pair: list(self._solutions(pair)) for pair in pairs}

    def _solutions(self, pair: int) -> Iterator[Solution]:
        names = "bx", "by", "bz", *(f"{angle}_deg" for angle in ANGLES)
        every = [self.of_points["kept"], *self.of_points["rivals"].T]
        for number, use in enumerate(every):
            rows = np.flatnonzero(use & (self.table.owners == pair))
            if rows.size:
                pose = self.rivals["pose"][pair, number].tolist()
                named = dict(zip(names, pose, strict=True))
                yield Solution(
                    rows, named, float(self.rivals["probability"][pair, number])
                )

    def written(self) -> tuple[Sequence[Column], dict[str, Any]]:
        """The columns of the table of every row with its verdict, and their values."""
        table, found = self.table, self.of_points
        kept = found["kept"]
        order = np.where(kept, -1, found["order"]).astype(np.int32)
        values = {
            "pair": take(table.names, table.owners),
            **table.photos_of_rows,
            "point": table.points,
            "verdict": np.where(kept & found["undecided"], 2, kept.astype(int)),
            "other_solution": self._other_solution,
        }
        return CLEANED, table.numbers | found | values | {"order": order}

    @property
    def _other_solution(self) -> Int[np.ndarray, " row"]:
        """Of every row the number of the other solution that it belongs to, -1 for
        none."""
        of_rival = self.of_points["rivals"]
        number = np.full(len(of_rival), -1, np.int32)
        rows, which = np.nonzero(of_rival)
        number[rows] = which + 1
        return number


def texts(verdicts: Verdicts, units: Units, summary: dict[str, Any]) -> dict[str, str]:
    """The content of the three files by name."""
    columns, values = verdicts.written()
    table, rounds = verdicts.table, verdicts.rounds
    assert rounds is not None
    if table.lines is not None:  # as in the input, where pairs may alternate
        by_line = np.argsort(table.lines)
        values = {name: take(column, by_line) for name, column in values.items()}
    named = {
        "pair": table.names[table.owners[rounds.rows]],
        "point": table.points[rounds.rows],
    }
    return {
        "cleaned.csv": table_text(columns, values, units),
        "decisions.csv": table_text(ROUNDS, rounds.columns | named, units),
        "decisions.json": json_text(summary_of(verdicts, summary)),
    }


def summary_of(verdicts: Verdicts, summary: dict[str, Any]) -> dict[str, Any]:
    """The content of decisions.json."""
    number = range(len(verdicts.table.names))
    return {**summary, "pairs": [_summary(verdicts, k) for k in number]}


def _names(table: Table, rows: Int[np.ndarray, " some"]) -> list[str]:
    """The points of these rows."""
    return list(map(str, table.points[rows]))


def _summary(verdicts: Verdicts, number: int) -> dict[str, Any]:
    """What decisions.json says of a pair."""
    table = verdicts.table
    first, last = np.searchsorted(table.owners[verdicts.rejected], [number, number + 1])
    rejected = verdicts.rejected[first:last]
    together: dict[int, list[str]] = {}
    for row in rejected:
        order = int(verdicts.of_points["order"][row])
        together.setdefault(order, []).append(table.points[row])
    names = [f"{name}_deg" for name in IndependentElements.names]
    outcome, rounds = verdicts.outcomes[number], verdicts.rounds
    by_round = [] if rounds is None else rounds.elements[number]
    return {
        "pair": table.names[number],
        "outcome": outcome,
        "advice": OUTCOME_ADVICE[outcome],
        "points": int(table.lengths[number]),
        "rejected": len(rejected),
        "order": list(together.values()),
        "unchecked": _names(table, rejected[verdicts.of_points["unchecked"][rejected]]),
        "undecided": verdicts.undecided.get(number, []),
        "solutions": [
            {
                "points": _names(table, one.rows),
                "probability": one.probability,
                "elements": one.pose,
            }
            for one in verdicts.solutions.get(number, [])
        ],
        "elements": [
            {"round": k, **dict(zip(names, np.rad2deg(values).tolist(), strict=True))}
            for k, values in enumerate(by_round, 1)
        ],
    }
