"""Pictures of calibrations: zones, corrections, their accuracy, models."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

from jaxro import calibration, plots
from jaxro.plots.zones import FINE, border_fields

pytest.importorskip("matplotlib")
from matplotlib.quiver import Quiver


def new_axes(*grid):
    return plots.new_figure().subplots(*grid)


def arrows(axes):
    return [c for c in axes.collections if isinstance(c, Quiver)]


@pytest.fixture(scope="module")
def plain():
    """A calibration of one focal length, of pixels with y downwards."""
    rng = np.random.default_rng(5)
    points = rng.uniform([-4, -3, -1], [4, 3, 1], (40, 3))
    depth = 12.0 - points[:, 2]
    x, y = 1000 * points[:, 0] / depth + 500, -1000 * points[:, 1] / depth + 400
    image = calibration.image(x, y, points, y_down=True)
    return calibration.calibrate(image).check()


def with_zones(found, **zones):
    """The same calibration as if it had these zones, and its places."""
    model = calibration.Model(**zones)
    return replace(found, model=model), np.asarray(found.measured.places)


def contours(axes):
    """The points of all contours drawn."""
    from matplotlib.contour import ContourSet

    sets = [c for c in axes.collections if isinstance(c, ContourSet)]
    return [path.vertices for one in sets for path in one.get_paths()]


@pytest.mark.slow
def test_borders_of_strips_stand_where_the_zones_change(plain):
    """Columns of unequal width, and two rows: lines at their borders within the measured
    area, which is the rectangle around the places."""
    found, places = with_zones(plain, x=calibration.rectangles([0, 1, 3, 4], 2))
    axes = new_axes()
    assert plots.draw_zones(axes, found) is axes
    low, high = places.min(axis=0), places.max(axis=0)
    (box,) = axes.patches
    np.testing.assert_allclose(box.get_bbox().extents, [*low, *high])
    part = (np.concatenate(contours(axes)) - low) / (high - low)
    columns = np.unique(np.round(part[np.ptp(part[:, :1], axis=1) == 0][:, 0], 6))
    assert {0.25, 0.75} <= set(columns)
    assert np.any(np.abs(part[:, 1] - 0.5) < 1e-6)
    on_a_border = np.min(np.abs(part[:, :1] - [0.25, 0.75]), axis=1) < 1e-6
    assert np.all(on_a_border | (np.abs(part[:, 1] - 0.5) < 1e-6))


@pytest.mark.slow
@pytest.mark.parametrize("degree", [0, 2])
def test_rings_are_circles_about_the_principal_place(plain, degree):
    found, places = with_zones(plain, x=calibration.rings(2, degree))
    axes = new_axes()
    plots.draw_zones(axes, found)
    centre = np.asarray(plain.frame.measured_places(plain.area.principal))
    radius = np.max(np.hypot(*(places - centre).T)) / 2
    lines = np.concatenate(contours(axes))
    drawn = np.hypot(*(lines - centre).T)
    np.testing.assert_allclose(drawn, radius, rtol=2e-3)


@pytest.mark.slow
def test_zones_of_any_form_are_told_by_their_numbers(plain):
    """The border lies between nodes of different numbers."""
    number = lambda u: (u[:, 0] + u[:, 1] > 0).astype(int)
    zones = calibration.Numbered(number, 2)
    found, places = with_zones(plain, x=zones)
    ((values, levels),) = border_fields(found, zones, places)
    u = np.asarray(found.frame.normal_places(jnp.asarray(places)))
    np.testing.assert_array_equal(values, np.sum(u, axis=1) > 0)
    assert levels == [0.5]
    axes = new_axes()
    plots.draw_zones(axes, found)
    assert len(contours(axes)) and FINE > 2
    empty = new_axes()
    plots.draw_zones(empty, plain)
    assert not contours(empty)


@pytest.mark.parametrize("y_down", [True, False])
def test_corrections_are_vectors_over_the_image(y_down):
    rng = np.random.default_rng(6)
    places, shifts = rng.uniform(0, 50, (30, 2)), rng.normal(0, 0.1, (30, 2))
    axes = plots.draw_vectors(places, shifts, unit="px", y_down=y_down)
    (shown,) = arrows(axes)
    np.testing.assert_allclose(np.stack([shown.U, shown.V], axis=1), shifts)
    np.testing.assert_allclose(shown.XY, places)
    assert f"× {1 / shown.scale:g}" in axes.get_title()
    assert axes.yaxis_inverted() == y_down and axes.get_ylabel() == "y [px]"
    colours = plots.draw_vectors(places, shifts, in_deviations=np.arange(30.0))
    np.testing.assert_array_equal(arrows(colours)[0].get_array(), np.arange(30.0))


def test_uncertainty_is_shown_among_the_measured_places_only():
    nodes = np.stack(np.meshgrid(np.arange(4.0), np.arange(4.0)), axis=-1).reshape(
        -1, 2
    )
    deviations = np.stack([np.arange(16.0), np.arange(16.0) + 1], axis=1)
    inside = np.arange(16) % 5 != 0
    axes = plots.draw_uncertainty(nodes, deviations, inside)
    (mesh,) = axes.collections
    values = np.ma.filled(mesh.get_array().ravel(), np.nan)
    expected = np.where(inside, np.sqrt(np.mean(deviations**2, axis=1)), np.nan)
    np.testing.assert_allclose(values, expected)


@pytest.mark.slow
def test_the_map_is_that_of_corrected_coordinates(plain):
    """Both panels; an image without distortion has the corrections of its principal
    place alone, which are none."""
    given = new_axes(1, 2)
    assert plots.draw_calibration(plain, unit="px", axes=given) is given
    found = plots.map_corrections(plain)
    assert np.max(np.abs(found.corrections)) < 1e-6
    low, high = found.places.min(axis=0), found.places.max(axis=0)
    places = np.asarray(plain.measured.places)
    np.testing.assert_allclose([low, high], [places.min(axis=0), places.max(axis=0)])
    assert all(axes.yaxis_inverted() for axes in given)
    (shown,) = arrows(given[0])
    np.testing.assert_allclose(shown.XY, found.places[found.inside])


def test_models_that_were_compared_are_bars():
    left, right = plots.draw_variants(["f", "fx, fy"], [0.0, 3.0], [0.01, 0.02])
    assert [bar.get_width() for bar in left.patches] == [0.0, 3.0]
    assert [bar.get_width() for bar in right.patches] == [0.01, 0.02]
    assert [text.get_text() for text in left.get_yticklabels()] == ["f", "fx, fy"]
