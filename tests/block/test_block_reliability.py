"""Detectable errors of a block: by adjusting with an error, by their own definition, and
by planting them."""

from statistics import NormalDist

import numpy as np
import pytest

from jaxro import block
from jaxro.block.adjust import adjust_block
from jaxro.block.adjust_chained import start_from
from jaxro.block.reliability import assess_block
from jaxro.block.wrong import normalise_residuals


@pytest.fixture(scope="module")
def adjusted():
    mock = block.mock_block(3, block.Flight(strips=2, models=6))
    start = start_from(mock.block, mock.photos)
    return mock, start, adjust_block(mock.block, start, mock.ground)


def with_error(mock, start, row, axis, size, control=False):
    """The adjustment with an error of one coordinate."""
    if control:
        at = mock.ground.coordinates.copy()
        at[row, axis] += size
        return adjust_block(mock.block, start, mock.ground._replace(coordinates=at))
    name = "xy"[axis]
    places = getattr(mock.block, name).copy()
    places[row] += size
    return adjust_block(mock.block._replace(**{name: places}), start, mock.ground)


@pytest.mark.parametrize(("row", "axis", "control"), [(0, 0, 0), (30, 1, 0), (1, 0, 1)])
def test_effects_are_those_of_adjusting_with_the_error(adjusted, row, axis, control):
    """Own point and station; and the bound for everything else holds, and is reached
    nearly by something."""
    mock, start, found = adjusted
    told = assess_block(found)
    part = told.control if control else told.rays
    size = part.detectable[row, axis]
    changed = with_error(mock, start, row, axis, size, control)
    point = mock.block.points.index(mock.ground.points[row]) if control else None
    point = mock.block.point[row] if point is None else point
    moved = changed.coordinates - found.coordinates
    scale = float(np.linalg.norm(moved[point]))
    own = part.point[row, axis]
    np.testing.assert_allclose(own, moved[point], atol=2e-3 * scale)
    moved_photos = changed.centres - found.centres
    if not control:
        photo = mock.block.photo[row]
        own = part.station[row, axis]
        np.testing.assert_allclose(own, moved_photos[photo], atol=2e-3 * scale)
    relative = np.concatenate(
        [moved / found.deviations, moved_photos / found.centre_deviations]
    )
    most = np.nanmax(np.abs(relative))
    assert most <= 1.002 * part.external[row, axis]
    assert most > 0.5 * part.external[row, axis]


def test_a_detectable_error_shifts_w_by_delta0(adjusted):
    """With the sigma0 before the error; of ray and control."""
    mock, start, found = adjusted
    told, before = assess_block(found), normalise_residuals(found)
    for row, axis, control in ((30, 1, False), (2, 2, True)):
        part = told.control if control else told.rays
        size = part.detectable[row, axis]
        changed = with_error(mock, start, row, axis, size, control)
        after = normalise_residuals(changed)
        which = "control" if control else "rays"
        w = [
            getattr(t, which)[row, axis] * f.sigma0
            for t, f in ((before, found), (after, changed))
        ]
        np.testing.assert_allclose(
            abs(w[1] - w[0]), told.delta0 * found.sigma0, rtol=2e-3
        )


def test_delta0_by_the_normal_distribution(adjusted):
    """Level .001 and power .8; all coordinates together at 5 %."""
    found = adjusted[2]
    normal = NormalDist()
    told = assess_block(found)
    np.testing.assert_allclose(told.limit, normal.inv_cdf(1 - 0.0005), rtol=1e-9)
    expected = normal.inv_cdf(1 - 0.0005) + normal.inv_cdf(0.8)
    np.testing.assert_allclose(told.delta0, expected, rtol=1e-4)
    together = assess_block(found, level=0.05, familywise=True)
    limit = normalise_residuals(found, 0.05).limit
    np.testing.assert_allclose(together.limit, limit, rtol=1e-12)
    ratio = together.delta0 / told.delta0
    own = together.rays.detectable
    np.testing.assert_allclose(own, ratio * told.rays.detectable, rtol=1e-12)
    with pytest.raises(ValueError, match="power is a probability"):
        assess_block(found, power=80.0)


def test_what_nothing_checks_is_told(adjusted):
    """x of points on two photos along the strip, and nothing else of them."""
    mock, _, found = adjusted
    told = assess_block(found)
    photos = np.bincount(mock.block.point, minlength=len(mock.block.points))
    unchecked = told.rays.unchecked
    assert np.all(photos[mock.block.point[unchecked[:, 0]]] == 2)
    assert np.any(unchecked[:, 0]) and not np.any(unchecked[:, 1])
    assert np.all(np.isinf(told.rays.detectable[unchecked]))
    assert np.all(np.isinf(told.rays.external[unchecked]))
    assert np.all(np.isinf(told.rays.largest[np.any(unchecked, axis=1)]))
    assert np.any(told.control.unchecked[:, 2])


def plant(seed, flight, size, kind):
    """Whether the tests name the point of one error, of so many detectable sizes, in a
    ray of a point on three photos or more or in a known coordinate; and what they name
    beside it."""
    mock = block.mock_block(5000 + seed, flight)
    measured, rng = mock.block, np.random.default_rng(seed)
    start = start_from(measured, mock.photos)
    clean = adjust_block(measured, start, mock.ground)
    told = assess_block(clean)
    part = told.rays if kind == "rays" else told.control
    checked = np.isfinite(part.detectable)
    if kind == "rays":
        photos = np.bincount(measured.point, minlength=len(measured.points))
        checked &= (photos[measured.point] >= 3)[:, None]
    row, axis = rng.permutation(np.argwhere(checked))[0]
    error = size * part.detectable[row, axis] / clean.sigma0 * rng.choice([-1, 1])
    ground, at = mock.ground, mock.ground.coordinates.copy()
    if kind == "rays":
        name = "xy"[axis]
        places = getattr(measured, name).copy()
        places[row] += error
        measured = measured._replace(**{name: places})
        point = measured.points[measured.point[row]]
    else:
        at[row, axis] += error
        ground = ground._replace(coordinates=at)
        point = ground.points[row]
    wrong = block.adjust_without_wrong(block.Given(measured, ground), start)[1]
    named = {measured.points[k] for k in measured.point[wrong.rays]}
    named |= {ground.points[k] for k in np.flatnonzero(np.any(wrong.control, axis=1))}
    return point in named, len(named - {point})


@pytest.mark.slow
@pytest.mark.parametrize(
    ("flight", "size", "kind", "share"),
    [
        ((1, 10), 1.5, "rays", 0.85),
        ((1, 10), 2.0, "rays", 0.95),
        ((1, 10), 1.5, "control", 0.85),
        ((1, 10), 2.0, "control", 0.95),
        ((3, 6), 1.5, "rays", 0.85),
        ((3, 6), 1.5, "control", 0.85),
        ((3, 6), 2.0, "control", 0.95),
    ],
)
def test_planted_errors_are_named(flight, size, kind, share):
    """Of 60 blocks each."""
    strips, models = flight
    found = [
        plant(seed, block.Flight(strips=strips, models=models), size, kind)
        for seed in range(60)
    ]
    named, beside = np.array(found, float).T
    assert np.mean(named) >= share
    assert np.mean(beside > 0) < 0.1
