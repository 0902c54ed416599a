"""The datum of a free network: inner constraints on the displacements of the
stations."""

from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ..adjustment.sparse_factor import Anchor, Datum
from ..calibration.camera import Station
from ..calibration.problem_together import inner_constraints


def free_datum(
    begin: Station, *, has_scale: bool = False
) -> Callable[[Mapping[str, Any]], Datum]:
    """The `Datum` of displaced families: stations are neither shifted nor turned nor,
    unless the network `has_scale` by other measurements, scaled as a whole from where
    they `begin`.

    While the system is solved one station is held altogether, and another one, the
    farthest, along the line between them.
    """
    number = 6 if has_scale else 7
    centres = np.asarray(begin.centre)
    by_centre = jax.jacrev(inner_constraints, argnums=1)(begin.centre, begin.centre)
    rows = np.concatenate([np.zeros_like(by_centre), np.asarray(by_centre)], axis=2)
    rows = rows[:number]
    away = np.linalg.norm(centres - np.mean(centres, axis=0), axis=1)
    held = int(np.argmax(away))
    base = centres - centres[held]
    far = int(np.argmax(np.linalg.norm(base, axis=1)))
    along = np.concatenate([np.zeros(3), base[far] / np.linalg.norm(base[far])])
    anchors = (*(Anchor(held, row) for row in np.eye(6)), Anchor(far, along))

    def of(families: Mapping[str, Any]) -> Datum:
        rest = inner_constraints(begin.centre, jnp.asarray(families["photo"].centre))
        return Datum(rows, np.asarray(rest)[:number], anchors[:number])

    return of
