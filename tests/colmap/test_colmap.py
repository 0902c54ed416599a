"""`jaxro colmap` against COLMAP itself: databases made by pycolmap, geometries that it
reads and builds upon."""

import runpy
import shutil
import sqlite3
import sys
from contextlib import closing

import command_line
import jax
import numpy as np
import pytest

import jaxro
from jaxro.geometry import mock_pairs
from jaxro.rejection import OUTCOMES, Recommended
from jaxro.rejection.classification import Kind

pycolmap = pytest.importorskip(
    "pycolmap", reason="pycolmap makes the databases and judges them"
)
from jaxro.colmap import two_view  # noqa: E402
from jaxro.colmap.database import Database, images_of  # noqa: E402
from jaxro.commands import colmap  # noqa: E402

Config = pycolmap.TwoViewGeometryConfiguration
NOISE = 0.5
"""Pixels."""

LONGEST = 200
"""Matches of the longest pair of each database made here. Pairs of a database are padded
to one size, for which a program is compiled, so that all these share theirs."""


def run(*arguments):
    return command_line.run("colmap", *arguments)


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """Six photos of 150 points, a quarter of the matches wrong: the database before,
    the truth, the database after."""
    folder = tmp_path_factory.mktemp("scene")
    before, after = folder / "before.db", folder / "after.db"
    pycolmap.set_random_seed(1)
    with pycolmap.Database.open(str(before)) as database:
        truth = pycolmap.synthesize_dataset(
            pycolmap.SyntheticDatasetOptions(
                num_rigs=1,
                num_frames_per_rig=6,
                num_points3D=150,
                num_points2D_without_point3D=20,
                inlier_match_ratio=0.7,
                camera_has_prior_focal_length=True,
                camera_model_id=pycolmap.CameraModelId.OPENCV,
                camera_params=[1280.0, 1270.0, 512.0, 384.0, -0.1, 0.02, 0.001, -0.001],
            ),
            database,
        )
        pycolmap.synthesize_noise(
            pycolmap.SyntheticNoiseOptions(point2D_stddev=NOISE), truth, database
        )
        database.clear_two_view_geometries()
    result = run(before, "--sigma", NOISE, "--out", after)
    assert result.exit_code == 0, result.output
    assert "15 pairs" in result.stdout and "oriented" in result.stdout
    return before, truth, after


def angle(one, other):
    """Between two vectors, or of the rotation between two rotations, in degrees."""
    if isinstance(one, np.ndarray):
        cosine = one @ other / np.linalg.norm(one) / np.linalg.norm(other)
        return np.degrees(np.arccos(np.clip(cosine, -1, 1)))
    return np.degrees((one * other.inverse()).angle())


def query(path, statement, *values):
    """What a statement returns; its changes stay."""
    with closing(sqlite3.connect(path)) as connection, connection:
        return connection.execute(statement, values).fetchall()


def matched(path):
    """pair_id -> matches."""
    rows = query(path, "SELECT pair_id, data FROM matches")
    return {
        pair_id: np.frombuffer(data or b"", np.uint32).reshape(-1, 2)
        for pair_id, data in rows
    }


def test_truth_is_found_and_wrong_matches_are_out(scene):
    before, truth, after = scene
    turns = []
    with pycolmap.Database.open(str(after)) as database:
        for pair_id, matches in matched(before).items():
            a, b = images_of(pair_id)
            left, right = truth.images[a], truth.images[b]
            right_ones = {
                (i, j)
                for i, j in matches.tolist()
                if left.points2D[i].has_point3D()
                and left.points2D[i].point3D_id == right.points2D[j].point3D_id
            }
            found = database.read_two_view_geometry(a, b)
            kept = set(map(tuple, found.inlier_matches.tolist()))
            assert found.config == Config.CALIBRATED
            assert (
                len(kept & right_ones) >= 0.99 * len(right_ones)
                and len(matches) - len(right_ones) > 40
            )
            assert len(kept - right_ones) <= 4
            pose = right.cam_from_world() * left.cam_from_world().inverse()
            # half a pixel in 1280, 150 points: a tenth of a degree where the base is
            # short
            turns.append(angle(found.cam2_from_cam1.rotation, pose.rotation))
            assert (
                turns[-1] < 0.3
                and angle(found.cam2_from_cam1.translation, pose.translation) < 0.3
            )
            rays = [
                np.c_[
                    image.camera.cam_from_img(
                        np.array([image.points2D[k].xy for k in column])
                    ),
                    np.ones(len(found.inlier_matches)),
                ]
                for image, column in zip(
                    (left, right), found.inlier_matches.T, strict=True
                )
            ]
            coplanar = np.einsum("ni,ij,nj->n", rays[1], found.E, rays[0])
            assert np.sqrt(np.mean(coplanar**2)) < 2 * NOISE / 1280
            k = left.camera.calibration_matrix()
            np.testing.assert_allclose(k.T @ found.F @ k, found.E, atol=1e-12)
    assert np.median(turns) < 0.12 and np.sqrt(np.mean(np.square(turns))) < 0.2


def test_mapper_builds_on_the_geometries(scene, tmp_path):
    _, truth, after = scene
    options = pycolmap.IncrementalPipelineOptions(
        ba_refine_focal_length=False,
        ba_refine_extra_params=False,
        extract_colors=False,
        min_model_size=3,
        random_seed=0,
    )
    (model,) = pycolmap.incremental_mapping(
        str(after), str(tmp_path), str(tmp_path), options
    ).values()
    assert model.num_reg_images() == 6 and model.num_points3D() >= 150
    similarity = pycolmap.align_reconstructions_via_proj_centers(model, truth, 1.0)
    model.transform(similarity)
    size = np.ptp(
        [image.projection_center() for image in truth.images.values()], axis=0
    ).max()
    for number, image in truth.images.items():
        found = model.images[number]
        assert (
            angle(found.cam_from_world().rotation, image.cam_from_world().rotation)
            < 0.1
        )
        assert (
            np.linalg.norm(found.projection_center() - image.projection_center())
            < 2e-3 * size
        )


def tables(path):
    """All statements that make the database, without two_view_geometries."""
    return [line for line in dump(path) if "two_view_geometries" not in line]


def dump(path):
    with closing(sqlite3.connect(path)) as connection:
        return list(connection.iterdump())


def test_other_tables_stay_and_geometries_are_not_overwritten(scene, tmp_path):
    before, _, after = scene
    assert tables(before) == tables(after)
    assert len(list(after.parent.glob("*after*"))) == 1  # nothing is left of the draft
    own = tmp_path / "own.db"
    shutil.copy(before, own)
    assert run(own, "--sigma", NOISE).exit_code == 0
    assert dump(own) == dump(after)
    for arguments, found in (
        ([own], "15 two-view geometries"),
        ([before, "--out", own], "a file that exists"),
    ):
        result = run(*arguments)
        assert (
            result.exit_code == 2
            and found in result.stderr
            and "--force" in result.stderr
        )
    assert run(own, "--sigma", NOISE, "--force").exit_code == 0 and dump(own) == dump(
        after
    )


@pytest.mark.slow
@pytest.mark.parametrize("copied", [False, True])
def test_all_or_none(copied, scene, tmp_path, monkeypatch):
    own = tmp_path / "own.db"
    shutil.copy(scene[0], own)
    content = own.read_bytes()
    write = Database.write

    def half(self, geometries):
        write(self, geometries[:7])
        raise sqlite3.OperationalError("database or disk is full")

    monkeypatch.setattr(Database, "write", half)
    result = run(own, *(["--out", tmp_path / "new.db"] if copied else []))
    assert result.exit_code == 2 and "disk is full" in result.stderr
    assert own.read_bytes() == content and [
        path.name for path in tmp_path.iterdir()
    ] == ["own.db"]


def test_older_schema(scene, tmp_path):
    """COLMAP 3.5: no pose, no rigs."""
    own = tmp_path / "own.db"
    shutil.copy(scene[0], own)
    for column in ("qvec", "tvec", "camera1", "camera2"):
        query(own, f"ALTER TABLE two_view_geometries DROP COLUMN {column}")
    for table in ("rig_sensors", "frame_data", "frames", "rigs", "pose_priors"):
        query(own, f"DROP TABLE {table}")
    assert run(own, "--sigma", NOISE).exit_code == 0
    kept = "SELECT rows, data, config, F, E FROM two_view_geometries ORDER BY pair_id"
    assert query(own, kept) == query(scene[2], kept)


def add_pair(
    database, cameras, rng, points, rotation, base, wrong=0.0, moving=(0, None, None)
):
    """Two photos of points given in the frame of the first one; x2 = R x1 + t. The first
    points have an R and t of their own, if so many are `moving`."""
    numbers = []
    moved = points @ rotation.T + base
    count, own_rotation, own_base = moving
    if count:
        moved[:count] = points[:count] @ own_rotation.T + own_base
    for number, at in zip(cameras, (points, moved), strict=True):
        camera = database.read_camera(number)
        pixels = camera.img_from_cam(at) + rng.normal(0, NOISE, (len(at), 2))
        image = pycolmap.Image(
            name=f"{database.num_images():03d}.png", camera_id=number
        )
        numbers.append(database.write_image(image))
        database.write_keypoints(numbers[-1], pixels.astype(np.float32))
    partner = np.arange(len(points))
    out = rng.permutation(len(points))[: round(wrong * len(points))]
    partner[out] = np.roll(out, 1)
    matches = np.stack([np.arange(len(points)), partner], axis=-1).astype(np.uint32)
    database.write_matches(*numbers, matches)
    return tuple(numbers)


def test_every_pair_gets_what_it_is_worth(tmp_path):
    """Two cameras of different focal length, photos turned by a right angle, a plane,
    no base, chance, few matches."""
    rng, path = np.random.default_rng(0), tmp_path / "kinds.db"
    turn = pycolmap.Rotation3d(
        np.array([0.1, -0.15, 0.7, 0.7]) / np.linalg.norm([0.1, -0.15, 0.7, 0.7])
    ).matrix()
    small = pycolmap.Rotation3d(
        np.array([0.05, -0.1, 0.02, 1.0]) / np.linalg.norm([0.05, -0.1, 0.02, 1.0])
    ).matrix()
    base = np.array([0.8, 0.3, 0.1])
    cloud = rng.uniform([-2, -2, 4], [2, 2, 9], (160, 3))
    plane = np.c_[cloud[:, :2], 6 + 0.3 * cloud[:, 0] - 0.2 * cloud[:, 1]]
    with pycolmap.Database.open(str(path)) as database:
        cameras = tuple(
            database.write_camera(
                pycolmap.Camera(
                    model=model,
                    width=2000,
                    height=1600,
                    params=p,
                    has_prior_focal_length=True,
                )
            )
            for model, p in (
                ("SIMPLE_RADIAL", [1000, 1000, 800, 0.05]),
                ("PINHOLE", [1500, 1520, 990, 810]),
            )
        )
        add = lambda *pair, **options: add_pair(
            database, cameras, rng, *pair, **options
        )
        pairs = {
            "oriented": add(cloud, turn, base, wrong=0.4),
            "plane": add(plane, turn, base, wrong=0.2),
            "rotation": add(cloud, turn, 0 * base),
            "chance": add(cloud[:60], turn, base, wrong=1.0),
            "few": add(cloud[:5], turn, base),
            "none": add(cloud[:0], turn, base),
            "ten": add(cloud[:12], small, base),
        }
        turned = [add(cloud, small, 0 * base, wrong=0.2) for _ in range(8)]
        walls = [add(plane, small, base) for _ in range(4)]
        more = rng.uniform([-2, -2, 4], [2, 2, 9], (LONGEST, 3))
        pairs["longest"] = add(more, turn, base)
        pairs["several"] = add(cloud, turn, base, moving=(70, small, base))
    result = run(path, "--sigma", NOISE)
    assert (
        result.exit_code == 1
        and "21 pairs" in result.stdout
        and "DEGENERATE" in result.stdout
    )
    with pycolmap.Database.open(str(path)) as database:
        found = {
            name: database.read_two_view_geometry(*pair) for name, pair in pairs.items()
        }
        # wrong matches agree with some base, where there is none, and nothing but the
        # plane determines a plane
        config = lambda pair: database.read_two_view_geometry(*pair).config
        kinds = [config(pair) for pair in turned]
        assert kinds.count(Config.PANORAMIC) >= 6 and set(kinds) <= {
            Config.PANORAMIC,
            Config.PLANAR,
        }, kinds
        assert [config(pair) for pair in walls] == [Config.PLANAR] * 4
    assert {name: g.config for name, g in found.items()} == {
        "oriented": Config.CALIBRATED,
        "plane": Config.PLANAR,
        "rotation": Config.PANORAMIC,
        "chance": Config.DEGENERATE,
        "few": Config.DEGENERATE,
        "none": Config.DEGENERATE,
        "ten": Config.CALIBRATED,
        "longest": Config.CALIBRATED,
        "several": Config.MULTIPLE,
    }
    sizes = {name: len(g.inlier_matches) for name, g in found.items()}
    assert sizes["chance"] == sizes["few"] == sizes["none"] == 0 and sizes["ten"] == 12
    # wrong matches agree by accident where they lie near their epipolar lines; next to
    # no right one is lost
    assert (
        94 <= sizes["oriented"] <= 99
        and 125 <= sizes["plane"] <= 131
        and sizes["rotation"] >= 156
    )
    assert sizes["several"] >= 150 and found["several"].cam2_from_cam1 is None
    for name in ("oriented", "ten"):
        pose = found[name].cam2_from_cam1
        assert angle(pose.translation, base) < (0.5 if name == "oriented" else 5)
    assert (
        angle(found["oriented"].cam2_from_cam1.rotation, pycolmap.Rotation3d(turn))
        < 0.2
    )
    # H takes the points without distortion from one image to the other
    second = np.array([[1500, 0, 990], [0, 1520, 810], [0, 0, 1]])
    first = np.array([[1000, 0, 1000], [0, 1000, 800], [0, 0, 1]])
    for name, points, t in (("plane", plane, base), ("rotation", cloud, 0 * base)):
        seen, wanted = (
            points @ first.T @ found[name].H.T,
            (points @ turn.T + t) @ second.T,
        )
        off = seen[:, :2] / seen[:, 2:] - wanted[:, :2] / wanted[:, 2:]
        assert np.sqrt(np.mean(off**2)) < 2 * NOISE, name


@pytest.mark.slow
def test_poses_and_matches_are_those_of_recommended(tmp_path):
    """Photos in any position, a fifth to three fifths of 60 to 200 matches wrong;
    matches of photos that have nothing in common have no consensus in both."""
    rng, path, points, focal, centre = (
        np.random.default_rng(7),
        tmp_path / "pairs.db",
        224,
        1200.0,
        1500.0,
    )
    exact, _ = mock_pairs.random_pairs(jax.random.key(7), 12, points, focal=focal)
    photos = np.stack(exact.coordinates) + rng.normal(0, NOISE, (4, 12, points))
    photos[:, 9:] = rng.uniform(-1000, 1000, (4, 3, points))
    numbers, pairs = [], []
    with pycolmap.Database.open(str(path)) as database:
        camera = database.write_camera(
            pycolmap.Camera(
                model="SIMPLE_PINHOLE",
                width=3000,
                height=3000,
                params=[focal, centre, centre],
                has_prior_focal_length=True,
            )
        )
        for k, count in enumerate([LONGEST, 60, *rng.integers(60, 201, 10).tolist()]):
            sides = []
            for x, y in (photos[:2, k, :count], photos[2:, k, :count]):
                image = pycolmap.Image(name=f"{k}_{len(sides)}.png", camera_id=camera)
                pixels = np.stack([centre + x, centre - y], axis=-1).astype(np.float32)
                sides.append((database.write_image(image), pixels))
                database.write_keypoints(*sides[-1])
            partner, out = (
                np.arange(count),
                rng.permutation(count)[: round(rng.uniform(0.2, 0.6) * count)],
            )
            partner[out] = np.roll(out, 1)
            matches = np.stack([np.arange(count), partner], axis=-1).astype(np.uint32)
            database.write_matches(sides[0][0], sides[1][0], matches)
            numbers.append((sides[0][0], sides[1][0], matches))
            left, right = (
                pixels[m].astype(float)
                for (_, pixels), m in zip(sides, matches.T, strict=True)
            )
            coordinates = (
                left[:, 0] - centre,
                centre - left[:, 1],
                right[:, 0] - centre,
                centre - right[:, 1],
            )
            pairs.append(jaxro.pair(*coordinates, focal=focal, sigma=NOISE))
    assert run(path, "--sigma", NOISE).exit_code == 1
    lost, mask, pose = jaxro.clean_batch(
        jaxro.stack(pairs, points),
        Recommended(),
        select=lambda r: (
            r.outcome == OUTCOMES.no_consensus,
            r.mask,
            r.orientation.pose,
        ),
    )
    assert np.all(lost[9:]) and np.sum(lost) <= 4
    rotation, base = (
        np.array(part) for part in jax.vmap(lambda pose: pose.relative())(pose)
    )
    half_turn = np.diag([1.0, -1.0, -1.0])
    with pycolmap.Database.open(str(path)) as database:
        for k, (a, b, matches) in enumerate(numbers):
            found = database.read_two_view_geometry(a, b)
            if lost[k]:
                assert (
                    found.config == Config.DEGENERATE and len(found.inlier_matches) == 0
                )
                continue
            np.testing.assert_array_equal(
                found.inlier_matches, matches[mask[k, : len(matches)]]
            )
            turn = half_turn @ rotation[:, :, k].T @ half_turn
            assert found.config == Config.CALIBRATED
            np.testing.assert_allclose(
                found.cam2_from_cam1.rotation.matrix(), turn, atol=1e-9
            )
            np.testing.assert_allclose(
                found.cam2_from_cam1.translation,
                -turn @ half_turn @ base[:, k],
                atol=1e-9,
            )


def test_matches_that_repeat_others_are_no_evidence(tmp_path):
    """Five matches prove nothing however often they stand there; of a sound pair
    repeats are kept with what they repeat. A geometry of a pair without matches is
    left, and told; images without keypoints harm nobody."""
    rng, path = np.random.default_rng(4), tmp_path / "repeats.db"
    cloud = rng.uniform([-2, -2, 4], [2, 2, 9], (150, 3))
    with pycolmap.Database.open(str(path)) as database:
        camera = pycolmap.Camera(
            model="SIMPLE_PINHOLE",
            width=2000,
            height=1600,
            params=[1000, 1000, 800],
            has_prior_focal_length=True,
        )
        cameras = (database.write_camera(camera),) * 2
        add = lambda points: add_pair(
            database, cameras, rng, points, np.eye(3), np.array([0.8, 0.3, 0.1])
        )
        five, sound, _ = add(np.tile(cloud[:5], (12, 1))), add(cloud), add(cloud[:0])
        rows = (
            np.concatenate([np.arange(150), np.arange(LONGEST - 150)])[:, None]
            .repeat(2, axis=1)
            .astype(np.uint32)
        )
        for pair, matches in ((five, np.tile(rows[:5], (12, 1))), (sound, rows)):
            database.delete_matches(*pair)
            database.write_matches(*pair, matches)
        database.write_two_view_geometry(five[0], sound[1], pycolmap.TwoViewGeometry())
    result = run(path, "--sigma", NOISE, "--force")
    assert "1 geometries of pairs without a row in matches" in result.stdout
    with pycolmap.Database.open(str(path)) as database:
        assert len(database.read_two_view_geometry(*five).inlier_matches) == 0
        assert len(database.read_two_view_geometry(*sound).inlier_matches) == LONGEST


def change(statement, *values):
    return lambda path: query(path, statement, *values)


PAIR = 2147483647 + 2
WRONG = {
    "text": (
        lambda path: path.write_text("point,x_left\n" * 100),
        ["not a database", "SQLite"],
    ),
    "no table": (change("DROP TABLE matches"), ["table matches", "no such table"]),
    "no column": (
        change("ALTER TABLE keypoints RENAME COLUMN cols TO columns"),
        ["table keypoints", "column cols", "no such column"],
    ),
    "short keypoints": (
        change("UPDATE keypoints SET data = ? WHERE image_id = 3", b"12345678"),
        ["table keypoints, image_id 3", "column data", "8 bytes"],
    ),
    "short matches": (
        change("UPDATE matches SET rows = 900 WHERE pair_id = ?", PAIR),
        [f"table matches, pair_id {PAIR}", "7200 bytes"],
    ),
    "no such keypoint": (
        change(
            "UPDATE matches SET rows = 1, data = ? WHERE pair_id = ?",
            np.array([4, 999], "<u4").tobytes(),
            PAIR,
        ),
        [f"pair_id {PAIR}", "keypoint 999", "image 2", "places below 170"],
    ),
    "no such image": (
        change("DELETE FROM images WHERE image_id = 2"),
        ["table matches", f"{PAIR}", "image 2"],
    ),
    "no keypoints": (
        change("DELETE FROM keypoints WHERE image_id = 2"),
        ["table keypoints, image_id 2", "frame"],
    ),
    "no camera": (
        change("UPDATE images SET camera_id = 9 WHERE image_id = 2"),
        ["image_id 2", "camera_id", "9"],
    ),
    "unknown model": (
        change("UPDATE cameras SET model = 77"),
        [
            "table cameras, camera_id 1",
            "column model",
            "found 77",
            "5 OPENCV_FISHEYE",
            "2 SIMPLE_RADIAL",
            "undistort",
        ],
    ),
    "other parameters": (
        change("UPDATE cameras SET model = 1"),
        ["camera_id 1", "64 bytes", "PINHOLE has 4"],
    ),
    "no focal length": (
        change(
            "UPDATE cameras SET params = ?",
            np.array([0, 1, 2, 3, 0, 0, 0, 0], "<f8").tobytes(),
        ),
        ["camera_id 1", "params", "positive"],
    ),
    "guessed focal length": (
        change("UPDATE cameras SET prior_focal_length = 0"),
        ["camera_id 1", "prior_focal_length", "--assume-calibrated"],
    ),
}


@pytest.mark.parametrize("case", WRONG)
def test_errors_say_where_and_what_and_change_nothing(case, scene, tmp_path):
    spoil, told = WRONG[case]
    own = tmp_path / "own.db"
    shutil.copy(scene[0], own)
    spoil(own)
    content = own.read_bytes()
    result = run(own)
    assert result.exit_code == 2 and not result.stdout
    assert all(text in result.stderr for text in [str(own), *told]), result.stderr
    assert own.read_bytes() == content


def test_bad_options(tmp_path):
    for arguments, told in (
        ([tmp_path / "absent.db"], "no such file"),
        ([tmp_path / "absent.db", "--sigma", "0"], "--sigma"),
    ):
        result = run(*arguments)
        assert (
            result.exit_code == 2
            and told in result.stderr
            and not list(tmp_path.iterdir())
        )


def test_a_locked_database_is_told(scene, tmp_path):
    own = tmp_path / "own.db"
    shutil.copy(scene[0], own)
    other = sqlite3.connect(own, isolation_level=None)
    other.execute("PRAGMA busy_timeout = 0")
    other.execute("PRAGMA journal_mode = DELETE")  # in which a reader waits as well
    other.execute("BEGIN EXCLUSIVE")
    for more in ([], ["--out", tmp_path / "copy.db"]):
        result = run(own, *more)
        assert (
            result.exit_code == 2
            and "locked" in result.stderr
            and "nothing else writes" in result.stderr
        )
        assert not list(tmp_path.glob("*copy*"))
    other.close()


def test_a_missing_pycolmap_is_told(monkeypatch):
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    with pytest.raises(SystemExit, match=r"pip install 'jaxro\[cli,colmap\]'"):
        runpy.run_path(sys.modules["jaxro.colmap"].__file__)


def test_every_kind_is_explained():
    assert set(colmap.MEANING) == set(two_view.CONFIG) == set(Kind)
    assert set(two_view.CONTENT) == set(Kind)
    names = {2: "CALIBRATED", 4: "PLANAR", 5: "PANORAMIC", 1: "DEGENERATE"}
    names |= {8: "MULTIPLE"}
    for kind, config in two_view.CONFIG.items():
        assert colmap.MEANING[kind][1].startswith(names[config])
        assert int(getattr(Config, names[config])) == config
