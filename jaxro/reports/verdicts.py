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
  that fit but that no other point checks, the undecided points and the elements by
  round.

What a statistic is, and its unit, says the procedure; inf: wrong by any measure. A
point that `recommended` rejected with a statistic below its limit fits, but no other
point checks it.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..geometry.elements import IndependentElements
from ..rejection import Rejection
from ..tables.measured import Table, take
from .columns import CLEANED, OUTCOME_ADVICE, OUTCOME_NAMES, ROUNDS, Column, Units
from .files import json_text, table_text

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
        outcome=found.outcome._value,
    )


def unusable(kept: Either, order: Either) -> Either:
    """The points that went without a round, because they hold no numbers or were masked
    before."""
    return ~kept & (order == 0)


def without_log(found: Rejection) -> tuple[Any, dict[str, Any]]:
    """The outcome of a pair; the decision about every point."""
    of_points = decision(found)._asdict()
    return {"outcome": of_points.pop("outcome")}, of_points


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


@dataclass(frozen=True)
class Verdicts:
    """Pairs with the decision about their points, all of which `table` holds.

    `outcome`: numbers of `OUTCOMES`. `of_points`: the columns of a `Decision`, and q,
    the y-parallax at the orientation of the points kept. `rounds`: if asked for.
    """

    table: Table
    outcome: Int[np.ndarray, " pair"]
    of_points: dict[str, np.ndarray]
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
        }
        return CLEANED, table.numbers | found | values | {"order": order}


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
        "elements": [
            {"round": k, **dict(zip(names, np.rad2deg(values).tolist(), strict=True))}
            for k, values in enumerate(by_round, 1)
        ],
    }
