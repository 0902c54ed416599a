"""How the triplets of photos of a table close, where its pairs name photos."""

from typing import Any

import numpy as np

from ..batches.closures import Closures, close
from ..batches.ragged import Ragged
from ..geometry.elements import AbstractElements
from ..reports.columns import is_usable
from ..tables.cameras import Cameras
from ..tables.fields import TableError
from ..tables.measured import Table
from .neighbours import elements_of_poses


def find(
    table: Table,
    cameras: Cameras,
    pairs: Ragged,
    of_pairs: dict[str, Any],
    system: type[AbstractElements],
    sigma_known: bool,
) -> Closures | None:
    """The closures of the triplets of a table; None where its pairs name no photos, or
    no three of them are joined by pairs."""
    try:
        left, right = cameras.photos_of(table.names, table.file, given=table.photos)
    except TableError:
        return None
    usable = is_usable(of_pairs["result"])
    return close(
        left,
        right,
        pairs,
        elements_of_poses(of_pairs, system),
        np.asarray(of_pairs["cofactor"]),
        of_pairs["sigma0"],
        of_pairs["degrees_of_freedom"],
        usable,
        sigma_known=sigma_known,
    )
