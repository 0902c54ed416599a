"""Results and measurements in the words of other programs."""

from . import tangents as tangents
from .arrow import to_arrow as to_arrow
from .bundler import read_bundler as read_bundler
from .colmap_text import read_colmap_text as read_colmap_text
from .files import read as read
from .h5 import read_h5 as read_h5
from .matches import Matches as Matches
from .opencv import pair_from_opencv as pair_from_opencv
from .opencv_camera import (
    OpencvCamera as OpencvCamera,
    opencv_camera as opencv_camera,
    opencv_cameras as opencv_cameras,
)
from .pixels import PhotoPoints as PhotoPoints, pair_from_pixels as pair_from_pixels
from .pose_covariance import (
    joint_pose_covariance as joint_pose_covariance,
    photo_covariances as photo_covariances,
    pose_covariance as pose_covariance,
    pose_information as pose_information,
    relative_photo_covariance as relative_photo_covariance,
)
from .pose_graph import (
    PoseGraph as PoseGraph,
    g2o_text as g2o_text,
    pose_graph as pose_graph,
    write_g2o as write_g2o,
)
from .poses import (
    cam_from_world as cam_from_world,
    rotation_matrix as rotation_matrix,
)
from .scales import Lengths as Lengths, base_lengths as base_lengths
from .xarray import to_xarray as to_xarray
