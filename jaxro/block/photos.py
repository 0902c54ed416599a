"""Photos that are not what they seem: one that came in twice, and one that a single
point holds."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool

from .measured_block import MeasuredBlock

SAME = 1e-7
"""Part of the focal length up to which two places are one."""

COPIED = 0.9
"""Part of the common points of two photos at one and the same place, from which on they
are one photo."""

LEAST_COPIED = 3
"""Common points that tell it."""


class Held(NamedTuple):
    """A photo whose scale one point alone carries."""

    photo: str
    point: str


def find_copies(block: MeasuredBlock) -> list[tuple[str, str]]:
    """Photos that show their common points at the same places: one photo under two
    names. Its places are no second measurements."""
    unit = SAME * block.focal[block.photo]
    keys = np.stack([block.point, np.round(block.x / unit), np.round(block.y / unit)])
    _, key = np.unique(keys, axis=1, return_inverse=True)
    same = _in_common(block.photo, key.reshape(-1))
    common = _in_common(block.photo, block.point)
    return [
        (block.photos[one], block.photos[other])
        for (one, other), number in sorted(same.items())
        if number >= max(LEAST_COPIED, COPIED * common[one, other])
    ]


def _in_common(photo: np.ndarray, key: np.ndarray) -> dict[tuple[int, int], int]:
    """How many keys every two photos have in common, of those that have any."""
    seen = np.unique(np.stack([key, photo]), axis=1)
    begins = np.flatnonzero(np.diff(seen[0], prepend=-1))
    found: dict[tuple[int, int], int] = {}
    for photos in np.split(seen[1], begins[1:]):
        for k, one in enumerate(photos.tolist()):
            for other in photos[k + 1 :].tolist():
                found[one, other] = found.get((one, other), 0) + 1
    return found


def find_held(
    block: MeasuredBlock,
    used: Bool[np.ndarray, " ray"],
    known: Bool[np.ndarray, " point"],
    placed: Bool[np.ndarray, " photo"],
) -> list[Held]:
    """Photos of whose points in use only one is on three photos or known on the ground:
    it alone carries scale, and nothing checks it. `placed`: photos whose stations are
    known."""
    seen = np.unique(np.stack([block.point[used], block.photo[used]]), axis=1)
    photos = np.bincount(seen[0], minlength=len(block.points))
    carries = ((photos >= 3) | known)[seen[0]]
    number = np.bincount(seen[1][carries], minlength=len(block.photos))
    held = np.flatnonzero((number == 1) & ~placed)
    return [
        Held(block.photos[k], block.points[seen[0][carries & (seen[1] == k)][0]])
        for k in held
    ]
