"""What a procedure decided about each pair, and the files that say so: cleaned.csv,
decisions.csv, decisions.json.

* cleaned.csv: every row of the input in its order; kept, rejected or undecided (kept,
  though one of the points of its pair that are so named is wrong), when (1: first), the
  statistic and its limit in the round that decided, and the y-parallax q at the
  orientation of the points kept, of rejected points as well.
* decisions.csv: every point in use in every round. Without a limit the round was an
  iteration and no decision.
* decisions.json: the procedure with its tolerances; of each pair the outcome, the
  points in the order of rejection (those of one list went together), the undecided
  points and the elements by round.

What a statistic is, and its unit, says the procedure; inf: wrong by any measure.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..geometry.elements import IndependentElements
from ..rejection import OUTCOMES, Log, Rejection
from ..tables.csv import COLUMNS, Measurements
from .files import csv_text, head, json_text

NAMES = {int(item._value): name for name, item in OUTCOMES._name_to_item.items()}
"""Names of the outcomes by their number."""

ADVICE = {name: OUTCOMES[item] for name, item in OUTCOMES._name_to_item.items()}
"""The sentence of each outcome, empty where the procedure finished."""


Either = Array | np.ndarray


class Decision(NamedTuple):
    """The part of a `Rejection` that is always wanted, with the limit of every
    point."""

    kept: Bool[Either, "point"]
    order: Int[Either, "point"]
    statistic: Float[Either, "point"]
    limit: Float[Either, "point"]
    undecided: Bool[Either, "point"]
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
        outcome=found.outcome._value,
    )


def unusable(kept: Either, order: Either) -> Either:
    """The points that went without a round, because they hold no numbers or were masked
    before."""
    return ~kept & (order == 0)


def without_log(found: Rejection) -> tuple[Decision, None]:
    """The decision alone."""
    return decision(found), None


def with_log(found: Rejection) -> tuple[Decision, Log]:
    """The decision and all that led to it."""
    return decision(found), found.log


@dataclass(frozen=True)
class Verdict:
    """One pair with the decision about its points, NumPy values without padding.

    `parallax`: of every point at the orientation of those kept, NaN where that is not
    usable. `log`: the rounds that took place, if asked for.
    """

    measured: Measurements
    decision: Decision
    parallax: np.ndarray
    log: Log | None = None

    @cached_property
    def outcome(self) -> str:
        """The name of the outcome."""
        return NAMES[int(self.decision.outcome)]

    @cached_property
    def finished(self) -> bool:
        """Whether the procedure came to its ordinary end."""
        return self.outcome == "finished"

    @cached_property
    def rejected(self) -> list[int]:
        """The points rejected, first ones first."""
        order = np.asarray(self.decision.order)
        out = np.flatnonzero(~np.asarray(self.decision.kept))
        return out[np.argsort(order[out], kind="stable")].tolist()

    @cached_property
    def undecided(self) -> list[str]:
        """The names of the points of which one is wrong, none of them rejected."""
        return [
            self.measured.points[i] for i in np.flatnonzero(self.decision.undecided)
        ]

    def rounds(self) -> Iterator[tuple]:
        """(statistic, limit, rejected, parallax, elements) of every round, if they were
        asked for."""
        if self.log is not None:
            g = self.log
            yield from zip(
                g.statistic,
                map(float, g.limit),
                g.rejected,
                g.parallax,
                g.elements,
                strict=True,
            )

    def without_parallax(self) -> "Verdict":
        """The same where the points kept have no usable orientation."""
        return replace(self, parallax=np.full_like(self.parallax, np.nan))

    @cached_property
    def kept(self) -> Measurements:
        """The measurements of the points kept."""
        use = np.flatnonzero(self.decision.kept)
        m = self.measured
        return Measurements(
            m.name,
            [m.points[i] for i in use],
            [m.rows[i] for i in use],
            [m.lines[i] for i in use],
        )


def verdict(
    measured: Measurements, found: Decision, parallax: np.ndarray, log: Log | None
) -> Verdict:
    """The verdict on one pair from padded arrays; copies, so that those of a whole
    batch can go."""
    n = len(measured.points)
    own = Decision(*(np.array(a[:n] if np.ndim(a) else a) for a in found))
    rounds = None if log is None else np.flatnonzero(log.happened)
    return Verdict(
        measured,
        own,
        np.array(parallax[:n]),
        log and jax.tree.map(lambda a: a[rounds], log),
    )


def texts(
    verdicts: list[Verdict], unit: str, summary: dict[str, Any]
) -> dict[str, str]:
    """The content of the three files by name."""
    return {
        "cleaned.csv": csv_text(_point_rows(verdicts, unit)),
        "decisions.csv": csv_text(_round_rows(verdicts, unit)),
        "decisions.json": json_text(
            {**summary, "pairs": [_summary(v) for v in verdicts]}
        ),
    }


def _point_rows(verdicts: list[Verdict], unit: str) -> list[list[Any]]:
    sigma = [] if verdicts[0].measured.sigma is None else ["sigma"]
    header = [
        "pair",
        *COLUMNS.required,
        *sigma,
        "verdict",
        "order",
        "statistic",
        "limit",
        head("q", unit),
    ]
    rows: list[tuple[int, list[Any]]] = []
    for v in verdicts:
        m, d = v.measured, v.decision
        columns = (
            m.lines,
            m.points,
            m.rows,
            d.kept,
            d.undecided,
            d.order,
            d.statistic,
            d.limit,
            v.parallax,
        )
        for line, name, row, kept, undecided, order, statistic, limit, q in zip(
            *map(list, columns), strict=True
        ):
            verdict = (
                ["undecided" if undecided else "kept", ""]
                if kept
                else ["rejected", int(order)]
            )
            rows.append(
                (
                    line,
                    [
                        m.name,
                        name,
                        *row,
                        *verdict,
                        _value(statistic),
                        float(limit),
                        float(q),
                    ],
                )
            )
    return [header, *(row for _, row in sorted(rows, key=lambda entry: entry[0]))]


def _round_rows(verdicts: list[Verdict], unit: str) -> list[list[Any]]:
    rows: list[list[Any]] = [
        [
            "pair",
            "round",
            "point",
            "statistic",
            "limit",
            "rejected",
            head("parallax", unit),
        ]
    ]
    for v in verdicts:
        use = np.ones(len(v.measured.points), bool)
        for number, (statistic, limit, rejected, parallax, _) in enumerate(
            v.rounds(), 1
        ):
            for i in np.flatnonzero(use):
                point = v.measured.points[i]
                rows.append(
                    [
                        v.measured.name,
                        number,
                        point,
                        _value(statistic[i]),
                        limit,
                        bool(rejected[i]),
                        float(parallax[i]),
                    ]
                )
            use &= ~rejected[: len(use)]
    return rows


def _summary(v: Verdict) -> dict[str, Any]:
    together: dict[int, list[str]] = {}
    for i in v.rejected:
        together.setdefault(int(v.decision.order[i]), []).append(v.measured.points[i])
    names = [f"{name}_deg" for name in IndependentElements.names]
    return {
        "pair": v.measured.name,
        "outcome": v.outcome,
        "advice": ADVICE[v.outcome],
        "points": len(v.measured.points),
        "rejected": len(v.rejected),
        "order": list(together.values()),
        "undecided": v.undecided,
        "elements": [
            {
                "round": number,
                **dict(zip(names, np.rad2deg(elements).tolist(), strict=True)),
            }
            for number, (*_, elements) in enumerate(v.rounds(), 1)
        ],
    }


def _value(statistic: float) -> float | str:
    return "inf" if math.isinf(statistic) else float(statistic)
