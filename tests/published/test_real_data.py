"""Measured pairs of other projects, oriented with no start, against their check values,
PoseLib and OpenCV.

Strasbourg: aerial photos, 123.939 mm, bases along -x, cross-strip pairs with kappa near
175 degrees. Balbianello: a building photographed by hand, coordinates reduced to a
focal length of 500. Olympus: a flat field of targets.
"""

import json

import numpy as np
import oracles
import problems
import pytest
from bad_tables import write
from command_line import rows, run

from jaxro import RESULTS, pad

STRASBOURG = (
    "8811_8936",
    "8811_8937",
    "8936_8937",
    "8936_8938",
    "8937_8938",
    "8937_9111",
)
BALBIANELLO = ("cam0_cam1", "cam0_cam2", "cam0_cam3", "cam1_cam2")
OLYMPUS = ("img01_img02", "img01_img04", "img03_img07", "img05_img09")
MEASURED = [("strasbourg_block", name) for name in STRASBOURG] + [
    ("balbianello", name) for name in BALBIANELLO
]

PLACES = 288
"""All pairs padded to one length, so that one compilation serves them all."""

TO_VISION = np.diag([1.0, -1.0, -1.0])
"""From photo axes (y up, z back) to those of computer vision (y down, z forward)."""


def load(data, folder, name):
    """(pair, rotation and base of the check file)"""
    suffix, focal, key = {
        "strasbourg_block": ("", 123.939, "our_RO_two_view"),
        "balbianello": ("_norm_f500", 500.0, "our_RO"),
        "olympus_camcal": ("_corrected_mm", 7.45700, "our_RO_two_view"),
    }[folder]
    check = json.loads((data / folder / f"check_{name}.json").read_text())[key]
    rotation = oracles.wolf(*np.deg2rad(check["omega_phi_kappa_deg"])).T
    pair = pad(
        problems.read(data / folder / "pairs" / f"{name}{suffix}.csv", focal), PLACES
    )
    return pair, rotation, np.array(check["base_unit"])


@pytest.mark.parametrize(("folder", "name"), MEASURED)
def test_orients_with_no_start(data, folder, name):
    pair, rotation, base = load(data, folder, name)
    found = problems.orient(pair)
    found.check()
    turn, shift = np.rad2deg(problems.difference(found.pose, rotation, base))
    assert turn < 0.02 and shift < 0.02
    assert int(np.sum(found.in_front)) == int(pair.count)


@pytest.mark.parametrize(("folder", "name"), MEASURED)
def test_agrees_with_the_rigorous_oracle(data, folder, name):
    """Same optimum from the true constrained adjustment started at the check value,
    base along its own axis."""
    pair, rotation, base = load(data, folder, name)
    found = problems.orient(pair)
    r, b = problems.rotation_base(found.pose)
    side = np.linalg.svd(base[None])[2][1:]

    def placed(e):
        return (
            np.eye(3),
            rotation @ oracles.wolf(*e[:3]),
            base + e[3] * side[0] + e[4] * side[1],
        )

    focal = float(pair.focal_left)
    judge = oracles.gauss_helmert(problems.arrays(pair), focal, placed, np.zeros(5))
    _, right, direction = placed(judge.elements)
    assert (
        np.rad2deg(oracles.angle(r.T @ right)) < 1e-3
        and np.rad2deg(oracles.angle_between(b, direction)) < 1e-3
    )
    np.testing.assert_allclose(found.sigma0, judge.sigma0, rtol=1e-3)
    np.testing.assert_allclose(found.redundancy[pair.mask], judge.redundancy, atol=2e-3)


@pytest.mark.parametrize("name", OLYMPUS)
def test_flat_field_is_oriented_or_reported(data, name):
    """A plane has a second solution: the check value is found, or the pair says that
    there are two."""
    pair, rotation, base = load(data, "olympus_camcal", name)
    found = problems.orient(pair)
    turn, shift = np.rad2deg(problems.difference(found.pose, rotation, base))
    assert (turn < 0.05 and shift < 0.05) or bool(found.result != RESULTS.successful)


def vision(pair):
    """Normalised image coordinates (point, 2) of both photos, y down."""
    x1, y1, x2, y2 = problems.arrays(pair)
    return (
        np.stack([x1, -y1], axis=1) / float(pair.focal_left),
        np.stack([x2, -y2], axis=1) / float(pair.focal_right),
    )


def from_vision(rotation, translation):
    """(R, b) of this project from X_right = R X_left + t in vision axes."""
    return TO_VISION @ rotation.T @ TO_VISION, -TO_VISION @ rotation.T @ np.ravel(
        translation
    )


@pytest.mark.parametrize(("folder", "name"), MEASURED)
def test_agrees_with_poselib(data, folder, name):
    """PoseLib minimises the Sampson error, to first order the same sum of squares."""
    poselib = pytest.importorskip("poselib")
    pair, rotation, base = load(data, folder, name)
    left, right = vision(pair)
    focal = float(pair.focal_left)
    camera = {
        "model": "SIMPLE_PINHOLE",
        "width": -1,
        "height": -1,
        "params": [focal, 0.0, 0.0],
    }
    start = poselib.CameraPose()
    start.R = TO_VISION @ rotation.T @ TO_VISION
    start.t = -TO_VISION @ rotation.T @ base
    options = {
        "loss_type": "TRIVIAL",
        "max_iterations": 100,
        "gradient_tol": 1e-14,
        "step_tol": 1e-14,
    }
    refined, _ = poselib.refine_relative_pose(
        left * focal, right * focal, start, camera, camera, options
    )
    turn, shift = np.rad2deg(
        problems.difference(
            problems.orient(pair).pose, *from_vision(refined.R, refined.t)
        )
    )
    assert turn < 1e-4 and shift < 1e-4


@pytest.mark.parametrize(("folder", "name"), MEASURED)
def test_agrees_with_opencv(data, folder, name):
    """The five-point method inside OpenCV's consensus search with its local refinement:
    near, not equal."""
    cv2 = pytest.importorskip("cv2")
    pair, _, _ = load(data, folder, name)
    left, right = vision(pair)
    pixel = 0.006 if folder == "strasbourg_block" else 1.0
    threshold = 2 * pixel / float(pair.focal_left)
    essential, inliers = cv2.findEssentialMat(
        left, right, np.eye(3), cv2.USAC_MAGSAC, 0.99999, threshold
    )
    _, rotation, translation, _ = cv2.recoverPose(
        essential, left, right, np.eye(3), mask=inliers
    )
    turn, shift = np.rad2deg(
        problems.difference(
            problems.orient(pair).pose, *from_vision(rotation, translation)
        )
    )
    assert turn < 0.1 and shift < 0.4


STATIONS = ("X", "Y", "Z")
LENS = "focal,principal,k1,k2,k3,tangential,affinity"


@pytest.mark.slow
def test_a_network_of_places_is_that_of_its_report(data, tmp_path):
    """Twenty-one photos of a target field, four known points, a row for each place, the
    camera unknown: the focal length of DBAT's report, and its stations within three of our
    deviations. Its known points have no errors."""
    folder = data / "olympus_camcal"
    lines = lambda name: [
        [cell.strip() for cell in line.split(",")]
        for line in (folder / name).read_text().splitlines()
        if line.strip() and not line.startswith("#")
    ]
    photos = {number: path.split("/")[-1][:-4] for number, path in lines("images.txt")}
    places = [[photos[k], *rest] for k, *rest in lines("markpts.txt")]
    known = [[name, *rest[1:]] for name, *rest in lines("camcal-fixed.txt")]
    table = lambda name, head, rows: write(
        tmp_path, "\n".join([head, *map(",".join, rows)]), name
    )
    camera = "[camera]\nfocal = 7.6\nprincipal_point = [1136, 852]\ny_down = true\n"
    found = run(
        "block",
        table("places.csv", "photo,point,x,y,sigma", places),
        *("--control", table("known.csv", "point,X,Y,Z", known)),
        *("--control-sigma", "0.001", "--inner", LENS, "--out", tmp_path / "out"),
        *(
            "--camera",
            write(tmp_path, f"{camera}pixel_size = {5.43764 / 1704}\n", "c.toml"),
        ),
    )
    assert found.exit_code == 0, found.stderr
    camera = {row["parameter"]: row for row in rows(tmp_path / "out" / "cameras.csv")}
    assert float(camera["focal"]["value"]) == pytest.approx(7.457, abs=0.005)
    assert float(camera["k1"]["value"]) == pytest.approx(0.00459, abs=2e-5)
    expected = {row["image"]: row for row in rows(folder / "published_eo.csv")}
    for row in rows(tmp_path / "out" / "photos.csv"):
        for axis in STATIONS:
            off = float(row[axis]) - float(expected[row["photo"]][axis])
            assert abs(off) < 3 * float(row[f"s{axis}"])
