"""Whether zones differ, as `jaxro calibrate` tells it."""

import numpy as np
import pytest
from calibrate_command import SIGMA, one_image, taken
from command_line import rows, run, words

from jaxro import calibration
from jaxro.calibration import Model, rectangles

AT = np.array([100.0, 50.0])


@pytest.mark.slow
@pytest.mark.parametrize("step", [0.0, 0.1])
def test_zones_that_differ_are_told(step, tmp_path):
    """By the figures of Python; the first of four focal lengths is longer by `step`."""
    rng = np.random.default_rng(3)
    points = np.round(rng.uniform([-4, -4, -2], [4, 4, 2], (32, 3)), 5)
    places = taken(rng, points, np.array([0.0, 1.0, 12.0]), (0.1, -0.1, 0.3))
    low, high = places.min(0), places.max(0)
    first = np.all((places - low) / (high - low) < 0.5, axis=1)
    places = AT + (places - AT) * (1 + step / 60 * first)[:, None]
    image, known = one_image(tmp_path, np.round(places, 5), points)
    out = tmp_path / "out"
    asked = "calibrate", image, "--object", known, "--unit", "mm", "--sigma", SIGMA
    told = run(*asked, "--zones", "rectangles:2x2", "--out", out)
    assert told.exit_code == 0, told.stderr

    given = calibration.image(*np.round(places, 5).T, points, sigma=SIGMA)
    zones = Model(x=rectangles(2, 2))
    # what is known as the command line gives it: one program for both
    found = calibration.test_zones(given, zones, calibration.known())
    assert (found.probability < 0.01) == (step > 0)
    said = "The zones differ" if step else "The zones do not differ visibly"
    assert (
        f"{said}: F(3, 52) = {float(found.f):.2f}, p = {float(found.probability):.2g}"
        in words(told.stdout)
    )
    (camera,) = rows(out / "cameras.csv")
    assert (camera["zones_above"], camera["zones_below"]) == ("3", "52")
    np.testing.assert_allclose(float(camera["zones_F"]), found.f, rtol=1e-6)
    np.testing.assert_allclose(float(camera["zones_p"]), found.probability, rtol=1e-5)


@pytest.mark.slow
def test_zones_that_are_not_tested_are_told(tmp_path):
    """A known focal length would be known of every zone."""
    rng = np.random.default_rng(3)
    points = np.round(rng.uniform([-4, -4, -2], [4, 4, 2], (32, 3)), 5)
    places = taken(rng, points, np.array([0.0, 1.0, 12.0]), (0.1, -0.1, 0.3))
    image, known = one_image(tmp_path, places, points)
    asked = "calibrate", image, "--object", known, "--sigma", SIGMA, "--focal", 60
    told = run(*asked, "--focal-sigma", 0.1, "--zones", "rectangles:2x2")
    assert told.exit_code == 0
    assert "is tested of images that are calibrated alone, without --focal" in words(
        told.stdout
    )
