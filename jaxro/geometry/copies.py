"""Measurements that repeat another one: the same place of both photos, entered twice,
or found twice by a detector; and the same place of one photo, which several pairs and
tables have.

A copy is no measurement of its own. It has the error of the first one, so that two
copies of a wrong point agree with each other and are no evidence. What enters as a
`Pair` therefore has all copies but the first masked.
"""

from collections.abc import Sequence
from types import ModuleType
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

PART = 0.1
"""Two points are copies if none of their four coordinates differs by more than this
part of its standard deviation. Of independent measurements of one place it happens once
in 100,000 times."""

LARGEST, SMALLEST = 1 / 3_000, 1 / 100_000
"""No standard deviation is taken as larger than the first part of the focal length; and
as larger than the second one where it is 1, which may mean that it is not known."""

AHEAD = 4
"""Points in the order of a key in which copies are looked for."""

KEY = (1.0, 0.7548776662466927, 0.5698402909980532, 0.4301597090019468)
"""A sum of the coordinates with these factors tells points apart."""

JUMPS = 6
"""Up to 2 ** JUMPS copies of a point lead to the first one."""


def find_copies(
    coordinates: Sequence[Float[Any, "*pairs point"]],
    sigma: Float[Any, "*pairs point"],
    mask: Bool[Any, "*pairs point"],
    focal: Float[Any, "*pairs"],
    xp: ModuleType = np,
) -> Int[Any, "*pairs point"]:
    """Of every point the place of the one that it repeats, its own where it repeats
    none; masked points repeat nothing. `focal`: the smaller one; `xp`: NumPy, or JAX's."""
    most = distance_of(sigma, focal[..., None], xp)
    key = key_of(coordinates)
    key = xp.where(mask & xp.isfinite(key), key, np.inf)
    places = xp.broadcast_to(xp.arange(mask.shape[-1]), mask.shape)
    if xp is np:
        near = rows_with_near_keys(key, most)
        if near.size == 0:
            return places
        if mask.ndim > 1 and len(near) < len(mask):
            found = np.array(places)
            some = [c[near] for c in coordinates]
            found[near] = find_copies(some, sigma[near], mask[near], focal[near])
            return found
    order = xp.argsort(key, axis=-1, stable=True)
    in_order = lambda a: xp.take_along_axis(a, order, axis=-1)
    sorted_most, there = in_order(most), in_order(key) < np.inf
    sorted_coordinates = [in_order(c) for c in coordinates]
    earlier = places
    for ahead in range(1, min(AHEAD, mask.shape[-1] - 1) + 1):
        equal = there[..., ahead:]
        for c in sorted_coordinates:
            with np.errstate(invalid="ignore", over="ignore"):
                distance = abs(c[..., ahead:] - c[..., :-ahead])
            equal = equal & (distance <= sorted_most[..., ahead:])
        nobody = xp.zeros((*mask.shape[:-1], ahead), bool)
        equal = xp.concatenate([nobody, equal], axis=-1)
        earlier = xp.where(equal, places - ahead, earlier)
    for _ in range(JUMPS):
        earlier = xp.take_along_axis(earlier, earlier, axis=-1)
    back = xp.argsort(order, axis=-1)
    first = xp.take_along_axis(order, earlier, axis=-1)
    return xp.take_along_axis(first, back, axis=-1)


def key_of(coordinates: Sequence[Float[Any, "*points"]]) -> Float[Any, "*points"]:
    """A number of every point by which copies are looked for; none that is finite where
    a coordinate is not."""
    with np.errstate(invalid="ignore", over="ignore"):
        return sum(c * factor for c, factor in zip(coordinates, KEY, strict=True))


def distance_of(sigma: Any, focal: Any, xp: ModuleType = np) -> Any:
    """The largest difference of a coordinate of two copies."""
    most = focal * xp.where(sigma == 1, SMALLEST, LARGEST)
    return PART * xp.minimum(sigma, most)


def rows_with_near_keys(
    key: Float[np.ndarray, "*pairs point"], most: Float[np.ndarray, "*pairs point"]
) -> Int[np.ndarray, " some"]:
    """The pairs in which two keys are as near to each other as those of copies are: few
    of a table, so that the others need no more than this look."""
    in_order = np.sort(np.atleast_2d(key), axis=-1)
    with np.errstate(invalid="ignore"):
        distance = np.diff(in_order, axis=-1)
    widest = sum(KEY) * np.max(np.atleast_2d(most), axis=-1, initial=0.0)
    return np.flatnonzero(np.any(distance <= widest[..., None], axis=-1))


def repeated(places: Int[Any, "*pairs point"]) -> Bool[Any, "*pairs point"]:
    """The points that repeat another one, from what `find_copies` tells."""
    return places != np.broadcast_to(np.arange(places.shape[-1]), places.shape)


def repeat_places(
    photo: Int[np.ndarray, " ray"],
    point: Int[np.ndarray, " ray"],
    x: Float[np.ndarray, " ray"],
    y: Float[np.ndarray, " ray"],
    most: Float[np.ndarray, " ray"],
) -> Bool[np.ndarray, " ray"]:
    """Places of points on photos that repeat an earlier one of the same point and photo:
    neither coordinate differs by more than `most` (`distance_of`) of the earlier
    one."""
    repeats = np.ones(len(photo), bool)
    left = np.lexsort((point, photo))  # in each group earlier ones first
    while len(left):
        of_photo, of_point = photo[left], point[left]
        begins = np.ones(len(left), bool)
        begins[1:] = (np.diff(of_photo) != 0) | (np.diff(of_point) != 0)
        repeats[left[begins]] = False
        first = left[begins][np.cumsum(begins) - 1]
        apart = np.maximum(abs(x[left] - x[first]), abs(y[left] - y[first]))
        left = left[~(begins | (apart <= most[first]))]
    return repeats
