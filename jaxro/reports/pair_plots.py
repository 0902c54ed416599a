"""Figures of oriented pairs: residuals, tests, influence and accuracy of the points of
one; sigma0 of all."""

from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from jaxtyping import Bool, Float, Int

from .. import plots
from ..geometry.elements import RelativePose
from ..geometry.pairs import Pair, pad, room_for
from ..orientation.orient import orient
from ..rejection import LeaveOneOutGrubbs
from ..tables.measured import COORDINATES, Table, one_pair, take, to_list, to_ragged
from .columns import is_usable
from .model import One, Results
from .verdicts import Verdicts

WORST = 3
"""Pairs of a table of many that are drawn: those that failed, then those with the
largest m_q."""

OMITTED = 60
"""Points up to which each is left out in turn."""

Figures = dict[str, Any]
"""Figures of matplotlib by name."""


def worst(results: Results, most: int = WORST) -> list[int]:
    """The numbers of the pairs that are drawn, the worst first."""
    m_q = np.asarray(results.of_pairs["m_q"], float)
    return order(results.of_pairs["result"], m_q)[:most].tolist()


def order(
    result: Int[np.ndarray, " pair"], m_q: Float[np.ndarray, " pair"]
) -> Int[np.ndarray, " pair"]:
    """The numbers of pairs by how bad they are: those that failed, then those with the
    largest m_q."""
    return np.lexsort((-np.nan_to_num(m_q, nan=-1.0), is_usable(result)))


def figures_of_pair(one: One, verdicts: Verdicts | None = None) -> Figures:
    """All figures of a pair that there are, by name."""
    made: dict[str, Callable[[], Any]] = {
        "residuals": lambda: draw_residuals(one, verdicts),
        "tests": lambda: draw_tests(one),
        "leave_one_out": lambda: draw_leave_one_out(one, verdicts),
        "influence": lambda: draw_influence(one),
        "model": lambda: draw_model(one),
    }
    drawn = {name: draw() for name, draw in made.items()}
    return {
        name: plots.figure_of(axes) for name, axes in drawn.items() if axes is not None
    }


def draw_residuals(one: One, verdicts: Verdicts | None = None) -> Any:
    """The residual vectors of a pair on both photos, and the points that were rejected;
    the places alone of a pair that is not oriented."""
    names, pair, out = measured(one, verdicts)
    v = None
    if one.usable:
        own = one.of_points("residuals")
        v = np.zeros((4, len(out)))
        v[:, ~out] = [own[f"v_{name}"] for name in COORDINATES]
    at = np.stack([np.asarray(c) for c in pair.coordinates])
    unit = one.results.units.photo
    return plots.draw_both_photos(at, v, rejected=out, names=names, unit=unit)


def draw_tests(one: One) -> Any:
    """w or tau of the points with the limit; None where nothing can be tested."""
    points = _reliability(one)
    if points is None:
        return None
    known = one.results.sigma_known
    return plots.draw_bars(
        points["w"],
        float(np.nanmax(points["limit"])),
        names=one.points,
        title=f"{one.name}: normalised residuals"
        + ("" if known else ", sigma0 estimated"),
        of="w" if known else "tau",
    )


def draw_leave_one_out(one: One, verdicts: Verdicts | None = None) -> Any:
    """How the mean y-parallax falls without each of the measured points; None for pairs
    of many or too few points, with covariances, which this test has no place for, or
    without an orientation."""
    names, pair, out = measured(one, verdicts)
    testable = 6 < len(names) <= OMITTED and pair.roots is None
    if not one.usable or not testable:
        return None
    mask = np.asarray(pair.mask) | out
    found = LeaveOneOutGrubbs(exact=False)(
        pad(pair.with_mask(mask), room_for(len(mask)))
    )
    if not np.any(np.asarray(found.log.happened)):
        return None
    return plots.draw_round(
        found.first(len(mask)),
        names=names,
        title=f"{one.name}: mean y-parallax without each point, Grubbs' limit",
        of="V",
    )


def draw_influence(one: One) -> Any:
    """How well each point is checked, and what a hidden error in it does; None where
    nothing can be tested."""
    points = _reliability(one)
    if points is None:
        return None
    effects = [np.abs(points[f"effect_on_Z_of_y_{side}"]) for side in ("left", "right")]
    return plots.draw_influences(
        points["redundancy"],
        points["external_reliability"],
        np.max(effects, axis=0),
        names=one.points,
        unit=one.results.units.model,
    )


def draw_model(one: One) -> Any:
    """Error ellipses and the accuracy of the heights, a posteriori; None without
    redundancy."""
    freedom = one.value("degrees_of_freedom")
    if not one.usable or freedom < 1 or "points" not in one.results.of_points:
        return None
    points = one.of_points("points")
    return plots.draw_model_errors(
        np.stack([points[axis] for axis in "XYZ"], axis=-1),
        _covariances(one, points),
        freedom=freedom,
        names=one.points,
        unit=one.results.units.model,
    )


def _covariances(one: One, points: dict[str, np.ndarray]) -> np.ndarray:
    """The covariances of the model points, linearised at the pose that was found."""
    _, pair, _ = measured(one)
    pair = pad(pair, room_for(one.count))
    pose = RelativePose(
        *jax.device_put(tuple(one.results.of_pairs["pose"][one.number]))
    )
    found = orient(pair, elements=one.results.system, start=pose, max_steps=0)
    own = np.stack([np.asarray(c)[: one.count] for c in found.model])
    given = np.stack([points[axis] for axis in "XYZ"])
    # the base was given where the elements do not tell it
    size = float(np.sum(given * own) / np.sum(own * own))
    return size**2 * plots.model_covariances(pair, found)[: one.count]


def _reliability(one: One) -> dict[str, np.ndarray] | None:
    """The reliability of the points, None where none of them can be tested."""
    if "reliability" not in one.results.of_points:
        return None
    points = one.of_points("reliability")
    return points if np.any(np.isfinite(points["w"])) else None


def draw_sigma0(results: Results) -> Any:
    """The distribution of sigma0 over all pairs."""
    sigma0 = np.asarray(results.of_pairs["sigma0"], float)
    expected = 1.0 if results.sigma_known else None
    unit = results.units.sigma0
    return plots.draw_distribution(sigma0, unit=unit, expected=expected)


def measured(
    one: One, verdicts: Verdicts | None = None
) -> tuple[list[str], Pair, Bool[np.ndarray, " point"]]:
    """Names and photo coordinates of the points of a pair, those that were rejected
    masked, and which these are."""
    table = one.results.table if verdicts is None else verdicts.table
    rows = np.arange(table.begins[one.number], table.begins[one.number + 1])
    pair = one_pair(to_ragged(_part(table, rows), one.cameras), 0)
    kept = np.ones(len(rows), bool)
    if verdicts is not None:
        kept = np.asarray(verdicts.of_points["kept"])[rows].astype(bool)
    names = [str(name) for name in to_list(take(table.points, rows))]
    return names, pair.with_mask(kept), ~kept


def _part(table: Table, rows: np.ndarray) -> Table:
    """These rows as a table of one pair."""
    return Table(
        file=table.file,
        names=["pair"],
        begins=np.array([0, len(rows)]),
        points=take(table.points, rows),
        numbers={name: take(column, rows) for name, column in table.numbers.items()},
    )
