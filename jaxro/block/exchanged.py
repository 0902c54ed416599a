"""Two points whose names are exchanged on one photo.

Both are left out there, and a point on two photos is lost. Exchanged back, all rays of
both points meet.
"""

from itertools import combinations

import numpy as np

from ..adjustment import RESULTS
from .adjust import BlockAdjustment
from .columns import Cause
from .wrong_points import reader_of

MOST = 20
"""Places left out on one photo up to which exchanged ones are looked for: with more of
them it is the photo that is wrong."""


def tell_exchanged(adjusted: BlockAdjustment) -> Cause | None:
    """The exchanged points, in a sentence: a hint, as they are left out."""
    found = find_exchanged(adjusted)
    if not found:
        return None
    told = "; ".join(
        f"{one} and {other} on photo {' or '.join(photos)}"
        for (one, other), photos in found.items()
    )
    return Cause(
        "exchanged",
        f"Points are exchanged: {told}. Exchanged back, all of their places fit",
        is_hint=True,
    )


def find_exchanged(adjusted: BlockAdjustment) -> dict[tuple[str, str], list[str]]:
    """Two points each, and the photo on which they are exchanged; several photos where
    nothing tells on which of them."""
    if adjusted.result != RESULTS.successful:
        return {}
    block = adjusted.block
    rays = np.bincount(block.point, minlength=len(block.points))
    left_out = np.flatnonzero(~adjusted.numbered.rays & (rays[block.point] >= 2))
    read = reader_of(adjusted)
    by_point = np.argsort(block.point, kind="stable")
    begins = np.cumsum([0, *rays])

    def fits(ray: int, instead: int) -> bool:
        """Whether the rays of a point meet with another one in place of one of them."""
        number = int(block.point[ray])
        own = by_point[begins[number] : begins[number + 1]]
        point = read(number, np.where(own == ray, instead, own))
        every = np.ones(len(own), bool)
        return point.cost(every) <= point.limit(every)

    found: dict[tuple[str, str], list[str]] = {}
    for photo in np.unique(block.photo[left_out]):
        own = left_out[block.photo[left_out] == photo]
        if len(own) > MOST:
            continue
        for one, other in combinations(own.tolist(), 2):
            if fits(one, other) and fits(other, one):
                names = sorted(block.points[block.point[k]] for k in (one, other))
                found.setdefault((names[0], names[1]), []).append(block.photos[photo])
    return found
