"""Zones of a calibrated image and the area that was measured in it."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ..calibration import AbstractZones, Calibration, Pieces
from .style import BLACK, PURPLE

FINE = 121
"""Nodes along each side of the area from which borders of zones are drawn."""

WHOLE, SLOPE = Pieces((0.0, 1.0), 0), Pieces((0.0, 1.0), 1)
"""One piece, and a straight line over it, whose second weight is the coordinate."""


def measured_area(found: Calibration) -> Float[np.ndarray, "4"]:
    """The smallest rectangle around the measured places: least x and y, largest x and
    y."""
    frame = found.frame
    half = np.asarray(frame.half_sides * frame.size)
    centre = np.asarray(frame.centre)
    return np.concatenate([centre - half, centre + half])


def nodes_over(area: Float[np.ndarray, "4"], number: int) -> Float[np.ndarray, "_ 2"]:
    """Nodes over a rectangle, row by row, so many along each side."""
    x, y = np.linspace(area[:2], area[2:], number).T
    return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)


def draw_zones(axes: Any, found: Calibration) -> Any:
    """The borders of the zones of a calibration as lines, those of a focal length of its
    own along y dashed, and the measured area as a rectangle of dots."""
    from matplotlib.patches import Rectangle

    (x0, y0, x1, y1) = measured_area(found).tolist()
    how = {"fill": False, "linestyle": ":", "linewidth": 1.2, "edgecolor": BLACK}
    area = Rectangle((x0, y0), x1 - x0, y1 - y0, label="measured area", **how)
    axes.add_patch(area)
    model = found.model
    kinds = [(model.x, "-", "zones")]
    if model.y is not None:
        kinds = [(model.x, "-", "zones of fx"), (model.y, "--", "zones of fy")]
    for zones, style, label in kinds:
        _draw_borders(axes, found, zones, style, label)
    return axes


def border_fields(
    found: Calibration, zones: AbstractZones, places: Float[np.ndarray, "place 2"]
) -> list[tuple[Float[np.ndarray, " place"], list[float]]]:
    """Functions of the place, and their values at the borders between zones: for each
    axis of pieces (x, y or r) its coordinate from 0 to 1; the number of the zone for
    zones of any other form."""
    u = found.frame.normal_places(jnp.asarray(places))
    is_pieces = lambda part: isinstance(part, Pieces)
    parts, form = jax.tree.flatten(zones, is_leaf=is_pieces)
    along = [k for k, part in enumerate(parts) if is_pieces(part)]
    fields = []
    for k in along:
        one = [
            SLOPE if j == k else WHOLE if j in along else parts[j]
            for j in range(len(parts))
        ]
        weights = jax.tree.unflatten(form, one).weights(u, found.area)
        fields.append((np.asarray(weights)[:, 1], list(parts[k].borders[1:-1])))
    if not along:
        number = np.argmax(np.asarray(zones.weights(u, found.area)), axis=1)
        levels = np.arange(zones.count - 1) + 0.5
        fields.append((number.astype(float), levels.tolist()))
    return fields


def _draw_borders(
    axes: Any, found: Calibration, zones: AbstractZones, style: str, label: str
) -> None:
    """Lines between the zones, none around all of them."""
    nodes = nodes_over(measured_area(found), FINE)
    x, y = nodes[:FINE, 0], nodes[::FINE, 1]
    how = {"colors": PURPLE, "linestyles": style, "linewidths": 1.2, "zorder": 2}
    drawn = False
    for values, levels in border_fields(found, zones, nodes):
        if levels and np.ptp(values) > 0:
            axes.contour(x, y, values.reshape(FINE, FINE), levels=levels, **how)
            drawn = True
    if drawn:
        axes.plot([], [], style, color=PURPLE, lw=1.2, label=label)
