"""The coordinates of oriented pairs, one model a pair, which the classical adjustment of
independent models takes for measurements; and how they depend on the places on the
photos, which were measured.

Axes of a model are those of its left photo (y up, z backward), its base is 1.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..assessment.sensitivity import Derivatives, derivatives
from ..geometry.pairs import pair, room_for
from ..orientation.result import Orientation
from .measured_block import MeasuredBlock


class ModelCoordinates(NamedTuple):
    """Coordinates of models, row by row: in which model, of which point, and `at` which
    place. Projection centres are points behind those of the block: `point` is then the
    number of points plus that of the photo.

    `left`, `right`: the photos of each model. `by_places`: the sparse matrix (3 row, 2
    ray) of exact derivatives by x and y of each ray of the block.
    """

    block: MeasuredBlock
    left: Int[np.ndarray, " model"]
    right: Int[np.ndarray, " model"]
    model: Int[np.ndarray, " row"]
    point: Int[np.ndarray, " row"]
    at: Float[np.ndarray, "row 3"]
    by_places: Any

    @property
    def is_centre(self) -> Bool[np.ndarray, " row"]:
        """Which rows are projection centres."""
        return self.point >= len(self.block.points)

    def without_centres(self) -> "ModelCoordinates":
        """The rows of points."""
        use = ~self.is_centre
        return self._replace(
            model=self.model[use],
            point=self.point[use],
            at=self.at[use],
            by_places=self.by_places[np.repeat(use, 3)],
        )


def measure_models(
    block: MeasuredBlock, left: Sequence[str], right: Sequence[str]
) -> ModelCoordinates:
    """Orient pairs of photos, given by their names, and intersect their common points.

    Of several places of a point on a photo the first one is used. Raises ValueError for
    a photo that is not there, and for a pair without a usable orientation.
    """
    from scipy.sparse import coo_array

    number = {name: k for k, name in enumerate(block.photos)}
    for name in [*left, *right]:
        if name not in number:
            raise ValueError(f"measure_models: the block has no photo {name!r}")
    ends = np.array([[number[name] for name in side] for side in (left, right)])
    common = [_common(block, one, other) for one, other in ends.T.tolist()]
    most = room_for(max(1, *(len(one) for one, _ in common)))

    model, point, at, entries, begin = [], [], [], [], 0
    for k, (one, other) in enumerate(common):
        found = _derivatives(block, one, other, block.focal[ends[:, k]], most)
        if not bool(found.usable):
            raise ValueError(
                f"measure_models: the photos {left[k]!r} and {right[k]!r} have no usable "
                "orientation: leave the pair out, or its wrong points"
            )
        use = [*range(len(one)), most, most + 1]
        rows = np.append(block.point[one], len(block.points) + ends[:, k])
        model.append(np.full(len(rows), k))
        point.append(rows)
        at.append(np.asarray(found.value)[use])
        for rays, by_x, by_y in (
            (one, found.x_left, found.y_left),
            (other, found.x_right, found.y_right),
        ):
            by = np.stack([np.asarray(by_x), np.asarray(by_y)], axis=3)
            by = by[use][:, :, : len(rays)].reshape(3 * len(rows), -1)
            column = (2 * rays[:, None] + np.arange(2)).ravel()
            row = 3 * begin + np.arange(len(by))
            both = np.broadcast_arrays(row[:, None], column[None])
            entries.append((by.ravel(), both[0].ravel(), both[1].ravel()))
        begin += len(rows)
    by, row, column = (np.concatenate(part) for part in zip(*entries, strict=True))
    shape = 3 * begin, 2 * len(block.photo)
    return ModelCoordinates(
        block=block,
        left=ends[0],
        right=ends[1],
        model=np.concatenate(model),
        point=np.concatenate(point),
        at=np.concatenate(at),
        by_places=coo_array((by, (row, column)), shape).tocsr(),
    )


def _common(
    block: MeasuredBlock, left: int, right: int
) -> tuple[Int[np.ndarray, " some"], Int[np.ndarray, " some"]]:
    """The rays of the common points of two photos."""
    one, other = (np.flatnonzero(block.photo == photo) for photo in (left, right))
    _, first, second = np.intersect1d(
        block.point[one], block.point[other], return_indices=True
    )
    return one[first], other[second]


def _derivatives(
    block: MeasuredBlock,
    one: Int[np.ndarray, " some"],
    other: Int[np.ndarray, " some"],
    focal: Float[np.ndarray, "2"],
    most: int,
) -> Derivatives:
    """Model coordinates of `most` points and of the two centres, and their derivatives;
    all pairs have the same program."""
    missing = most - len(one)
    longer = lambda a, value: np.pad(a, (0, missing), constant_values=value)
    sigma = np.maximum(block.sigma[one], block.sigma[other])
    measured = pair(
        *(longer(a[rays], 0.0) for rays in (one, other) for a in (block.x, block.y)),
        focal=tuple(focal),
        sigma=longer(sigma, 1.0),
        mask=longer(np.ones(len(one), bool), False),
        copies=True,
    )
    return derivatives(measured, _coordinates)


def _coordinates(orientation: Orientation) -> Float[Array, "row 3"]:
    """All model points, and the projection centres."""
    points = jnp.stack(orientation.model, axis=1)
    centres = jnp.stack([jnp.zeros(3), orientation.pose.base])
    return jnp.concatenate([points, centres])
