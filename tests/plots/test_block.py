"""Pictures of an adjusted block, by content."""

import numpy as np
import pytest

from jaxro import plots
from jaxro.adjustment import critical_values
from jaxro.block.orient_block import orient_block
from jaxro.tables.examples import block as example

pytest.importorskip("matplotlib")
from matplotlib.collections import LineCollection
from matplotlib.quiver import Quiver


@pytest.fixture(scope="module")
def made():
    """A simulated strip with control and check points, and its adjustment."""
    one = example.simulate(models=4, seed=3)
    return one, orient_block(one.left, one.right, one.pairs, one.points, one.ground)


def known_points(made):
    one, oriented = made
    off = oriented.adjusted.compare(one.ground)[0]
    check = one.ground.check
    return [
        plots.KnownPoints(
            kind,
            [name for name, here in zip(one.ground.points, which, strict=True) if here],
            one.ground.coordinates[which],
            off[which],
        )
        for kind, which in (("control", ~check), ("check points", check))
    ]


@pytest.mark.slow
def test_differences_are_drawn_at_known_points_by_one_factor(made):
    _, oriented = made
    adjusted, known = oriented.adjusted, known_points(made)
    given = plots.new_figure().subplots()
    axes = plots.draw_differences(
        adjusted, known, wrong=oriented.wrong.rays, axes=given
    )
    assert axes is given
    drawn = [c for c in axes.collections if isinstance(c, Quiver)][:2]
    factor = 1 / drawn[0].scale
    for shown, one in zip(drawn, known, strict=True):
        np.testing.assert_allclose(shown.XY, one.given[:, :2])
        plan = np.stack([shown.U, shown.V], axis=1)
        np.testing.assert_allclose(plan, one.differences[:, :2])
        assert 1 / shown.scale == factor
    ends = [line.get_ydata() for line in axes.lines if line.get_linestyle() == "--"]
    heights = [float(end[1] - end[0]) for end in ends if len(end) == 2]
    expected = np.concatenate([one.differences[:, 2] for one in known]) * factor
    np.testing.assert_allclose(heights, expected, atol=1e-9)
    assert f"× {factor:g}" in axes.get_title()
    lines = {line.get_label(): line.get_xydata() for line in axes.lines}
    wrong = np.unique(adjusted.block.point[oriented.wrong.rays])
    ring = lines["wrong place left out"]
    np.testing.assert_allclose(ring, adjusted.coordinates[wrong, :2])
    np.testing.assert_allclose(lines["photos"], adjusted.centres[:, :2])


@pytest.mark.slow
def test_ellipses_and_heights_are_those_of_the_covariances(made):
    adjusted = made[1].adjusted
    axes = plots.draw_accuracy(adjusted)
    there = np.all(np.isfinite(adjusted.coordinates), axis=1)
    (outlines,) = [c for c in axes.collections if isinstance(c, LineCollection)]
    factor = float(axes.get_title().split("× ")[1])
    radius = float(critical_values.radius(0.95, 2, adjusted.degrees_of_freedom))
    values = np.linalg.eigvalsh(adjusted.point_covariances[there][:, :2, :2])
    for line, at, value in zip(
        outlines.get_segments(), adjusted.coordinates[there], values, strict=True
    ):
        largest = np.max(np.hypot(*(line - at[:2]).T))
        assert largest == pytest.approx(factor * radius * np.sqrt(value[1]), rel=5e-3)
    colours = axes.collections[0].get_array()
    np.testing.assert_allclose(colours, adjusted.deviations[there, 2])


def test_residuals_of_all_photos_stand_at_their_places(made):
    adjusted = made[1].adjusted
    axes = plots.draw_block_residuals(adjusted)
    (shown,) = [c for c in axes.collections if isinstance(c, Quiver)]
    used = np.all(np.isfinite(adjusted.residuals), axis=1)
    assert np.sum(~used) == np.sum(made[1].wrong.rays)
    block = adjusted.block
    np.testing.assert_allclose(shown.XY, np.stack([block.x, block.y], axis=1)[used])
    residuals = np.stack([shown.U, shown.V], axis=1)
    np.testing.assert_allclose(residuals, adjusted.residuals[used])


def test_both_plans_are_drawn_together(made):
    given = plots.new_figure().subplots(2, 1)
    adjusted, known = made[1].adjusted, known_points(made)
    assert plots.draw_block(adjusted, known, axes=given) is given
    first, second = plots.draw_block(adjusted)
    assert first.get_title() == "Block" and "95 %" in second.get_title()
