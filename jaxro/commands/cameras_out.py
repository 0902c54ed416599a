"""Calibrated cameras as files of other programs."""

from ..exchange.opencv_camera import opencv_camera
from ..reports.calibration_model import Done
from ..reports.files import json_text


def opencv_text(done: Done) -> dict[str, str]:
    """opencv.json by its name: the camera matrix and the distortion coefficients of each
    camera, and what they cannot say, in the unit of the image. Nothing where no camera
    has numbers that may be used, or can be one of OpenCV."""
    cameras = {}
    for one in done.cameras:
        try:
            found = opencv_camera(one.found)
        except ValueError:
            continue  # another projection, or not usable, which the report says
        cameras[one.camera] = {
            "camera_matrix": found.matrix.tolist(),
            "distortion_coefficients": found.distortion.tolist(),
            "rest_rms": found.rest,
            "rest_largest": found.largest,
        }
    return {"opencv.json": json_text({"cameras": cameras})} if cameras else {}
