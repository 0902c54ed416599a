"""Calibrated cameras as files of other programs."""

from typing import Any

from ..exchange.opencv_camera import opencv_camera
from ..reports.calibration_model import Done, Photo
from ..reports.files import json_text


def opencv_text(done: Done) -> dict[str, str]:
    """opencv.json by its name: the camera matrix and the distortion coefficients of each
    camera, and what they cannot say, in the unit of the image; or the reason why it is
    no camera of OpenCV."""
    cameras = {one.camera: _entry(one) for one in done.cameras}
    return {"opencv.json": json_text({"cameras": cameras})}


def _entry(one: Photo) -> dict[str, Any]:
    """What is told of one camera."""
    try:
        found = opencv_camera(one.found)
    except ValueError as error:
        return {"reason": str(error).removeprefix("opencv_camera: ")}
    return {
        "camera_matrix": found.matrix.tolist(),
        "distortion_coefficients": found.distortion.tolist(),
        "rest_rms": found.rest,
        "rest_largest": found.largest,
    }
