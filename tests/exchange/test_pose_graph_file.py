"""What `--g2o` writes of a table: names of photos, lengths in one scale, bad tables."""

from dataclasses import replace

import numpy as np
import pytest

from jaxro import block
from jaxro.commands.pose_graph import graph_text, write_graph
from jaxro.geometry.pairs import Camera
from jaxro.tables.cameras import Cameras
from jaxro.tables.fields import TableError
from jaxro.tables.measured import Table


@pytest.fixture(scope="module")
def simulated():
    """A strip of five photos as a table."""
    mock = block.mock_block(2, block.Flight(models=4))
    left, right, pairs, points = block.pairs_of(mock.block, 1)
    table = Table(
        file="strip.csv",
        names=np.array([f"pair {k}" for k in range(len(left))], object),
        begins=pairs.begins,
        points=np.array(points, object),
        numbers={},
        photos=(np.array(left, object), np.array(right, object)),
    )
    camera = Camera(mock.block.focal[0])
    return mock, table, Cameras("--focal", camera, camera), pairs


def test_vertices_are_the_flight(simulated, tmp_path):
    """Up to scale and place the vertices are where the photos were."""
    mock, table, cameras, pairs = simulated
    text, told = graph_text(table, cameras, pairs, sigma_known=True)
    edges = len(pairs.lengths)
    # every pair shares points with others, measured once on each photo
    assert told.startswith(f"5 photos, {edges} edges. {edges} edges share measurements")
    names, places = [], []
    for line in text.splitlines():
        word, *rest = line.split()
        if word == "#":
            names.append(rest[1])
        if word == "VERTEX_SE3:QUAT":
            places.append([float(a) for a in rest[1:4]])
    true = mock.photos.centres[[mock.block.photos.index(n) for n in names]]
    apart = lambda at: np.linalg.norm(at[:, None] - at[None], axis=2)
    own, expected = apart(np.array(places)), apart(true)
    scale = np.sum(own) / np.sum(expected)
    np.testing.assert_allclose(own, scale * expected, atol=5e-3 * np.max(own))
    target = tmp_path / "pairs.g2o"
    line = write_graph(target, text, told)
    assert target.read_text() == text and str(target) in line


def test_bad_tables(simulated):
    """Pairs that share no point are told; a table whose pairs name no photos is
    refused."""
    _, table, cameras, pairs = simulated
    own = np.array([str(k) for k in range(len(table.points))], object)
    _, told = graph_text(replace(table, points=own), cameras, pairs, sigma_known=True)
    assert f"{len(pairs.lengths)} pairs share no point" in told
    with pytest.raises(TableError, match="LEFT-RIGHT"):
        graph_text(replace(table, photos=None), cameras, pairs, sigma_known=True)
