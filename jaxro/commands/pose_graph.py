"""`--g2o FILE` of `jaxro orient`: the pairs of a table as a pose graph."""

from pathlib import Path
from typing import Any

import numpy as np

from ..batches import table_neighbours
from ..batches.ragged import Ragged, orient_ragged
from ..exchange.pose_graph import UNKNOWN, g2o_text, pose_graph
from ..exchange.scales import base_lengths
from ..geometry import coplanarity
from ..geometry.elements import RelativePose
from ..tables import whole
from ..tables.cameras import Cameras
from ..tables.fields import TableError
from ..tables.measured import Table, to_list

UNJOINED = (
    "pairs share no point with another one on a common photo: nothing tells the "
    "lengths of their bases, and their edges hold rotation and direction alone"
)

SHARED = (
    "edges share measurements with others: their deviations are up to {most} times those "
    "of the pair alone, as a file of g2o takes edges for independent"
)


def graph_text(
    table: Table, cameras: Cameras, pairs: Ragged, sigma_known: bool, **options: Any
) -> tuple[str, str]:
    """The text of the g2o file of a table, and a sentence about it.

    The lengths of the bases are those that the points tell which pairs share, their mean
    (geometric) being 1. `pairs`: the table in photo coordinates; `sigma_known`: whether
    their sigmas are standard deviations; `options` of `jaxro.orient_ragged`. Raises
    TableError where the table does not name photos, or no pair is usable.
    """
    left, right = cameras.photos_of(
        table.names, table.file, given=table.photos, place=table.first_line
    )
    points = list(map(str, to_list(table.points)))
    sigma0 = 1.0 if sigma_known else None
    oriented = orient_ragged(pairs, elements=RelativePose, **options)
    if options.get("residual", coplanarity.rigorous) is coplanarity.rigorous:
        oriented, _ = table_neighbours.allow(pairs, oriented)
    known = base_lengths(left, right, pairs, points, oriented, sigma0=sigma0)
    joined = np.isfinite(known.deviation)
    # every reader takes a matrix that is positive definite
    deviations = np.where(joined, known.deviation, UNKNOWN * known.length)
    try:
        graph = pose_graph(
            left,
            right,
            oriented,
            known.length,
            deviations,
            pairs=pairs,
            sigma0=sigma0,
        )
    except ValueError as error:
        raise TableError(
            table.file,
            found=str(error).removeprefix("pose_graph: "),
            expected="one pair of two photos at least, with more than five points",
        ) from None
    edges, vertices = len(graph.left), len(graph.photos)
    told = f"{vertices} photos, {edges} edges"
    if sharing := int(np.sum(graph.factor > 1)):
        most = f"{np.sqrt(np.max(graph.factor)):.3g}"
        told += f". {sharing} {SHARED.format(most=most)}"
    usable = np.asarray(oriented.usable)
    if open_ := int(np.sum(~joined & usable)):
        told += f". {open_} {UNJOINED}"
    return g2o_text(graph), told


def write_graph(path: Path, text: str, told: str) -> str:
    """Write the file; where it is, as a line. Raises TableError where the disk
    refuses."""
    whole.write_file(path, text.encode())
    return f"Pose graph written to {path}: {told}\n"
