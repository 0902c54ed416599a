"""Points that repeat another one of their pair, in pairs of any lengths."""

import numpy as np
from jaxtyping import Int

from ..geometry import copies
from .ragged import Ragged


def first_rows(pairs: Ragged) -> Int[np.ndarray, " row"]:
    """Of every row the one that it repeats (`geometry.copies`), its own where it
    repeats none."""
    rows = np.arange(len(pairs.x_left))
    coordinates = pairs.x_left, pairs.y_left, pairs.x_right, pairs.y_right
    focal = np.minimum(pairs.focal_left, pairs.focal_right)
    key = copies.key_of(coordinates)
    key = np.where(pairs.mask & np.isfinite(key), key, np.inf)
    first = np.array(rows)
    for length in np.unique(pairs.lengths[pairs.lengths > 1]):
        members = np.flatnonzero(pairs.lengths == length)
        own = pairs.begins[members][:, None] + np.arange(length)
        most = copies.distance_of(pairs.sigma[own], focal[members][:, None])
        near = copies.rows_with_near_keys(key[own], most)
        if near.size:
            own, members = own[near], members[near]
            of_rows = [c[own] for c in coordinates]
            accuracy = pairs.sigma[own], pairs.mask[own], focal[members]
            places = copies.find_copies(of_rows, *accuracy)
            first[own] = np.take_along_axis(own, places, axis=-1)
    return first


def without_copies(pairs: Ragged) -> Ragged:
    """The pairs, of points that repeat each other all but the first masked."""
    first = first_rows(pairs)
    return pairs._replace(mask=pairs.mask & (first == np.arange(len(first))))
