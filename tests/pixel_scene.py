"""Photos of one scene in the axes of OpenCV and COLMAP (x right, y down, z forward),
projected in plain NumPy, and the relative pose that jaxro should find."""

import numpy as np
from scipy.spatial.transform import Rotation

AXES = np.diag([1.0, -1.0, -1.0])

K_LEFT = np.array([[812.0, 1.5, 330.0], [0, 790.0, 236.0], [0, 0, 1]])
K_RIGHT = np.array([[655.0, 0, 310.0], [0, 671.0, 251.0], [0, 0, 1]])
DISTORTION = (-0.21, 0.06, 8e-4, -5e-4, 0.01)


def points(count=40, seed=3):
    """(point, 3), four to eight units in front of the first photo."""
    rng = np.random.default_rng(seed)
    depth = rng.uniform(4.0, 8.0, count)
    across = rng.uniform([-0.33, -0.25], [0.33, 0.25], (count, 2))
    return np.column_stack([across * depth[:, None], depth])


def pose(number):
    """cam_from_world (R, t) of photo 0, 1, 2, ...; that of photo 0 is the world's."""
    turn = Rotation.from_euler("xyz", number * np.array([2.0, -5.0, 3.0]), degrees=True)
    centre = number * np.array([1.0, 0.1, -0.15])
    return turn.as_matrix(), -turn.as_matrix() @ centre


def rays(world, number):
    """(u, v) of world points on a photo."""
    rotation, t = pose(number)
    seen = world @ rotation.T + t
    return seen[:, :2] / seen[:, 2:]


def distorted(uv, coefficients):
    """As the documentation of OpenCV has it."""
    k1, k2, p1, p2, k3 = coefficients
    u, v = uv.T
    r2 = u**2 + v**2
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    return np.column_stack(
        [
            u * radial + 2 * p1 * u * v + p2 * (r2 + 2 * u**2),
            v * radial + p1 * (r2 + 2 * v**2) + 2 * p2 * u * v,
        ]
    )


def pixels(uv, matrix):
    """(column, row) of rays."""
    return uv @ matrix[:2, :2].T + matrix[:2, 2]


def relative(first, second):
    """R and B of jaxro's pair: X = λ p1 = B + μ R p2, B of length 1."""
    (r1, t1), (r2, t2) = pose(first), pose(second)
    rotation = r2 @ r1.T
    base = r1 @ (-r2.T @ t2) + t1
    turned = AXES @ rotation.T @ AXES
    return turned, AXES @ base / np.linalg.norm(base)


def errors(orientation, first=0, second=1):
    """Angles (rad) between the rotations and the bases of an orientation and the
    truth."""
    rotation, base = orientation.pose.relative()
    rotation = np.array([[float(e) for e in row] for row in rotation])
    base = np.array([float(b) for b in base])
    true_rotation, true_base = relative(first, second)
    turn = Rotation.from_matrix(rotation @ true_rotation.T).magnitude()
    return turn, np.linalg.norm(np.cross(base / np.linalg.norm(base), true_base))
