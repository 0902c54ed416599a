"""Calibrated cameras as files of other programs."""

from collections.abc import Callable
from typing import Any

from ..block.cameras import cameras_of
from ..exchange.opencv_camera import OpencvCamera, opencv_camera, opencv_cameras
from ..geometry.pairs import Camera
from ..reports.block_model import Done as Block
from ..reports.calibration_model import Done
from ..reports.files import json_text


def opencv_text(done: Done) -> dict[str, str]:
    """opencv.json by its name: the camera matrix and the distortion coefficients of each
    camera, and what they cannot say, in the unit of the image; or the reason why it is
    no camera of OpenCV."""
    cameras = {
        one.camera: _entry(lambda one=one: opencv_camera(one.found))
        for one in done.cameras
    }
    return {"opencv.json": json_text({"cameras": cameras})}


def opencv_of_block(done: Block, given: tuple[Camera, ...]) -> dict[str, str]:
    """The same of a block whose inner parameters are unknown, in the pixels of its
    images; `given`: the cameras of its photos. Nothing for other blocks."""
    adjusted = done.adjusted
    if adjusted.inner is None or not done.usable or not given:
        return {}
    cameras = cameras_of(adjusted.block)
    found, entries = opencv_cameras(adjusted), {}
    for k, name in enumerate(cameras.names):
        own = given[cameras.of_photo.tolist().index(k)]
        turned = found[name].in_pixels(
            own.pixel_size, own.principal_point, y_down=own.y_down
        )
        entries[name] = _entry(lambda turned=turned: turned)
    return {"opencv.json": json_text({"cameras": entries})}


def _entry(find: Callable[[], OpencvCamera]) -> dict[str, Any]:
    """What is told of one camera."""
    try:
        found = find()
    except ValueError as error:
        return {"reason": str(error).removeprefix("opencv_camera: ")}
    return {
        "camera_matrix": found.matrix.tolist(),
        "distortion_coefficients": found.distortion.tolist(),
        "rest_rms": found.rest,
        "rest_largest": found.largest,
    }
