"""The table and figures of Gutkin (1982), calculated again and held against the print.

The table compares expected standard deviations of heights over the grid with those of
differences between points, for the shortest and the longest base and two camera
heights: h = 200 mm, m_dp = 7 µm; differences of 20 mm, m_dp = 8.5 µm; m_H = 10 mm. Its
totals follow from its printed terms in all eight columns, so that a wrong term is wrong
there too.
"""

from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from ..adjustment.propagation import propagate_each
from ..surveys import accuracy as accuracy, heights

DEPTH, STEP = 200.0, 20.0
M_HEIGHT, M_DIFFERENCE, M_IN_SQUARE, M_CAMERA = 0.007, 0.0085, 0.0056, 10.0
FOCAL = 75.0
COLUMNS = ("h, B min", "h, B max", "dh, B min", "dh, B max")
ROWS = ("m_pc", "readings", "camera height", "grid parallax", "total")


class Case(NamedTuple):
    """One half of the table: what it is calculated from, and the print by rows (mm)."""

    camera_height: float
    dp: float
    p_c: tuple[float, float]
    m_p_c: tuple[float, float]
    printed: dict[str, tuple[float, ...]]


CASES = (
    Case(
        3500.0,
        -1.0,
        (17.5, 18.7),
        (0.069, 0.073),
        {
            "m_pc": (0.059, 0.073, 0.059, 0.073),
            "readings": (1.5, 1.4, 1.9, 1.5),
            "camera height": (0.6, 0.6, 0.1, 0.1),
            "grid parallax": (0.8, 0.8, 0.1, 0.1),
            "total": (1.8, 1.7, 1.9, 1.5),
        },
    ),
    Case(
        1500.0,
        -0.8,
        (7.5, 18.7),
        (0.030, 0.048),
        {
            "m_pc": (0.030, 0.048, 0.030, 0.048),
            "readings": (1.6, 0.6, 2.1, 0.8),
            "camera height": (1.3, 1.3, 0.1, 0.1),
            "grid parallax": (0.6, 0.5, 0.1, 0.1),
            "total": (2.1, 1.5, 2.1, 0.8),
        },
    ),
)

MISPRINTS = {
    (0, "m_pc", 0): "misprint for 0.069, which the text has",
    (0, "m_pc", 2): "misprint for 0.069, which the text has",
    (
        0,
        "readings",
        3,
    ): "calculated with 7 um in place of 8.5: 1.467; with 8.5 um it is 1.8",
    (0, "total", 3): "follows from the 1.5 above it",
    (
        1,
        "grid parallax",
        0,
    ): "calculated with m_pc = 0.02, that of L = 200 mm, not with the 0.030 above it",
    (1, "total", 0): "follows from the 0.6 above it",
    (1, "readings", 2): "2.13 with the term dp1 dp2 / p_c of (6) in the denominator",
    (1, "total", 2): "follows from the 2.1 above it",
    (1, "readings", 3): "0.746 rounded up",
    (1, "total", 1): "1.55; the root of the squares of the rounded terms is 1.52",
}
"""The cells that differ from the calculation in their last digit: (case, row, column),
and why."""


class Figure(NamedTuple):
    """A number of the text: what, calculated, printed, decimals, and a remark where
    they differ."""

    what: str
    found: float
    printed: float
    digits: int
    remark: str = ""


@dataclass(frozen=True)
class Results:
    """Cells of the table by (case, row), totals of exact propagation by case, figures
    of the text, and the experiment: (m_h, m_dh) with the right camera height and with
    one wrong by 30 mm. `legs`: m_dh of differences within one square (5.6 µm) and
    between squares (8.5 µm), with the right camera height."""

    cells: dict[tuple[int, str], np.ndarray]
    exact: list[np.ndarray]
    figures: list[Figure]
    experiment: np.ndarray
    legs: tuple[float, float]


def run() -> Results:
    """Calculate all of it; the draws of the experiment have a fixed seed."""
    cells = {}
    for number, case in enumerate(CASES):
        for row, values in zip(ROWS, _columns(case), strict=True):
            cells[number, row] = values
    simulated, within = experiment()
    legs = within, float(simulated[0, 1])
    return Results(cells, [_exact(case) for case in CASES], figures(), simulated, legs)


def _columns(case: Case) -> list[np.ndarray]:
    p_c, m_p_c = (np.array(a) for a in (case.p_c, case.m_p_c))
    h = accuracy.height_terms(
        case.camera_height, p_c, case.dp, DEPTH, M_HEIGHT, M_CAMERA, m_p_c
    )
    dh = accuracy.difference_terms(
        case.camera_height, p_c, case.dp, STEP, M_DIFFERENCE, M_CAMERA, m_p_c
    )
    beside = lambda a, b: np.concatenate([np.broadcast_to(a, 2), np.broadcast_to(b, 2)])
    return [beside(m_p_c, m_p_c), *(beside(a, b) for a, b in zip(h, dh, strict=True))]


def _exact(case: Case) -> np.ndarray:
    """Totals by propagation through (1) and (19), dp those of points 200 and 220 mm
    below the grid."""
    p_c, m_p_c = (jnp.array(a) for a in (case.p_c, case.m_p_c))
    dp = [
        -p_c * depth / (case.camera_height + depth) for depth in (DEPTH, DEPTH + STEP)
    ]
    h = propagate_each(
        lambda v: heights.height(*v),
        (case.camera_height, p_c, dp[0]),
        (M_CAMERA, m_p_c, M_HEIGHT),
    )
    dh = propagate_each(
        lambda v: heights.difference_in_square(*v),
        (case.camera_height, p_c, *dp),
        (M_CAMERA, m_p_c, 0.0, M_DIFFERENCE),
    )
    return np.concatenate([h, dh])


def figures() -> list[Figure]:
    """The numbers of the text."""
    low = "the print has 5 % more, as with m_l = 0.0074"
    eight = (
        (3500, 17.5, 815, 47, 200, 0.036, low),
        (3500, 17.5, 815, 47, 100, 0.069, low),
        (3500, 18.7, 875, 47, 100, 0.073, low),
        (1500, 7.5, 150, 20, 200, 0.02, "rounded down"),
        (1500, 7.5, 150, 20, 100, 0.030, ""),
        (1500, 18.7, 375, 20, 100, 0.048, ""),
    )
    m = accuracy.by_base(1.0, FOCAL, 1.0, M_DIFFERENCE)  # times H² / B
    in_square = accuracy.by_base(1.0, FOCAL, 1.0, M_IN_SQUARE)
    node = lambda k: np.full(k, 3.0)
    detail = accuracy.detail_deviation(m, 9, in_square)
    allowed = [
        (1500, 37.5, ""),
        (2500, 62.0, "62.5 rounded down"),
        (3500, 87.0, "87.5 rounded down"),
    ]
    found = [
        Figure(
            f"(8) m_pc, H = {h}, B = {b}, L = {side}, mm",
            float(
                accuracy.grid_parallax_deviation(
                    p_c, b, side / scale, side, 0.5, 0.007, 0.17
                )
            ),
            printed,
            3,
            remark,
        )
        for h, p_c, b, scale, side, printed, remark in eight
    ]
    found += [
        Figure(
            f"m_H for m = 0.5 of 20 mm, H = {h}, mm",
            float(accuracy.allowed_camera_height(0.5, h, 20)),
            p,
            1,
            why,
        )
        for h, p, why in allowed
    ]
    found += [
        Figure(
            "(3') m_hH, h = 100, H = 1500, mm",
            float(accuracy.by_camera_height(100, 1500, 10)),
            0.7,
            1,
        ),
        Figure(
            "(4) m_hpc, h = 100, p_c = 7.5, mm",
            float(accuracy.by_grid_parallax(100, 7.5, 0.02)),
            0.3,
            1,
        ),
        Figure(
            "m of (6), um: 5.6, 5.4 and 3-4",
            1e3 * float(np.sqrt(0.0056**2 + 0.0054**2 + 0.0035**2)),
            8.5,
            1,
            "'8-9'",
        ),
        Figure(
            "(10) p_c, B = H / 4, mm",
            float(accuracy.parallax_over_plane(FOCAL, 4, 1)),
            20,
            2,
            "'about 20'",
        ),
        Figure("(11') H² / x B", float(1 / m), 9000, 0, "rounded"),
        Figure("(11'') H / x, B = H / 4", float(1 / (4 * m)), 2200, 0, "rounded"),
        Figure(
            "(16') M / m, k = 3, n = 3",
            float(accuracy.node_deviation_printed(1, node(3))),
            1.23,
            2,
            "1.2247",
        ),
        Figure(
            "  exact, m / sqrt([1/n])",
            float(accuracy.node_deviation(1, node(3))),
            1.23,
            2,
            "(16') is too large",
        ),
        Figure(
            "(16') M / m, k = 4, n = 3",
            float(accuracy.node_deviation_printed(1, node(4))),
            1.0,
            2,
        ),
        Figure(
            "  exact, m / sqrt([1/n])",
            float(accuracy.node_deviation(1, node(4))),
            1.0,
            2,
            "(16') is too large",
        ),
        Figure(
            "(17), (18) H / x, 1.1 m, B = H / 4",
            float(1 / (1.1 * 4 * m)),
            2000,
            0,
            "rounded",
        ),
        Figure("(20) H² / x B, n = 9", float(1 / detail), 5500, 0, "rounded up by 2 %"),
        Figure(
            "(20) H / x, B = H / 4",
            float(1 / (4 * detail)),
            1400,
            0,
            "rounded up by 4 %",
        ),
    ]
    return found


EXPERIMENT = {"camera_height": 2100.0, "base": 2100 / 6.4, "points": 22, "error": 30.0}
EXPERIMENT_PRINTED = ((1.48, 1.40), (1.76, 1.40))
"""(m_h, m_dh) with the right camera height, and with one wrong by 30 mm."""
EXPERIMENT_DEPTH = 2100 / 30 * float(np.sqrt(1.76**2 - 1.48**2))
"""Depth of the model below the grid that the growth from 1.48 to 1.76 mm tells of: 67
mm, which the paper does not say.
"""
DRAWS = 2000


def experiment(depth: float = EXPERIMENT_DEPTH) -> tuple[np.ndarray, float]:
    """The paper's experiment as simulation: errors (mm, root mean square) of 22 heights
    over the grid and of the 21 differences of neighbours, without and with an error of
    30 mm in the camera height; rows as printed. And the errors of differences within
    one square, without it.

    Points 10 mm around the depth, m_dp = 7 µm over the grid, 8.5 µm between points, 5.6
    µm within a square.
    """
    camera, base = EXPERIMENT["camera_height"], EXPERIMENT["base"]
    p_c = float(accuracy.parallax_over_plane(FOCAL, camera, base))
    h = -depth + 10 * jnp.sin(2.0 * jnp.arange(float(EXPERIMENT["points"])))
    dp = p_c * h / (camera - h)
    step = dp[1:] - dp[:-1]

    def one(key, wrong):
        keys = jax.random.split(key)
        over = heights.height(
            camera + wrong,
            p_c,
            dp + M_HEIGHT * jax.random.normal(keys[0], dp.shape, float),
        )
        drawn = jax.random.normal(keys[1], step.shape, float)

        def square(deviation):
            read = dp[:-1] + step + deviation * drawn
            between = heights.difference_in_square(camera + wrong, p_c, dp[:-1], read)
            return jnp.mean((between - (h[1:] - h[:-1])) ** 2)

        return jnp.mean((over - h) ** 2), square(M_DIFFERENCE), square(M_IN_SQUARE)

    keys = jax.random.split(jax.random.key(1982), DRAWS)
    squares = jax.jit(jax.vmap(jax.vmap(one, (0, None)), (None, 0)))(
        keys, jnp.array([0.0, EXPERIMENT["error"]])
    )
    roots = np.sqrt(np.mean(np.asarray(squares), axis=2)).T
    return roots[:, :2], float(roots[0, 2])
