"""The tables and examples of Dorozhinsky (1971), calculated again and held against the print.

Table 1 is a flat mock pair, f = b = y = 70 mm, vertical photos, points exactly in their zones. Two of its facts had to
be recovered: the errors of points 9 and 10 are negative, and its column n = 16 carries an error of -0.60 mm at point 15
that the table does not list. The pair of table 2 is recovered as well: its elements, its size, and the errors of points
7 and 8. All errors are of the right-hand y; residual parallaxes are shown in hundredths of a millimetre.
"""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from .. import simulation
from ..batch import clean_batch
from ..elements import IndependentElements
from ..pairs import Pair
from ..programs import QUICK, Program
from ..rejection import OUTCOMES, Dorozhinsky, base
from ..rejection.leave_one_out_grubbs import linearised

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
MEAN_AND_M_Q = {6: (0, 0), 7: (36, 98), 8: (54, 117), 9: (79, 135), 10: (86, 134), 16: (83, 112)}

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

EQUATIONS = {
    9: ((1, 2, 3, 4, 5, 6, 4), (0, 4, -6, -17, 6, 1, 19)),
    10: ((1, 2, 3, 4, 5, 6, 3, 4), (-3, 3, -16.5, -1.5, 1.5, -1.5, 19.5, -1.5)),
}
"""Zones of the points, and the residuals that an error of point 7 leaves, in 36ths of it, as printed."""

EXAMPLE = (0.01,) * 9 + (0.10,)
"""mm; the paper rounds m_q to .045 and 3 m_q to .13."""


@dataclass(frozen=True)
class Column:
    """One number of points of table 1: residuals (mm), and what the proposed algorithm does with them.

    `rejected`: numbers of the points in order; `left`: mean |q| of those kept.
    """

    points: int
    parallax: np.ndarray
    m_q: float
    rejected: list[int]
    left: float
    outcome: str

    @property
    def wrong(self) -> list[int]:
        """Numbers of the points with an error."""
        return [int(i) + 1 for i in np.flatnonzero(ERRORS[: self.points])]

    @property
    def missed(self) -> list[int]:
        """Wrong points kept."""
        return [i for i in self.wrong if i not in self.rejected]

    @property
    def lost(self) -> list[int]:
        """Good points rejected."""
        return [i for i in self.rejected if i not in self.wrong]


@dataclass(frozen=True)
class Results:
    """Everything calculated: mm, arc minutes, 36ths."""

    columns: list[Column]
    parallax: np.ndarray
    elements: np.ndarray
    exact: dict[int, np.ndarray]
    m_q: float


def run() -> Results:
    """Calculate all of it; nothing here is random."""
    pairs, strict, (parallax, elements), influence = Program(_calculated, {}, QUICK)(jnp.asarray(ERRORS))
    in_minutes = np.rad2deg(np.asarray(elements)) * 60
    return Results(
        _columns(pairs, *map(np.asarray, strict)),
        np.asarray(parallax),
        in_minutes[:, list(IN_THE_ORDER_OF_THE_PAPER)],
        {equation: 36 * np.asarray(influence[equation]) for equation in EQUATIONS},
        float(np.sqrt(np.sum(np.square(EXAMPLE)) / (len(EXAMPLE) - 5))),
    )


def _calculated(errors):
    """The pairs of table 1 as a batch, their strict solutions, the iterations of table 2, and the influences."""
    most = table_1(errors)
    masks = jnp.arange(max(TABLE_1))[None, :] < jnp.array(list(TABLE_1))[:, None]
    pairs = jax.vmap(most.with_mask)(masks)
    return (
        pairs,
        jax.vmap(_strict)(pairs),
        _iterations(table_2()),
        {equation: _influence(equation) for equation in EQUATIONS},
    )


def table_1(errors: Float[Array, "point"]) -> Pair:
    """The mock pair of table 1 with all its points."""
    return simulation.planted(simulation.mock_pair(simulation.standard_layout(max(TABLE_1))), y_right=errors)


def table_2() -> Pair:
    """The mock pair of table 2."""
    minutes = (12.79, 36.24, -19.22, 32.89, 46.01)
    elements = IndependentElements(*(jnp.deg2rad(jnp.asarray(m) / 60) for m in minutes))
    layout = simulation.standard_layout(8)
    flat = simulation.mock_pair(layout, elements, focal=70.64, base=63.99, y_range=(64.07, 62.32))
    return simulation.planted(flat, y_right=np.array([0, 0, 0, 0, 0, 0, 1.10, 1.20]))


def _columns(pairs: Pair, q: np.ndarray, m_q: np.ndarray) -> list[Column]:
    order, left, outcome = map(np.asarray, clean_batch(pairs, Dorozhinsky(), select=_decided))
    names = {int(item._value): name for name, item in OUTCOMES._name_to_item.items()}
    columns = []
    for row, points in enumerate(TABLE_1):
        rejected = sorted(np.flatnonzero(order[row]), key=lambda i, row=row: order[row, i])
        mean = float(np.sum(np.abs(left[row])) / (points - len(rejected)))
        numbers = [int(i) + 1 for i in rejected]
        columns.append(Column(points, q[row, :points], float(m_q[row]), numbers, mean, names[int(outcome[row])]))
    return columns


def _strict(pair: Pair):
    solved = base.by_parallax(pair, pair.mask)
    return solved.parallax, solved.m_q


def _decided(r):
    return r.order, r.orientation.parallax, r.outcome._value


def _iterations(pair: Pair):
    """Five iterations from zero: parallaxes before each, elements after it."""

    def iteration(elements, _):
        new = base.iterated(pair, pair.mask, elements)
        return new, (base.parallaxes(pair, pair.mask, elements), base.values(new))

    return lax.scan(iteration, base.zero_elements(pair), None, len(TABLE_2))[1]


def _influence(equation: int):
    """What an error of point 7 leaves, (1 - H) of its column, H = A (AᵀA)⁻¹ Aᵀ: a law of the layout."""
    zones, _ = EQUATIONS[equation]
    x, y = zip(*(simulation.ZONES[zone] for zone in zones), strict=True)
    flat = simulation.mock_pair(simulation.Layout(x, y, zones))
    _, (a, z), _ = linearised(flat, flat.mask, base.zero_elements(flat))
    return jnp.eye(len(zones))[6] - sum(column * solved[6] for column, solved in zip(a, z, strict=True))
