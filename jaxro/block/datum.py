"""The datum of a free network: seven inner constraints on displacements of the stations
(Meissl 1962)."""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from ..adjustment.sparse_factor import Anchor, Datum
from ..calibration.camera import Station


def inner_constraints(begin: Station) -> Callable[[Mapping[str, Any]], Datum]:
    """Displacements dS of the stations neither shift nor turn nor scale them as a
    whole: Σ dS = 0, Σ S × dS = 0, Σ S · dS = 0, with S from their centroid.

    While the system is solved one station is held altogether, and another one, the
    farthest, along the line between them.
    """
    centres = np.asarray(begin.centre)
    about = centres - np.mean(centres, axis=0)
    rows = np.zeros((7, len(centres), 6))
    for axis in range(3):
        rows[axis, :, 3 + axis] = 1.0
        turn = np.cross(np.eye(3)[axis], about)
        rows[3 + axis, :, 3:] = turn
    rows[6, :, 3:] = about
    held = int(np.argmax(np.linalg.norm(about, axis=1)))
    base = centres - centres[held]
    far = int(np.argmax(np.linalg.norm(base, axis=1)))
    along = np.concatenate([np.zeros(3), base[far] / np.linalg.norm(base[far])])
    anchors = (*(Anchor(held, row) for row in np.eye(6)), Anchor(far, along))

    def of(families: Mapping[str, Any]) -> Datum:
        moved = (np.asarray(families["photo"].centre) - centres)[None]
        rest = np.sum(rows[:, :, 3:] * moved, axis=(1, 2))
        return Datum(rows, rest, anchors)

    return of
