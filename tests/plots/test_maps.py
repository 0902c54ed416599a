"""Files of pictures, labels, and pictures of surveys, layouts, comparisons, many
pairs."""

import re
import subprocess
import sys

import jax.numpy as jnp
import numpy as np
import pytest

from jaxro import layout_design, plots
from jaxro.plots.labels import place_labels

pytest.importorskip("matplotlib")


def new_axes(*grid):
    return plots.new_figure().subplots(*grid)


# -------------------------------------------------------------------------------------
# files


def test_an_svg_can_stand_beside_others_in_a_page():
    """Text is text, nothing tells a time, every reference is met, and two pictures
    share no name."""
    texts = []
    for number in (3, 4):
        axes = plots.draw_bars(
            np.arange(number) - 1.0, 1.5, names=list("abcd")[:number]
        )
        texts.append(plots.to_svg(axes))
        assert texts[-1] == plots.to_svg(axes)
    for text in texts:
        assert text.startswith('<svg role="img" aria-label="Tests of points"')
        assert ">Tests of points</text>" in text and "metadata" not in text
        names = re.findall(r'\bid="([^"]+)"', text)
        assert len(names) == len(set(names))
        told = re.findall(r'url\(#([^)]+)\)|href="#([^"]+)"', text)
        assert told and {a or b for a, b in told} <= set(names)
    one, other = (set(re.findall(r'\bid="([^"]+)"', text)) for text in texts)
    assert not one & other


def test_files_of_all_kinds_repeat(tmp_path):
    axes = plots.draw_sums({"a": [3.0, 1.0]})
    for kind, start in ((".png", b"\x89PNG"), (".pdf", b"%PDF"), (".svg", b"<svg")):
        made = plots.WRITERS[kind](axes)
        assert made.startswith(start) and made == plots.WRITERS[kind](axes)
    assert plots.to_png((axes, axes)) == plots.to_png(axes.figure)


def test_matplotlib_waits_for_the_first_picture():
    script = (
        "import sys, jaxro; from jaxro.plots import draw_bars; import numpy as np; "
        "print('matplotlib' in sys.modules); draw_bars(np.ones(3), 2.0); "
        "print('matplotlib' in sys.modules, 'matplotlib.pyplot' in sys.modules)"
    )
    line = [sys.executable, "-c", script]
    done = subprocess.run(line, capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["False", "True", "False"]


def test_labels_cover_neither_each_other_nor_points():
    axes = plots.new_figure(3.0, 3.0).subplots()
    places = np.random.default_rng(0).uniform(0, 1, (60, 2))
    axes.plot(*places.T, ".")
    place_labels(axes, places, [f"p{k}  12.3" for k in range(60)])
    boxes = [text.get_window_extent() for text in axes.texts]
    assert 20 < len(boxes) < 60
    for k, box in enumerate(boxes):
        assert not box.count_overlaps(boxes[k + 1 :])
        assert not any(box.contains(*p) for p in axes.transData.transform(places))


# -------------------------------------------------------------------------------------
# surveys, layouts, comparisons, many pairs


def test_heights_and_their_deviations_stand_at_the_points():
    rng = np.random.default_rng(8)
    x, y = rng.uniform(0, 100, (2, 20))
    height, deviation = rng.normal(0, 10, 20), rng.uniform(0.1, 0.5, 20)
    deviation[:2] = 0
    legs = np.array([[0, 1], [1, 2]])
    names = [f"p{k}" for k in range(20)]
    given = new_axes(1, 2)
    drawn = plots.draw_heights(
        x, y, height, deviation, legs=legs, names=names, axes=given
    )
    assert drawn is given
    left, right = drawn
    (circles,) = [c for c in right.collections if c.get_label() == "computed"]
    np.testing.assert_allclose(circles.get_offsets(), np.stack([x, y], axis=1)[2:])
    sizes = circles.get_sizes() / circles.get_sizes()[0]
    np.testing.assert_allclose(sizes, (deviation[2:] / deviation[2]) ** 2)
    (given_line,) = [line for line in right.lines if line.get_label() == "given"]
    np.testing.assert_allclose(given_line.get_xdata(), x[:2])
    assert {t.get_text() for t in left.texts} <= {
        f"{n}  {h:.0f}" for n, h in zip(names, height, strict=True)
    }
    line = plots.draw_surface(x, 2 * x, height)  # no surface lies on a line
    np.testing.assert_allclose(line.collections[0].get_offsets()[:, 0], x)


@pytest.mark.parametrize("best", [0, 1])
def test_lines_lead_to_where_points_went_from_their_start_only(best):
    """Points of another start have nothing to do with those drawn."""
    overlap = layout_design.Overlap((0.0, 70.0), (-60.0, 60.0), 70.0, 70.0)
    after = jnp.where(jnp.arange(2) == best, 0.1, 0.2)
    x, y = jnp.array([60.0, 5.0, 30.0]), jnp.array([50.0, -50.0, 0.0])
    design = layout_design.Design(x, y, jnp.min(after), after, after, after > 0)
    start = np.array([10.0, 5.0]), np.array([0.0, 10.0])
    given = new_axes()
    axes = plots.draw_layout(overlap, design, start, kept=1, before=0.4, axes=given)
    assert axes is given
    lines = {line.get_label(): line.get_xydata() for line in axes.lines}
    np.testing.assert_allclose(lines["before"], np.stack(start, axis=1))
    np.testing.assert_allclose(lines["after"], np.stack([x, y], axis=1)[:2])
    np.testing.assert_allclose(lines["kept"], [[30.0, 0.0]])
    moves = [(text.xyann, text.xy) for text in axes.texts]
    assert len(moves) == (2 if best == 0 else 0)
    if best == 0:
        np.testing.assert_allclose(moves[0], [(10.0, 0.0), (60.0, 50.0)])
    np.testing.assert_allclose(axes.patches[0].get_bbox().extents, [0, -60, 70, 60])
    assert "0.4 → 0.1" in axes.get_title()


def test_power_is_drawn_in_percent_by_size():
    curves = [
        plots.Curve("one", [8.0, 4.0], [0.9, 0.2], [0.01, 0.02], 0.05),
        plots.Curve("other", [4.0, 8.0], [0.3, 0.4], [0.0, 0.0]),
    ]
    given = new_axes()
    axes = plots.draw_power(curves, axes=given)
    assert axes is given
    one, other = (container.lines[0] for container in axes.containers)
    np.testing.assert_allclose(one.get_xydata(), [[4.0, 20.0], [8.0, 90.0]])
    np.testing.assert_allclose(other.get_xydata(), [[4.0, 30.0], [8.0, 40.0]])
    (bars,) = axes.containers[0].lines[2]
    np.testing.assert_allclose(
        [s[:, 1] for s in bars.get_segments()], [[16, 24], [88, 92]]
    )
    assert one.get_marker() != other.get_marker()
    told = [text.get_text() for text in axes.get_legend().get_texts()]
    assert told == ["one (5.0 % false alarms)", "other"]


def test_the_distribution_counts_what_exists():
    values = np.array([0.5, 1.0, 1.5, np.nan, np.inf, 2.0])
    axes = plots.draw_distribution(values, expected=1.0)
    assert sum(bar.get_height() for bar in axes.patches) == 4
    assert "4 of 6 pairs" in axes.get_title()
    assert [line.get_xdata()[0] for line in axes.lines] == [1.25, 1.0]
    assert plots.draw_distribution(np.append(values, 1e9)).get_xscale() == "log"
    assert not plots.draw_distribution(np.array([np.nan])).patches
