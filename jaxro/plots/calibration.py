"""What a calibration corrects, how well it knows that, and how it compares with others:
maps over the image."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from ..calibration import Calibration, correct
from ..calibration.distortion import distortion_deviations
from ..xla.programs import compiled
from .arrows import ROOM, add_key, draw_arrows, enlargement, side_of
from .labels import show_name
from .style import (
    BLUE,
    DEVIATIONS,
    ORANGE,
    SMALL,
    add_colours,
    add_legend,
    describe,
    make_plan,
    plan_or_new,
    times,
    two_plans_or_new,
    with_unit,
)
from .zones import draw_zones, measured_area, nodes_over

NODES = 15
"""Nodes along each side of a map of corrections."""


class CorrectionMap(NamedTuple):
    """The corrections of a camera on nodes over the measured area, in the measuring
    system and the unit of the image; `deviations` of the distortion, without what errors
    of the pose imitate; `total`: with the errors of principal place and focal length,
    which all places share; which nodes lie `inside` of the measured places."""

    places: Float[np.ndarray, "node 2"]
    corrections: Float[np.ndarray, "node 2"]
    deviations: Float[np.ndarray, "node 2"]
    total: Float[np.ndarray, "node 2"]
    inside: Bool[np.ndarray, " node"]


def map_corrections(found: Calibration) -> CorrectionMap:
    """The map of a calibration. Needs scipy."""
    nodes = nodes_over(measured_area(found), NODES)
    ideal = correct(found, nodes)
    upward = np.array([1.0, -1.0 if is_y_down(found) else 1.0])
    at = np.asarray(found.principal) + np.asarray(ideal.places) * upward
    deviations = compiled(distortion_deviations)(found, nodes)
    return CorrectionMap(
        places=nodes,
        corrections=at - nodes,
        deviations=np.asarray(deviations),
        total=np.asarray(ideal.deviations),
        inside=ideal.inside,
    )


def is_y_down(found: Calibration) -> bool:
    """Whether y of the image points down."""
    return bool(found.frame.handedness > 0)


def draw_vectors(
    places: Float[np.ndarray, "place 2"],
    shifts: Float[np.ndarray, "place 2"],
    *,
    zones_of: Calibration | None = None,
    in_deviations: Float[np.ndarray, " place"] | None = None,
    unit: str = "mm",
    title: str = "Corrections",
    y_down: bool = False,
    axes: Any = None,
) -> Any:
    """Arrows at places of an image, enlarged; with the zones and the measured area of a
    calibration, and coloured by their length in standard deviations, where these are
    given."""
    axes = plan_or_new(axes, places)
    longest = float(np.max(np.hypot(*shifts.T), initial=0.0))
    factor = enlargement(side_of(places), longest)
    if zones_of is not None:
        draw_zones(axes, zones_of)
    axes.plot(*places.T, ".", color=BLUE, ms=2.5)
    if in_deviations is None:
        drawn = draw_arrows(axes, places, shifts, factor)
    else:
        drawn = draw_arrows(
            axes, places, shifts, factor, colours=in_deviations, cmap=DEVIATIONS
        )
        add_colours(axes, drawn, "length in standard deviations")
    if longest > 0:
        add_key(axes, drawn, longest, unit)
    told = f"{title} {times(factor)}"
    _finish(axes, told, unit, y_down)
    return axes


def draw_uncertainty(
    places: Float[np.ndarray, "node 2"],
    deviations: Float[np.ndarray, "node 2"],
    inside: Bool[np.ndarray, " node"],
    *,
    zones_of: Calibration | None = None,
    unit: str = "mm",
    title: str = "Standard deviation of the distortion",
    y_down: bool = False,
    axes: Any = None,
) -> Any:
    """The standard deviation of a coordinate (root mean square of both) over a square
    grid of nodes as colours, of the nodes among the measured places."""
    axes = plan_or_new(axes, places)
    size = np.sqrt(np.mean(np.square(deviations), axis=1))
    number = round(np.sqrt(len(places)))
    drawn = axes.pcolormesh(
        *places.T.reshape(2, number, number),
        np.where(inside, size, np.nan).reshape(number, number),
        cmap=DEVIATIONS,
        shading="nearest",
        rasterized=True,
    )
    if zones_of is not None:
        draw_zones(axes, zones_of)
    add_colours(axes, drawn, with_unit("standard deviation", unit), below=True)
    _finish(axes, title, unit, y_down)
    return axes


def draw_calibration(
    found: Calibration, *, unit: str = "mm", title: str = "", axes: Any = None
) -> Any:
    """The corrections of a calibration with its zones, and their standard deviations.
    `axes`: both."""
    found.check()
    of = map_corrections(found)
    return draw_corrections(of, found, unit=unit, title=title, axes=axes)


def draw_corrections(
    of: CorrectionMap,
    found: Calibration,
    *,
    unit: str = "mm",
    title: str = "",
    axes: Any = None,
) -> Any:
    """The same of a map that has been calculated."""
    left, right = axes = two_plans_or_new(axes, of.places)
    y_down = is_y_down(found)
    told = lambda what: f"{title}: {what}" if title else what.capitalize()
    common = {"zones_of": found, "unit": unit, "y_down": y_down}
    draw_vectors(
        of.places[of.inside],
        of.corrections[of.inside],
        title=told("corrections"),
        axes=left,
        **common,
    )
    draw_uncertainty(
        of.places,
        of.deviations,
        of.inside,
        title=told("standard deviations"),
        axes=right,
        **common,
    )
    return axes


def draw_variants(
    names: Sequence[str],
    behind: Sequence[float],
    left_out: Sequence[float],
    *,
    unit: str = "mm",
    axes: Any = None,
) -> Any:
    """The models of a comparison, the best one first: how far the evidence for each is
    behind that for the best, and the error of coordinates that were left out. `axes`:
    both."""
    if axes is None:
        from .style import new_figure

        figure = new_figure(1.2 + 0.22 * len(names))
        axes = figure.subplots(1, 2, sharey=True)
    left, right = axes
    at = np.arange(len(names))
    left.barh(at, behind, color=BLUE)
    right.barh(at, left_out, color=ORANGE, hatch="//", edgecolor="white")
    left.set_yticks(at, [show_name(str(name)) for name in names])
    left.invert_yaxis()
    describe(left, "Behind the best", "-2 log evidence", "model")
    describe(right, "Coordinates left out", with_unit("error", unit), "")
    left.tick_params(axis="y", labelsize=SMALL)
    right.locator_params(axis="x", nbins=4)
    return axes


def _finish(axes: Any, title: str, unit: str, y_down: bool) -> None:
    describe(axes, title, with_unit("x", unit), with_unit("y", unit), room=ROOM)
    make_plan(axes)
    if y_down and not axes.yaxis_inverted():
        axes.invert_yaxis()
    add_legend(axes)
