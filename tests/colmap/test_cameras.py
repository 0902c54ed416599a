"""Every camera model of COLMAP: from pixels to photo coordinates and their cofactors."""

import numpy as np
import pytest

pycolmap = pytest.importorskip("pycolmap", reason="pycolmap has the camera models")

from jaxro.colmap.cameras import (  # noqa: E402
    WIDEST,
    camera_matrix,
    focal_length,
    to_photo,
)
from jaxro.colmap.transaction import open_database  # noqa: E402

WIDTH, HEIGHT = 1024, 768
ORDINARY = {
    "SIMPLE_PINHOLE": [1200, 500, 400],
    "PINHOLE": [1200, 1250, 500, 400],
    "SIMPLE_RADIAL": [1280, 512, 384, -0.2],
    "RADIAL": [1100, 500, 380, 0.1, -0.05],
    "OPENCV": [1100, 1080, 505, 390, -0.28, 0.09, 0.001, -0.002],
    "FULL_OPENCV": [
        *(1100, 1080, 505, 390, -0.3, 0.1, 0.001, -0.002),
        *(0.01, 0.05, -0.02, 0.003),
    ],
    "SIMPLE_DIVISION": [1100, 505, 390, -0.2],
    "DIVISION": [1100, 1080, 505, 390, -0.2],
}
"""Those that see no wide angle."""
WIDE = {
    "OPENCV_FISHEYE": [450, 445, 505, 390, -0.02, 0.01, -0.002, 0.0003],
    "FOV": [400, 410, 505, 390, 0.9],
    "SIMPLE_RADIAL_FISHEYE": [450, 505, 390, -0.02],
    "RADIAL_FISHEYE": [450, 505, 390, -0.02, 0.003],
    "THIN_PRISM_FISHEYE": [
        *(450, 445, 505, 390, -0.02, 0.01, 0.0005),
        *(-0.0004, 0.0003, -0.0001, 0.001, -0.0008),
    ],
    "RAD_TAN_THIN_PRISM_FISHEYE": [
        *(450, 445, 505, 390, -0.02, 0.01, -0.002, 0.0003, 0, 0),
        *(0.0005, -0.0004, 0.001, 0, -0.0008, 0),
    ],
    "SIMPLE_FISHEYE": [450, 505, 390],
    "FISHEYE": [450, 445, 505, 390],
    "EUCM": [400, 410, 505, 390, 0.6, 1.1],
    "EQUIRECTANGULAR": [WIDTH, HEIGHT],
}
known = pycolmap.CameraModelId.__members__
MODELS = {name: values for name, values in (ORDINARY | WIDE).items() if name in known}
"""Those that this pycolmap knows."""


def camera_of(model, parameters=None):
    return pycolmap.Camera(
        model=model,
        width=WIDTH,
        height=HEIGHT,
        params=MODELS[model] if parameters is None else parameters,
        has_prior_focal_length=True,
    )


def random_pixels(count=500):
    return np.random.default_rng(0).uniform(0, [WIDTH, HEIGHT], (count, 2))


def test_every_model_is_tested():
    assert set(known) - {"INVALID"} == set(MODELS)


@pytest.mark.parametrize("model", MODELS)
def test_rays_are_those_of_colmap(model):
    """Whatever is seen is projected back to its pixel, and whatever is projected back
    is seen."""
    camera, pixels = camera_of(model), random_pixels()
    found, f = to_photo(pixels, camera), focal_length(camera_matrix(camera))
    rays = np.stack([found.x, -found.y, np.full(500, f)], axis=1)
    back = camera.img_from_cam(rays[found.seen])
    np.testing.assert_allclose(back, pixels[found.seen], atol=1e-6)
    with np.errstate(all="ignore"):
        u, v = camera.cam_from_img(pixels).T
        again = camera.img_from_cam(np.stack([u, v, np.ones(500)], axis=1))
        there = np.all(np.abs(again - pixels) < 1e-6, axis=1)
    np.testing.assert_array_equal(found.seen, there & (np.hypot(u, v) < WIDEST))
    assert np.all(found.seen) if model in ORDINARY else np.mean(found.seen) > 0.2
    for values in found[:-1]:
        assert np.all(values[~found.seen] == 0)
    if model != "EQUIRECTANGULAR":
        assert abs(f - camera.mean_focal_length()) < 1e-9
        np.testing.assert_array_equal(
            camera_matrix(camera), camera.calibration_matrix()
        )


@pytest.mark.parametrize("model", MODELS)
def test_cofactors_are_those_of_finite_differences(model):
    """J of the rays that pycolmap itself finds half a step beside each keypoint."""
    camera, pixels, step = camera_of(model), random_pixels(), 1e-3
    found, f = to_photo(pixels, camera), focal_length(camera_matrix(camera))
    seen = found.seen & (np.hypot(found.x, found.y) < 5 * f)

    def photo(offset):
        u, v = camera.cam_from_img(pixels[seen] + offset).T
        return f * np.stack([u, -v])

    jacobian = np.stack(
        [
            (photo(d) - photo(-d)) / (2 * step)
            for d in (np.array([step, 0]), np.array([0, step]))
        ]
    )
    cofactors = np.einsum("jip,jkp->pik", jacobian, jacobian)
    ours = np.stack([found.xx, found.xy, found.xy, found.yy], axis=1)[seen]
    size = np.trace(cofactors, axis1=1, axis2=2)[:, None]
    np.testing.assert_allclose(
        ours / size, cofactors.reshape(-1, 4) / size, rtol=0, atol=2e-5
    )
    area = np.abs(np.linalg.det(np.moveaxis(jacobian, 2, 0)))
    np.testing.assert_allclose(found.scale[seen], np.sqrt(area), rtol=2e-5)
    least, most = (a[seen] for a in found.variances)
    np.testing.assert_allclose(least * most, area**2, rtol=1e-4)


def test_an_error_grows_more_along_the_radius():
    """θ = r/f: along the radius 1/cos²θ, across it tan θ/θ."""
    camera = camera_of("SIMPLE_FISHEYE")
    angle = np.deg2rad(70.0)
    found = to_photo(np.array([[505 + 450 * angle, 390.0]]), camera)
    along, across = 1 / np.cos(angle) ** 2, np.tan(angle) / angle
    np.testing.assert_allclose(found.x, 450 * np.tan(angle), rtol=1e-9)
    np.testing.assert_allclose(found.xx, along**2, rtol=1e-8)
    np.testing.assert_allclose(found.yy, across**2, rtol=1e-8)
    np.testing.assert_allclose(found.xy, 0, atol=1e-7)


def test_no_ray_is_seen_beyond_the_fold():
    """r (1 - r²/2) has its largest value .544 at r = .816."""
    camera = camera_of("SIMPLE_RADIAL", [600, 512, 384, -0.5])
    for at, seen in ((0.54, True), (0.55, False), (np.inf, False)):
        assert to_photo(np.array([[512 + 600 * at, 384.0]]), camera).seen == [seen]


def test_rays_beside_the_photo_have_no_photo_coordinates():
    """Angles of a fisheye: up to 89.4° there are coordinates."""
    camera = camera_of("SIMPLE_FISHEYE", [100, 500, 400])
    for degrees, seen in (
        (0, True),
        (89, True),
        (89.9, False),
        (90, False),
        (120, False),
    ):
        pixels = np.array([[500.0, 400.0 + 100 * np.deg2rad(degrees)]])
        found = to_photo(pixels, camera)
        assert found.seen == [seen] and np.all(np.isfinite(found))


@pytest.mark.parametrize("model", MODELS)
def test_every_model_is_read(model, tmp_path):
    """Parameters to the last digit, from a database that pycolmap has written."""
    file, camera = tmp_path / "one.db", camera_of(model)
    with pycolmap.Database.open(str(file)) as database:
        number = database.write_camera(camera)
        image = pycolmap.Image(name="image.png", camera_id=number)
        images = database.write_image(image), 2
        database.write_image(pycolmap.Image(name="other.png", camera_id=number))
    pair_id = pycolmap.image_pair_to_pair_id(*images)
    with open_database(file, None, False) as database:
        read = database.cameras(database.images([pair_id]), False)[number]
    assert read.model == camera.model and read.has_prior_focal_length
    np.testing.assert_array_equal(read.params, camera.params)
    pixels = random_pixels(50)
    for ours, theirs in zip(
        to_photo(pixels, read), to_photo(pixels, camera), strict=True
    ):
        np.testing.assert_array_equal(ours, theirs)
