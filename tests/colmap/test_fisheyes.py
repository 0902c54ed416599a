"""`jaxro colmap` with cameras of a field of 150°, against COLMAP's own verification of
the same database."""

import sqlite3
from contextlib import closing

import numpy as np
import pytest

pycolmap = pytest.importorskip(
    "pycolmap", reason="pycolmap makes the databases and judges them"
)

import databases  # noqa: E402

from jaxro.commands.colmap import Options, orient_database  # noqa: E402
from jaxro.rejection.classification import Kind  # noqa: E402

PAIRS, MATCHES, NOISE, WRONG = 12, 320, 0.5, 0.3


@pytest.fixture(scope="module")
def verdicts(tmp_path_factory):
    """By model: (jaxro, COLMAP, summary of jaxro)."""
    pycolmap.set_random_seed(0)
    found = {}
    for seed, model in enumerate(databases.FISHEYES):
        folder = tmp_path_factory.mktemp(model)
        before, after = folder / "before.db", folder / "after.db"
        rng = np.random.default_rng(seed)
        truth = databases.write_fisheye(
            before, model, np.full(PAIRS, MATCHES), rng, NOISE, WRONG
        )
        summary = orient_database(Options(before, sigma=NOISE, out=after))
        ours = databases.judge(after, truth)
        options = pycolmap.TwoViewGeometryOptions(compute_relative_pose=True)
        pycolmap.geometric_verification(str(before), two_view_geometry_options=options)
        found[model] = ours, databases.judge(before, truth), summary
    return found


@pytest.mark.slow
@pytest.mark.parametrize("model", databases.FISHEYES)
def test_matches_of_a_fisheye(verdicts, model):
    ours, _, summary = verdicts[model]
    assert summary.pairs[Kind.oriented] == PAIRS and summary.unseen == 0
    assert ours.kept > 0.995 and ours.false < 0.01
    assert abs(np.median(summary.sigma0) - 1) < 0.1


@pytest.mark.slow
def test_poses_are_right_as_often_as_those_of_colmap(verdicts):
    """Both are nearly the best estimate, so that they differ only in which pairs lie
    just below and just above a tenth of a degree."""
    ours, theirs = (
        np.array([verdict[k] for verdict in verdicts.values()]) for k in (0, 1)
    )
    assert np.sum(theirs[:, 0]) * PAIRS > 24
    assert np.sum(ours[:, 0] - theirs[:, 0]) * PAIRS > -2.5
    assert np.mean(ours[:, 3]) < 1.1 * np.mean(theirs[:, 3])


@pytest.mark.slow
def test_keypoints_beside_the_photo_are_counted_and_left_out(tmp_path):
    """A fisheye that sees 210°, r = f θ: a seventh of the keypoints lies beyond 90°."""
    rng, path = np.random.default_rng(1), tmp_path / "wide.db"
    camera = pycolmap.Camera(
        model="SIMPLE_FISHEYE",
        width=2000,
        height=2000,
        params=[520, 1000, 1000],
        has_prior_focal_length=True,
    )
    polar, azimuth = np.deg2rad([105.0, 360.0])[:, None] * rng.random((2, 300))
    across = np.stack([np.cos(azimuth), np.sin(azimuth)], axis=1)
    directions = np.c_[np.sin(polar)[:, None] * across, np.cos(polar)]
    points = directions * rng.uniform(3, 9, (300, 1))
    moved = points + np.array([0.6, 0.7, 0.2])
    with pycolmap.Database.open(str(path)) as database:
        number = database.write_camera(camera)
        images = []
        for name, seen in (("left", points), ("right", moved)):
            angle = np.arctan2(np.hypot(seen[:, 0], seen[:, 1]), seen[:, 2])
            radius = 520 * angle / np.hypot(seen[:, 0], seen[:, 1])
            pixels = 1000 + radius[:, None] * seen[:, :2]
            image = pycolmap.Image(name=name, camera_id=number)
            images.append(database.write_image(image))
            pixels = pixels + rng.normal(0, 0.5, pixels.shape)
            database.write_keypoints(images[-1], pixels.astype(np.float32))
        every = np.arange(300, dtype=np.uint32)[:, None].repeat(2, axis=1)
        database.write_matches(*images, every)
    summary = orient_database(Options(path, sigma=0.5))
    behind = [seen[:, 2] <= 0 for seen in (points, moved)]
    assert abs(summary.unseen - np.sum(behind)) <= 6  # those close to 90°
    with closing(sqlite3.connect(path)) as connection:
        query = "SELECT data, config FROM two_view_geometries"
        ((data, config),) = connection.execute(query).fetchall()
    kept = np.frombuffer(data, "<u4").reshape(-1, 2)[:, 0]
    assert config == 2 and not np.any(behind[0][kept] | behind[1][kept])
    assert len(kept) >= 0.97 * np.sum(~(behind[0] | behind[1])) - 6
