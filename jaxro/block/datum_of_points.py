"""A free network referred to object points: inner constraints on these in place of those
on its photos (`datum`), as close-range networks are judged.

Of all datums this one has the least variance of the points that it names. Deviations,
covariances and what undetected errors do become those of this datum; coordinates,
residuals and tests stay (`adjustment.referred`).
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from ..adjustment.referred import Rows, refer
from ..camera.condition import Station
from .adjust import BlockAdjustment

WIDE = 1e-3
"""Width of the datum points over their length from which on they are on no line."""


def refer_to_points(
    adjusted: BlockAdjustment, points: Sequence[str] | None = None
) -> BlockAdjustment:
    """The network on a datum of the points that are named, or of all of them.

    Raises ValueError for a network that its known points hold, for a name that is not in
    the adjustment, and for points on one line; RuntimeError for an adjustment that is not
    usable.
    """
    adjusted.check()
    if adjusted.known:
        raise ValueError(
            "refer_to_points: known points hold the network, its datum is theirs"
        )
    number = _numbers(adjusted, points)
    families = adjusted.adjustment.parameters
    at = np.asarray(families["point"])
    middle = np.mean(at[number], axis=0)
    widths = np.linalg.svd(at[number] - middle, compute_uv=False)
    if len(number) < 3 or widths[1] < WIDE * widths[0]:
        raise ValueError(
            "refer_to_points: three points that are on no line are needed, about which "
            "the network could turn"
        )
    has_scale = len(adjusted.bar_rows) > 0
    moved: Rows = {
        "photo": _of_photos(families["photo"], middle),
        **{
            name: _of_points(np.asarray(families[name]), middle)
            for name in ("point", "end")
            if name in families
        },
    }
    moved = {name: a[:, :, : 6 if has_scale else 7] for name, a in moved.items()}
    of_datum = np.zeros_like(moved["point"])
    of_datum[number] = moved["point"][number]
    return replace(
        adjusted, adjustment=refer(adjusted.adjustment, moved, {"point": of_datum})
    )


def _numbers(adjusted: BlockAdjustment, points: Sequence[str] | None) -> np.ndarray:
    """The numbers of points in the adjustment. Raises ValueError."""
    of_names = dict(
        zip(adjusted.block.points, adjusted.numbered.number.tolist(), strict=True)
    )
    names = [name for name, k in of_names.items() if k >= 0]
    for name in names if points is None else points:
        if of_names.get(name, -1) < 0:
            raise ValueError(
                f"refer_to_points: point {name!r} is not in the adjustment"
            )
    return np.array([of_names[name] for name in (points or names)], int)


def _of_points(
    at: Float[np.ndarray, "point 3"], middle: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "point 3 7"]:
    """How points go with the network: shifts e_k, turns e_k × X, a change of scale."""
    about = at - middle
    shifts = np.broadcast_to(np.eye(3), (len(at), 3, 3))
    turns = np.cross(np.eye(3)[None], about[:, None])
    return np.concatenate([shifts, np.swapaxes(turns, 1, 2), about[:, :, None]], axis=2)


def _of_photos(
    stations: Station, middle: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "photo 6 7"]:
    """How the turns about their own axes and the centres of photos go with it: a turn of
    the ground by e turns a photo by -R e."""
    from scipy.spatial.transform import Rotation

    quaternions = np.asarray(stations.quaternion)[:, [1, 2, 3, 0]]
    turns = np.zeros((len(quaternions), 3, 7))
    turns[:, :, 3:6] = -Rotation.from_quat(quaternions).as_matrix()
    return np.concatenate([turns, _of_points(np.asarray(stations.centre), middle)], 1)
