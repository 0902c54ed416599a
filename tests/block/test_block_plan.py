"""Accuracy before the flight: the deviations of the adjustment that follows, and control
that is added by adjusting anew."""

import numpy as np
import pytest

from jaxro import block
from jaxro.block.adjust import adjust_block
from jaxro.block.adjust_chained import start_from
from jaxro.block.plan import plan_block, plan_rays, where_control_helps
from jaxro.block.reliability import assess_block

FRAME = {"focal": 153.0, "half_sides": 115.0, "sigma": 0.005}


@pytest.fixture(scope="module")
def flown():
    """A simulated block, and its plan: the truth of stations and points."""
    mock = block.mock_block(3, block.Flight(strips=2, models=4))
    start = start_from(mock.block, mock.photos)._replace(points=mock.points)
    return mock, start


def test_the_plan_has_the_rays_and_the_deviations_of_the_flight(flown):
    mock, start = flown
    planned = plan_rays(start, mock.block.photos, mock.block.points, **FRAME)
    rays = lambda b: sorted(zip(b.photo.tolist(), b.point.tolist(), strict=True))
    assert rays(planned) == rays(mock.block)
    found = plan_block(planned, start, mock.ground)
    assert found.sigma0 == 1.0
    measured = adjust_block(mock.block, start, mock.ground)
    # the linearisation is at the plan, not at the measured block
    own = measured.deviations / measured.sigma0
    np.testing.assert_allclose(found.deviations, own, rtol=2e-3)
    own = measured.centre_deviations / measured.sigma0
    np.testing.assert_allclose(found.centre_deviations, own, rtol=2e-3)
    assert found.degrees_of_freedom == measured.degrees_of_freedom


def test_detectable_errors_before_the_flight(flown):
    """For sigma0 = 1, as those of the adjusted block over its sigma0."""
    mock, start = flown
    planned = assess_block(plan_block(mock.block, start, mock.ground))
    adjusted = adjust_block(mock.block, start, mock.ground)
    own = assess_block(adjusted).rays.detectable / adjusted.sigma0
    # of small redundancies the last part differs
    sure = planned.rays.redundancy > 0.1
    np.testing.assert_allclose(planned.rays.detectable[sure], own[sure], rtol=5e-3)


@pytest.mark.parametrize(
    "sigma", [(0.02,) * 3, (0.05, 0.05, 0.02), (np.inf, np.inf, 0.02)]
)
def test_further_control_is_what_adjusting_with_it_gives(flown, sigma):
    """All coordinates, with different deviations, and the height alone."""
    mock, start = flown
    sigma = np.array(sigma)
    gains = where_control_helps(plan_block(mock.block, start, mock.ground), sigma)
    for name in (gains.best, "t30", "t51"):
        k = mock.block.points.index(name)
        at = np.where(np.isfinite(sigma), mock.points[k], np.nan)
        more = block.ground(
            (*mock.ground.points, name),
            np.concatenate([mock.ground.coordinates, at[None]]),
            np.concatenate(
                [mock.ground.sigma, np.where(sigma < np.inf, sigma, 1)[None]]
            ),
        )
        found = plan_block(mock.block, start, more)
        rms = np.sqrt(np.nanmean(found.deviations**2, axis=0))
        np.testing.assert_allclose(gains.rms[k], rms, rtol=1e-7)
        largest = np.nanmax(found.deviations, axis=0)
        np.testing.assert_allclose(gains.largest[k], largest, rtol=1e-7)


def test_a_second_measurement_of_control_brings_less_than_the_best_point(flown):
    """What is known gains little, no point makes anything worse, and candidates are
    those that are named."""
    mock, start = flown
    planned = plan_block(mock.block, start, mock.ground)
    gains = where_control_helps(planned, 0.02)
    assert np.all(gains.rms <= gains.now[0] + 1e-12)
    total = np.sum(gains.rms**2, axis=1)
    known = [mock.block.points.index(name) for name in mock.ground.points]
    assert np.all(total[known] > total[mock.block.points.index(gains.best)])
    some = where_control_helps(planned, 0.02, candidates=("t30", "t51"))
    tried = np.flatnonzero(np.isfinite(some.rms[:, 0]))
    assert [mock.block.points[k] for k in tried] == ["t30", "t51"]
    np.testing.assert_allclose(some.rms[tried], gains.rms[tried], rtol=1e-9)


def test_plans_that_say_nothing_are_refused(flown):
    mock, start = flown
    names = mock.block.photos, mock.block.points
    with pytest.raises(ValueError, match="photos and 1 points are named"):
        plan_rays(start, names[0], ("a",), **FRAME)
    up = start._replace(quaternions=np.tile([1.0, 0.0, 0.0, 0.0], (len(names[0]), 1)))
    with pytest.raises(ValueError, match="no photo shows any point"):
        plan_rays(up, *names, **FRAME)
    free = plan_block(mock.block, start)
    with pytest.raises(ValueError, match="free network"):
        where_control_helps(free, 0.02)
    planned = plan_block(mock.block, start, mock.ground)
    with pytest.raises(ValueError, match="no point 'x' is adjusted"):
        where_control_helps(planned, 0.02, candidates=("x",))
    with pytest.raises(ValueError, match="positive"):
        where_control_helps(planned, 0.0)
