"""The adjustment by conditions against the one with points as unknowns, which knows
nothing of models."""

from functools import cache

import numpy as np
import pytest
from tiers import seldom

from jaxro import block
from jaxro.adjustment import RESULTS
from jaxro.block import conditions_of_block
from jaxro.block.adjust_chained import start_from
from jaxro.block.conditions import adjust_conditions
from jaxro.block.measured_block import add_rays
from jaxro.block.network import frame_of


def start_of(mock):
    """The true photos and points, also of points with a single ray."""
    return start_from(mock.block, mock.photos)._replace(points=mock.points)


def strip_of_three():
    mock = block.mock_block(1, block.Flight(models=3))
    return mock, mock.ground


def block_with_partial_control():
    """Points with one to six rays. Of the control one point is known altogether, one in
    plan, two in height; and two on one photo only, of which one has two coordinates."""
    mock = block.mock_block(14, block.Flight(strips=2, models=4))
    measured, at = mock.block, mock.ground.coordinates.copy()
    at[[1, 3], :2] = np.nan
    at[2, 2] = np.nan
    at[5, 0] = np.nan
    last = np.zeros(len(measured.points), int)
    last[measured.point] = np.arange(len(measured.point))
    few = np.isin(measured.point, [4, 5])
    measured = measured.without(few & (last[measured.point] != np.arange(len(few))))
    ground = mock.ground._replace(coordinates=at)
    return mock._replace(block=measured), ground


def free_network():
    return block.mock_block(3, block.Flight(models=2)), None


@cache
def adjusted(made):
    """What was measured, the known points, and the adjustment by conditions."""
    mock, ground = made()
    return mock, ground, adjust_conditions(mock.block, start_of(mock), ground)


@pytest.mark.parametrize(
    ("made", "freedom"),
    seldom(
        [(strip_of_three, 40), (block_with_partial_control, 194), (free_network, 21)],
        [strip_of_three],
    ),
)
def test_the_conditions_have_the_minimum_of_the_block(made, freedom):
    """V'RV, V, redundancy, stations and their deviations."""
    mock, ground, found = adjusted(made)
    measured, start = mock.block, start_of(mock)
    found.check()
    other = block.adjust_block(measured, start, ground).check()
    assert found.degrees_of_freedom == other.degrees_of_freedom == freedom
    squares = other.sigma0**2 * other.degrees_of_freedom
    np.testing.assert_allclose(found.squares, squares, rtol=1e-9)
    np.testing.assert_allclose(found.sigma0, other.sigma0, rtol=1e-9)
    np.testing.assert_allclose(found.residuals, other.residuals, atol=1e-9)
    if ground is None:
        return
    np.testing.assert_allclose(found.centres, other.centres, atol=1e-8)
    deviations = other.centre_deviations
    np.testing.assert_allclose(found.centre_deviations, deviations, rtol=1e-7)
    rows = [measured.points.index(name) for name in ground.points]
    misfit = other.coordinates[rows] - ground.coordinates
    np.testing.assert_allclose(found.control_residuals, misfit, atol=1e-9)


def test_which_conditions_a_point_has():
    """2 r - 3 of r rays, one more for each known coordinate, k - 1 for k known
    coordinates and a single ray."""
    mock, ground, found = adjusted(block_with_partial_control)
    rays = np.bincount(mock.block.point, minlength=len(mock.block.points))
    assert {1, 2, 3, 4, 5, 6} <= set(rays)
    known = np.zeros(len(rays), int)
    known[: len(ground.points)] = np.sum(np.isfinite(ground.coordinates), axis=1)
    assert {2, 3} <= set(known[rays == 1])
    assert {name: len(k) for name, k in found.correlates.items()} == {
        "coplanarity": np.sum(np.maximum(rays - 1, 0)),
        "equal_depth": np.sum(np.maximum(rays - 2, 0)),
        "known_coordinate": np.sum(known[rays > 1]),
        "through_known": np.sum(np.maximum(known[rays == 1] - 1, 0)),
    }


def test_correlates_are_the_slopes_of_the_minimum():
    """V = Q A' K: a known coordinate is in one condition, with the derivative -1 in the
    frame; and the minimum of V'RV changes by -2 v / sigma² with it."""
    mock, ground, found = adjusted(strip_of_three)
    start = start_of(mock)
    per_sigma = found.control_residuals / ground.sigma**2
    slopes = -found.correlates["known_coordinate"] / frame_of(start).length
    np.testing.assert_allclose(per_sigma.ravel(), slopes, rtol=1e-6)
    step, squares = 1e-3, []
    for sign in (1, -1):
        at = ground.coordinates.copy()
        at[0, 2] += sign * step
        changed = ground._replace(coordinates=at)
        squares.append(adjust_conditions(mock.block, start, changed).squares)
    slope = (squares[0] - squares[1]) / (2 * step)
    np.testing.assert_allclose(slope, -2 * per_sigma[0, 2], rtol=1e-5)


def test_too_little_control_is_no_solution():
    """A point in plan and another one in all coordinates."""
    mock = block.mock_block(3, block.Flight(models=2))
    at = mock.ground.coordinates.copy()
    at[0, 2] = np.nan
    at[2:] = np.nan
    ground = mock.ground._replace(coordinates=at)
    found = adjust_conditions(mock.block, start_of(mock), ground)
    assert found.result == RESULTS.rank_deficient
    with pytest.raises(RuntimeError, match="adjust_conditions: The measurements do"):
        found.check()


def test_what_the_conditions_do_not_hold_for_is_refused(monkeypatch):
    """Two places of a point on a photo, a photo twice, one photo, and large blocks."""
    mock = block.mock_block(3, block.Flight(models=2))
    measured, start = mock.block, start_of(mock)
    first = measured.photo == measured.photo[0]
    places = np.stack([measured.x[first], measured.y[first]], axis=1)
    sigma = measured.sigma[first]
    photo = [measured.photos[k] for k in measured.photo[first]]
    point = [measured.points[k] for k in measured.point[first]]
    twice = add_rays(measured, photo[:1], point[:1], places[:1] + 0.01, sigma[:1])
    with pytest.raises(ValueError, match=f"'{photo[0]}' has two places of point"):
        adjust_conditions(twice, start, mock.ground)

    more = measured._replace(
        photos=(*measured.photos, "again"), focal=np.append(measured.focal, 153.0)
    )
    again = add_rays(more, ["again"] * len(point), point, places, sigma)
    begin = start._replace(
        quaternions=start.quaternions[[0, 1, 2, measured.photo[0]]],
        centres=start.centres[[0, 1, 2, measured.photo[0]]],
    )
    with pytest.raises(ValueError, match="'again' are parallel"):
        adjust_conditions(again, begin, mock.ground)

    alone = measured.without(~first)._replace(
        photos=tuple(photo[:1]),
        photo=np.zeros(len(photo), int),
        focal=np.array([153.0]),
    )
    begin = start._replace(quaternions=start.quaternions[:1], centres=start.centres[:1])
    with pytest.raises(ValueError, match="two photos, the block has one"):
        adjust_conditions(alone, begin, mock.ground)

    monkeypatch.setattr(conditions_of_block, "MOST", 10)
    with pytest.raises(ValueError, match="conditions, at most 10 are adjusted"):
        adjust_conditions(measured, start, mock.ground)
