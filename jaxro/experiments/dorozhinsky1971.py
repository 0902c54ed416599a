"""The tables and examples of Dorozhinsky (1971), calculated again and held against the
print.

Table 1 is a flat mock pair, f = b = y = 70 mm, vertical photos, points exactly in their
zones. Two of its facts had to be recovered: the errors of points 9 and 10 are negative,
and its column n = 16 carries an error of -0.60 mm at point 15 that the table does not
list. The pair of table 2 is recovered as well: its elements, its size, and the errors
of points 7 and 8. All errors are of the right-hand y; residual parallaxes are shown in
hundredths of a millimetre.
"""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from ..batches.batch import clean_batch
from ..geometry import mock_pairs
from ..geometry.elements import IndependentElements
from ..geometry.pairs import Pair, pad, stack
from ..rejection import OUTCOMES, Dorozhinsky, Rejection
from ..rejection.leave_one_out_grubbs import influence
from ..rejection.parallaxes import (
    adjust_parallaxes,
    iterate_once,
    parallaxes,
    zero_elements,
)
from ..rejection.rounds import element_values
from ..xla.programs import compiled
from .dorozhinsky1971_first_order import EQUATIONS, by_the_papers_rule

ERRORS = (0.0, 0, 0, 0, 0, 0, 2.0, 2.2, -2.43, -1.90, 0, 0, 0, 0, -0.60, 2.1)
"""mm, behind table 1."""

TABLE_1 = {
    6: (0, 0, 0, 0, 0, 0),
    7: (13, -20, 94, 11, -9, 10, -98),
    8: (-8, -4, 99, 108, 2, 2, -92, -105),
    9: (-27, 24, 107, 104, 118, -15, -84, -112, 123),
    10: (-7, 8, 101, 108, -121, -99, -91, -110, 118, 92),
    16: (49, 31, 78, 63, -90, -110, -118, -158, 146, 79, 47, 31, 63, 78, -28, -158),
}
"""As printed; the sign at point 5 of n = 9 is a misprint."""
MEAN_AND_M_Q = {
    6: (0, 0),
    7: (36, 98),
    8: (54, 117),
    9: (79, 135),
    10: (86, 134),
    16: (83, 112),
}

TABLE_2 = (
    (-127, -107, -216, -162, -102, -117, -326, -282),
    (-5, 0, 48, 58, 2, 2, -58.5, -59),
    (-3, -1, 54, 59, 1, 0, -52, -58),
    (-3, -1, 54, 59, 1, 0.2, -52, -58),
    (-3, -1, 54, 59, 1, 0.2, -52, -58),
)
TABLE_2_ELEMENTS = (
    (29.1, 16.1, 45.9, -37.5, 23.4),
    (29.9, 15.4, 48.2, -37.8, 24.3),
    (30.0, 15.4, 48.3, -37.8, 24.3),
    (30.0, 15.4, 48.3, -37.8, 24.3),
    (30.0, 15.4, 48.3, -37.8, 24.3),
)
"""alpha, chi, alpha', omega', chi' in arc minutes."""
IN_THE_ORDER_OF_THE_PAPER = (0, 1, 3, 2, 4)

TEN_POINTS = (13, -20, -94, 11, -9, 10, -98, -20, 11, -9)
"""Residuals of the ten points in the introduction, as printed: an error at point 7, in
the zone of point 3.

The error is printed as -2.0 mm and is +2.0 mm in the sign of table 1; so -94 at point 3
stands for 94.
"""
TEN_ZONES = (1, 2, 3, 4, 5, 6, 3, 2, 4, 5)
TEN_TOLERANCE = 0.01
"""mm, of condition (3)."""

READINGS = (1, 2)
"""Corrections of the elements before a point is judged. The paper's "two iterations"
are one correction, as its table 2 says; two corrections are the other reading of its
text."""
NOISY, NOISE = 150, 0.01
"""Pairs of eight points with errors of 2.0 and 2.2 mm at points 7 and 8 and noise (mm)
in all coordinates."""

EXAMPLE = (0.01,) * 9 + (0.10,)
"""mm; the paper rounds m_q to .045 and 3 m_q to .13."""


ROW_OF_TABLE_2, ROW_OF_TEN, FIRST_NOISY = (len(TABLE_1) + k for k in range(3))
"""Rows of the batch: first table 1, then the pair of table 2, the ten points of the
introduction, and the noisy pairs."""


@dataclass(frozen=True)
class Decision:
    """A decision of the proposed algorithm: numbers of the points rejected, in order;
    mean |q| of those kept (mm); outcome."""

    rejected: list[int]
    left: float
    outcome: str


@dataclass(frozen=True)
class Column:
    """One number of points of table 1: residuals (mm), and the decision by the number
    of corrections."""

    points: int
    parallax: np.ndarray
    m_q: float
    decisions: dict[int, Decision]

    @property
    def wrong(self) -> list[int]:
        """Numbers of the points with an error."""
        return [int(i) + 1 for i in np.flatnonzero(ERRORS[: self.points])]


@dataclass(frozen=True)
class Results:
    """Everything calculated: mm, arc minutes, 36ths.

    `pair_of_table_2`: decisions on the pair of table 2, whose points 7 and 8 are wrong.
    `named_exactly`: share of the noisy pairs of eight points from which exactly points
    7 and 8 were rejected. Both by the number of corrections. `least_squares`,
    `own_rule`: residuals of (9) and (10). `ten`: residuals of the ten points of the
    introduction, of which condition (3) rejects `ten_rejected`.
    """

    columns: list[Column]
    parallax: np.ndarray
    elements: np.ndarray
    pair_of_table_2: dict[int, Decision]
    named_exactly: dict[int, float]
    least_squares: dict[int, np.ndarray]
    own_rule: dict[int, np.ndarray]
    ten: np.ndarray
    ten_rejected: list[int]
    m_q: float


def run() -> Results:
    """Calculate all of it; the noisy pairs have a fixed seed."""
    calculated = _calculate(np.asarray(ERRORS))
    pairs, strict, (parallax, elements), influences = calculated
    q, m_q = map(np.asarray, strict)
    decisions = {
        corrections: _decisions(pairs, corrections) for corrections in READINGS
    }

    def by_reading(row: int) -> dict[int, Decision]:
        return {corrections: found[row] for corrections, found in decisions.items()}

    columns = [
        Column(
            points=n,
            parallax=q[row, :n],
            m_q=float(m_q[row]),
            decisions=by_reading(row),
        )
        for row, n in enumerate(TABLE_1)
    ]
    in_minutes = np.rad2deg(np.asarray(elements)) * 60
    ten_q = q[ROW_OF_TEN, : len(TEN_ZONES)]
    too_large = np.abs(ten_q) - np.mean(np.abs(ten_q)) >= TEN_TOLERANCE
    return Results(
        columns=columns,
        parallax=np.asarray(parallax),
        elements=in_minutes[:, list(IN_THE_ORDER_OF_THE_PAPER)],
        pair_of_table_2=by_reading(ROW_OF_TABLE_2),
        named_exactly={
            corrections: _named_exactly(found[FIRST_NOISY:])
            for corrections, found in decisions.items()
        },
        least_squares={
            equation: 36 * np.asarray(influences[equation]) for equation in EQUATIONS
        },
        own_rule={equation: by_the_papers_rule(equation) for equation in EQUATIONS},
        ten=ten_q,
        ten_rejected=[int(i) + 1 for i in np.flatnonzero(too_large)],
        m_q=float(np.sqrt(np.sum(np.square(EXAMPLE)) / (len(EXAMPLE) - 5))),
    )


@compiled
def _calculate(errors: Float[Array, "point"]):
    """All pairs as a batch, their strict solutions, the iterations of table 2, and the
    influences by equation."""
    most = max(TABLE_1)
    masks = jnp.arange(most)[None, :] < jnp.array(list(TABLE_1))[:, None]
    first = jax.vmap(table_1(errors).with_mask)(masks)
    eight = pad(table_1(errors[:8]), most)
    keys = jax.random.split(jax.random.key(1971), NOISY)
    noisy = jax.vmap(lambda key: mock_pairs.noisy(eight, key, NOISE))(keys)
    single = stack([pad(table_2(), most), pad(ten_points(), most)])
    parts = first, single, noisy
    pairs = jax.tree.map(lambda *fields: jnp.concatenate(fields), *parts)
    influences = {equation: _influence(equation) for equation in EQUATIONS}
    return pairs, jax.vmap(_strict)(pairs), _iterations(table_2()), influences


def ten_points() -> Pair:
    """The ten points of the introduction, an error of +2.0 mm at point 7."""
    x, y = zip(*(mock_pairs.ZONES[zone] for zone in TEN_ZONES), strict=True)
    flat = mock_pairs.mock_pair(mock_pairs.Layout(x, y, TEN_ZONES))
    return mock_pairs.plant(flat, y_right=2.0 * (np.arange(len(TEN_ZONES)) == 6))


def table_1(errors: Float[Array, "point"]) -> Pair:
    """The mock pair of table 1 with as many points as errors are given."""
    return mock_pairs.plant(
        mock_pairs.mock_pair(mock_pairs.standard_layout(len(errors))), y_right=errors
    )


def table_2() -> Pair:
    """The mock pair of table 2."""
    minutes = (12.79, 36.24, -19.22, 32.89, 46.01)
    elements = IndependentElements(*(jnp.deg2rad(jnp.asarray(m) / 60) for m in minutes))
    layout = mock_pairs.standard_layout(8)
    flat = mock_pairs.mock_pair(
        layout, elements, focal=70.64, base=63.99, y_range=(64.07, 62.32)
    )
    return mock_pairs.plant(flat, y_right=np.array([0, 0, 0, 0, 0, 0, 1.10, 1.20]))


def _decisions(pairs: Pair, corrections: int) -> list[Decision]:
    """The decisions of the proposed algorithm on each pair."""
    found = clean_batch(pairs, Dorozhinsky(corrections=corrections), select=_select)
    order, q, kept, outcome = map(np.asarray, found)
    names = {int(item._value): name for name, item in OUTCOMES._name_to_item.items()}
    decisions = []
    for row, numbers in enumerate(order):
        rejected = sorted(np.flatnonzero(numbers), key=lambda i, n=numbers: n[i])
        left = np.sum(np.abs(q[row][kept[row]])) / np.sum(kept[row])
        decisions.append(
            Decision(
                rejected=[int(i) + 1 for i in rejected],
                left=float(left),
                outcome=names[int(outcome[row])],
            )
        )
    return decisions


def _select(found: Rejection):
    return found.order, found.orientation.parallax, found.mask, found.outcome._value


def _named_exactly(decisions: list[Decision]) -> float:
    """The share of pairs from which exactly points 7 and 8 were rejected."""
    return float(np.mean([set(one.rejected) == {7, 8} for one in decisions]))


def _strict(pair: Pair):
    """Residual parallaxes and m_q of the converged solution of all points."""
    solved = adjust_parallaxes(pair, pair.mask)
    return solved.parallax, solved.m_q


def _iterations(pair: Pair):
    """Five iterations from zero: parallaxes before each, elements after it."""

    def iterate(elements, _):
        new = iterate_once(pair, pair.mask, elements)
        before = parallaxes(pair, pair.mask, elements)
        return new, (before, element_values(new))

    return lax.scan(iterate, zero_elements(pair), None, len(TABLE_2))[1]


def _influence(equation: int):
    """The residuals that an error of point 7 leaves, the column (1 - H) of this point,
    H = A (AᵀA)⁻¹ Aᵀ: a law of the layout."""
    zones, _ = EQUATIONS[equation]
    x, y = zip(*(mock_pairs.ZONES[zone] for zone in zones), strict=True)
    flat = mock_pairs.mock_pair(mock_pairs.Layout(x, y, zones))
    found = influence(flat, flat.mask, zero_elements(flat))
    column = jnp.eye(len(zones))[6]
    for a, z in zip(found.columns, found.solved, strict=True):
        column = column - a * z[6]
    return column
