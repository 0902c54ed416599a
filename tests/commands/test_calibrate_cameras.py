"""Cameras of `jaxro calibrate`: of wide angles (--fisheye), of each image its own
(--own-cameras), and what is known of all of them."""

import re

import numpy as np
import pytest
from bad_tables import write
from calibrate_command import SIGMA, names_of, numbers, one_image, table, taken, told
from command_line import rows, run, words
from oracles_calibration import rotation

from jaxro import calibration
from jaxro.calibration import Model

AT = np.array([100.0, 50.0])
FOCALS = (50.0, 60.0, 80.0)


def wide_photo(rng, station, angles):
    """48 points up to 75° from the axis, and their places by 2 f tan(θ/2), f = 12 mm,
    y downwards."""
    off, around = rng.uniform(0.1, np.radians(75), 48), rng.uniform(0, 2 * np.pi, 48)
    along = [np.sin(off) * np.cos(around), np.sin(off) * np.sin(around), -np.cos(off)]
    rays = np.stack(along, axis=1) * rng.uniform(5, 9, 48)[:, None]
    points = np.round(rays @ rotation(*angles) + station, 5)
    radius = 2 * 12 * np.tan(off / 2)
    places = np.stack([radius * np.cos(around), -radius * np.sin(around)], axis=1)
    return points, places + AT + rng.normal(0, SIGMA, places.shape)


@pytest.mark.slow
def test_a_fisheye_sees_150_degrees(tmp_path):
    """Station and focal length come out within their deviations."""
    station = np.array([10.0, 5.0, 3.0])
    places = wide_photo(np.random.default_rng(2), station, (0.2, -0.1, 0.5))
    image, known = one_image(tmp_path, places[1], places[0])
    asked = "calibrate", image, "--object", known, "--model", "one-f", "--sigma", SIGMA
    found = run(*asked, "--fisheye", "--unit", "mm")
    assert found.exit_code == 0, found.stderr
    sigma0 = re.search(r"sigma0 (\S+),", found.stdout)
    assert sigma0 and 0.75 < float(sigma0[1]) < 1.25
    for name, truth in zip("XYZf", (*station, 12.0), strict=True):
        value, deviation = told(found.stdout, name)
        assert abs(value - truth) < 4 * deviation < 0.04


@pytest.fixture
def three_cameras(tmp_path):
    """The tables of three photos by cameras of the focal lengths `FOCALS`; seven of
    24 points are known."""
    rng = np.random.default_rng(6)
    points = np.round(rng.uniform([-3, -3, -2], [3, 3, 2], (24, 3)), 5)
    places = []
    for k, (x, focal) in enumerate(zip((-2.0, 0.0, 2.0), FOCALS, strict=True)):
        angles = 0.1 * (-1) ** k, 0.12 * x, 0.8 * k
        seen = taken(rng, points, np.array([x, 0.5 * k, 11.0]), angles, noise=0.0)
        noise = rng.normal(0, SIGMA, seen.shape)
        places.append(AT + (seen - AT) * focal / 60 + noise)
    places = np.round(np.concatenate(places), 5)
    unknown = np.arange(24) >= 7
    points[unknown] = np.nan
    names = names_of("p", points)
    of_images = [name for name in "abc" for _ in points]
    known = table("point,X,Y,Z", names, *points.T).replace("nan", "")
    tables = (
        write(
            tmp_path, table("image,point,x,y", of_images, names * 3, *places.T), "i.csv"
        ),
        write(tmp_path, known, "p.csv"),
    )
    at = np.repeat(np.arange(3), 24), np.tile(np.arange(24), 3)
    measured = calibration.images(
        *places.T, *at, points, sigma=SIGMA, camera=np.arange(3)
    )
    return tables, measured


@pytest.mark.slow
def test_each_image_has_a_camera_of_its_own(three_cameras):
    """The figures are those of Python, and true; what is known of the principal place
    counts for all three."""
    (images, points), measured = three_cameras
    asked = "calibrate", images, "--object", points, "--model", "one-f", "--own-cameras"
    place = "--principal-point", 100.01, 50, "--principal-sigma", 0.02
    report = run(*asked, "--sigma", SIGMA, "--unit", "mm", *place)
    assert report.exit_code == 0, report.stderr
    assert "3 images together, 3 cameras" in report.stdout
    principal = calibration.known(principal=(100.01, 50.0), principal_sigma=0.02)
    found = calibration.calibrate_together(measured, Model(), principal)
    free = calibration.calibrate_together(measured, Model())
    assert np.all(found.focal_deviations < free.focal_deviations)
    cameras = report.stdout.split("Principal place and focal lengths")[1]
    for k, own in enumerate(cameras.split("x0")[1:4]):
        value, deviation = told(own, "f")
        assert abs(value - FOCALS[k]) < 4 * deviation
        assert abs(value - found.focal[k, 0]) < 0.06 * deviation
        np.testing.assert_allclose(deviation, found.focal_deviations[k, 0], rtol=0.06)
        y0, of_y0 = told(own, "y0")
        assert abs(y0 - found.principal[k, 1]) < 0.06 * of_y0
        assert of_y0 < 0.021 * float(found.sigma0)


@pytest.mark.slow
def test_known_numbers_need_the_sigma_of_the_places(three_cameras):
    """Else they are weighed against places of the standard deviation 1."""
    (images, points), _ = three_cameras
    asked = "calibrate", images, "--object", points, "--model", "one-f", "--own-cameras"
    report = run(*asked, "--principal-point", 100, 50, "--principal-sigma", 0.02)
    said = "known numbers of the camera have standard deviations"
    assert said in words(report.stdout)


def test_own_cameras_are_of_images_together(three_cameras):
    (images, points), _ = three_cameras
    asked = "calibrate", images, "--object", points, "--own-cameras", "--separately"
    report = run(*asked)
    assert report.exit_code == 2
    assert "--own-cameras: found it beside" in report.stderr


@pytest.mark.slow
def test_the_choice_among_lenses_knows_the_principal_place(three_cameras, tmp_path):
    (images, points), _ = three_cameras
    asked = "calibrate", images, "--object", points, "--model", "lens", "--own-cameras"
    out = tmp_path / "out"
    place = "--principal-point", 100, 50, "--principal-sigma", 0.001
    report = run(*asked, "--sigma", SIGMA, "--unit", "mm", *place, "--out", out)
    assert report.exit_code == 0, report.stderr
    found = numbers(rows(out / "cameras.csv"), "x0", "y0")
    assert np.all(np.abs(found - AT) < 0.004)
