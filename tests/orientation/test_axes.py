"""What is wrong with a pair as a whole, by numbers alone."""

import numpy as np
import pytest

from jaxro.orientation import axes
from jaxro.orientation.axes import Fit


@pytest.fixture
def rng():
    return np.random.default_rng(4)


def spread(rng, centre=(0.0, 0.0)):
    """Points all over a photo of 200 by 200."""
    return rng.uniform(-100, 100, (20, 2)) + centre


@pytest.mark.parametrize(
    ("focal", "said", "no_lens"),
    [
        (100.0, None, False),
        (60.0, None, False),
        (10.0, "axis", False),
        (0.1, "axis", True),
        (50_000.0, "within", False),
    ],
)
def test_a_focal_length_in_another_unit_is_told(rng, focal, said, no_lens):
    photo = spread(rng)
    told = axes.tell_field(photo, focal)
    assert said in told if said else told is None
    assert axes.is_no_lens(photo, focal) == no_lens


def test_one_wrong_coordinate_is_no_other_unit(rng):
    photo = spread(rng)
    photo[3, 0] = 1e5
    assert axes.tell_field(photo, 100.0) is None
    assert not axes.is_no_lens(photo, 100.0)


def test_an_origin_in_a_corner_is_told(rng):
    left, right = spread(rng, (110, 110)), spread(rng, (110, 110))
    assert "corner" in axes.tell_origin(left, right)
    assert "corner" in axes.tell_origin(left * [1, -1], right * [1, -1])
    for other in (spread(rng), spread(rng, (1000, 1000)), -right):
        assert axes.tell_origin(left, other) is None
    assert axes.tell_origin(left[:5], right[:5]) is None


@pytest.mark.parametrize(
    ("sigma0", "freedom", "sigma", "said"),
    [
        (0.005, 10, None, None),
        (2.0, 10, None, "% of the focal length"),
        (0.005, 10, 0.005, None),
        (0.02, 10, 0.005, None),
        (0.03, 10, 0.005, "times the standard deviation"),
        (0.03, 1, 0.005, None),
        (0.005, 10, 0.03, "too large"),
        (np.nan, 10, 0.03, None),
    ],
)
def test_an_absurd_sigma0_is_told(sigma0, freedom, sigma, said):
    told = axes.tell_sigma0(sigma0, freedom, 150.0, sigma, "mm")
    assert said in told if said else told is None


FITS = Fit(True, 16, 16, 0.005)


@pytest.mark.parametrize(
    ("given", "mirrored", "named"),
    [
        (Fit(False, 8, 8, 0.005), FITS, True),
        (Fit(False, 16, 0, np.nan), FITS, True),
        (Fit(True, 10, 10, 0.005), FITS, True),
        # one wrong match behind a photo is no mirrored photo
        (Fit(False, 16, 15, np.nan), FITS, False),
        # a larger error fits everything
        (Fit(True, 10, 10, 0.005), FITS._replace(sigma0=0.1), False),
        (Fit(False, 16, 0, np.nan), FITS._replace(usable=False), False),
        (Fit(False, 16, 0, np.nan), FITS._replace(points=9), False),
        (FITS, FITS, False),
    ],
)
def test_a_mirrored_photo_is_one_that_fits_better_as_an_image(given, mirrored, named):
    assert axes.is_mirrored(given, mirrored, 16, 150.0) == named


def test_points_in_a_plane_do_not_tell_a_mirrored_photo(rng):
    left = spread(rng)
    across = np.column_stack([left, np.full(len(left), -100.0)])
    homography = np.eye(3) + 0.1 * rng.normal(size=(3, 3))
    moved = across @ homography.T
    right = -100 * moved[:, :2] / moved[:, 2:]
    assert axes.lie_in_plane(left, right + rng.normal(0, 0.01, right.shape), 0.01)
    assert not axes.lie_in_plane(left, right + rng.normal(0, 1.0, right.shape), 0.01)
