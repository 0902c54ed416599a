"""Pictures of one pair: what is drawn where, by content and never by pixels."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxro
from jaxro import mock_pairs as mock, plots
from jaxro.plots.arrows import round_down
from jaxro.plots.points import MOST

pytest.importorskip("matplotlib")
from matplotlib.quiver import Quiver

SIGMA = 0.01
NAMES = [f"p{k}" for k in range(16)]


@pytest.fixture(scope="module")
def pair():
    """Sixteen points in eight rows with noise, over hills."""
    layout = mock.row_layout()
    heights = mock.relief(jax.random.key(1), layout, 5.0)
    exact = mock.mock_pair(layout, heights=heights)
    return mock.noisy(exact, jax.random.key(0), SIGMA).with_sigma(SIGMA)


@pytest.fixture(scope="module")
def orientation(pair):
    return jaxro.orient(pair)


def new_axes(*grid):
    return plots.new_figure().subplots(*grid)


def arrows(axes):
    (found,) = [c for c in axes.collections if isinstance(c, Quiver)]
    return found


def test_arrows_are_residuals_times_one_factor(pair, orientation):
    """Places, directions and lengths of both photos; the key says the size of its
    arrow."""
    rejected = np.arange(16) == 3
    pair = pair.with_mask(~rejected)
    given = new_axes(1, 2)
    drawn = plots.draw_photos(
        pair, orientation, rejected=rejected, names=NAMES, axes=given
    )
    assert drawn is given
    v = np.stack([np.asarray(c) for c in orientation.corrections(pair)])[:, ~rejected]
    at = np.stack([np.asarray(c) for c in pair.coordinates])
    factors = set()
    for axes, rows in zip(drawn, (slice(0, 2), slice(2, 4)), strict=True):
        shown = arrows(axes)
        factors.add(1 / shown.scale)
        np.testing.assert_allclose(np.stack([shown.U, shown.V]), v[rows])
        np.testing.assert_allclose(shown.XY.T, at[rows][:, ~rejected])
        (cross,) = [line for line in axes.lines if line.get_label() == "rejected"]
        np.testing.assert_allclose(cross.get_xydata(), at[rows][:, rejected].T)
        assert cross.get_marker() == "x"
        assert "p3" in [text.get_text() for text in axes.texts]
        assert axes.get_aspect() == 1 and axes.get_xlabel() == "x [mm]"
        key = next(a for a in axes.artists if hasattr(a, "U"))
        assert key.label == f"{key.U:g} mm"
        longest = np.max(np.hypot(*v.reshape(2, 2, -1).transpose(1, 0, 2)))
        assert longest >= key.U
    (factor,) = factors  # one for both photos
    assert f"× {factor:g}" in drawn[0].get_title()
    assert factor == pytest.approx(round_down(factor))


def test_standard_positions_are_marked_where_there_are_some(pair, orientation):
    """Circles at six places, at zero and one base; none for points at random."""
    from matplotlib.patches import Circle

    standard = mock.mock_pair(mock.standard_layout(7)).with_sigma(SIGMA)
    left, right = plots.draw_photos(standard, None)
    circles = lambda axes: [p for p in axes.patches if isinstance(p, Circle)]
    centres = np.array([c.center for c in circles(left)])
    expected = [(u * 70.0, v * 70.0) for u, v in mock.ZONES.values()]
    np.testing.assert_allclose(centres, expected, atol=1e-9)
    shifted = np.array([c.center for c in circles(right)])
    np.testing.assert_allclose(shifted - centres, [(-70.0, 0.0)] * 6, atol=1e-9)
    rng = np.random.default_rng(0)
    cluster = rng.uniform(30, 40, (2, 12))
    assert plots.find_zones(*cluster, 70.0) == []
    assert plots.find_zones(np.zeros(0), np.zeros(0), 70.0) == []


def test_points_beyond_the_limit_are_marked_and_named(pair):
    """Bars are the tests of the points, the lines stand at the limit."""
    wrong = mock.plant(pair, y_right=jnp.where(jnp.arange(16) == 5, 0.2, 0.0))
    reliability = jaxro.assess(wrong, jaxro.orient(wrong), sigma0=1.0)
    given = new_axes()
    axes = plots.draw_tests(reliability, names=NAMES, axes=given)
    assert axes is given
    w, limit = np.asarray(reliability.w), float(reliability.limit)
    heights = {
        round(bar.get_x() + bar.get_width() / 2): bar.get_height()
        for bar in axes.patches
    }
    np.testing.assert_allclose([heights[k] for k in range(16)], w)
    levels = [line.get_ydata()[0] for line in axes.lines]
    assert limit in levels and -limit in levels
    beyond = [NAMES[k] for k in np.flatnonzero(np.abs(w) > limit)]
    assert "p5" in beyond
    assert sorted(t.get_text() for t in axes.texts) == sorted(beyond)
    hatched = [bar for bar in axes.patches if bar.get_hatch()]
    assert len(hatched) == len(beyond)  # not by colour alone


def test_bars_of_many_points_are_those_of_the_largest_values():
    values = np.random.default_rng(3).normal(size=200)
    values[[7, 9]] = np.nan, np.inf
    axes = plots.draw_bars(values, 3.0)
    assert f"the {MOST} largest of 200 points" in axes.get_title()
    finite = sorted(abs(b.get_height()) for b in axes.patches if not b.get_hatch())
    size = np.sort(np.abs(values[np.isfinite(values)]))
    np.testing.assert_allclose(finite, size[-(MOST - 1) :])
    assert [t.get_text() for t in axes.texts] == ["10: any limit"]
    untested = plots.draw_bars(np.array([1.0, np.nan]), np.inf)
    labels = [line.get_label() for line in untested.lines]
    assert "not testable" in labels and not any("limit" in text for text in labels)


@pytest.mark.slow
def test_leave_one_out_draws_the_statistic_of_the_procedure(pair):
    procedure = jaxro.rejection.LeaveOneOutGrubbs(exact=False)
    wrong = mock.plant(pair, y_right=jnp.where(jnp.arange(16) == 5, 0.3, 0.0))
    found = procedure(wrong)
    axes = plots.draw_leave_one_out(wrong, procedure=procedure, names=NAMES)
    drawn = [bar.get_height() for bar in axes.patches]
    expected = np.asarray(found.log.statistic)[0]
    np.testing.assert_allclose(sorted(drawn), np.sort(expected))
    assert float(found.log.limit[0]) in [line.get_ydata()[0] for line in axes.lines]
    assert [text.get_text() for text in axes.texts] == ["p5"]
    assert len(plots.draw_round(found, 1).patches) == 15
    with pytest.raises(ValueError, match=r"there is no round 99"):
        plots.draw_round(found, 99)


def test_influence_tells_what_reliability_says(pair, orientation):
    reliability = jaxro.assess(pair, orientation, sigma0=1.0)
    given = new_axes(3, 1)
    drawn = plots.draw_influence(reliability, names=NAMES, unit="bases", axes=given)
    assert drawn is given
    heights = np.max(np.abs([reliability.effect_height[k] for k in (1, 3)]), axis=0)
    of = (reliability.redundancy, reliability.external, heights)
    for axes, values in zip(drawn, of, strict=True):
        bars = sorted(bar.get_height() for bar in axes.patches)
        np.testing.assert_allclose(bars, np.sort(np.asarray(values)))
        assert [t.get_text() for t in axes.get_xticklabels()] == NAMES
    bounds = [line.get_ydata()[0] for line in drawn[0].lines]
    assert bounds == list(jaxro.assessment.reliability.BOUNDS)


def test_unbounded_effects_are_hatched_up_to_the_border():
    axes = plots.draw_hidden(np.array([1.0, np.inf, 2.0]))
    (bar,) = [bar for bar in axes.patches if bar.get_hatch()]
    assert bar.get_height() == axes.get_ylim()[1] > 2.0
    assert bar.get_x() < 1 < bar.get_x() + bar.get_width()
    kinds = plots.draw_redundancy(np.array([0.001, 0.05, 0.2, 0.9]))
    labels = [text.get_text() for text in kinds.get_legend().get_texts()]
    assert labels == [f"{k} checked" for k in jaxro.assessment.reliability.CONTROL]


def test_sums_fall_to_that_of_the_orientation(pair, orientation):
    """The first is that of vertical photos, the last that of the minimum, which the
    line marks."""
    sums = plots.sums_by_step(pair)
    expected = float(np.sum(np.square(np.asarray(orientation.residuals))))
    assert sums[-1] == pytest.approx(expected, rel=1e-9)
    assert all(np.diff(sums) <= 1e-9 * np.array(sums[:-1]))
    axes = plots.draw_sums({"one": sums, "other": [5.0, 1e6]})
    one, other, limit = axes.lines
    np.testing.assert_allclose(one.get_ydata(), sums)
    assert limit.get_ydata()[0] == min(5.0, *sums)
    assert one.get_linestyle() != other.get_linestyle()
    assert axes.get_yscale() == "log" and axes.get_xlabel() == "iteration"
