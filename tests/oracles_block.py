"""The normal equations of a small block, dense and in NumPy."""

import numpy as np


def dense_cofactor(found):
    """(AᵀPA)⁻¹ of a linearisation by differences at the solution; small turns."""
    measured, known = found.block, found.ground
    number = found.numbered.number
    photos, points = len(measured.photos), int(number.max()) + 1
    w, x, y, z = np.asarray(found.stations.quaternion).T
    turns = np.array(
        [
            [w * w + x * x - y * y - z * z, 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), w * w - x * x + y * y - z * z, 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z],
        ]
    ).transpose(2, 0, 1)
    used = found.numbered.rays
    photo, point = measured.photo[used], number[measured.point[used]]
    ground = found.coordinates[number >= 0]
    names = [name for name, k in zip(measured.points, number, strict=True) if k >= 0]
    at_known = np.array([names.index(name) for name in known.points if name in names])

    def values(step):
        of_photos = step[: 6 * photos].reshape(photos, 6)
        at = ground + step[6 * photos :].reshape(-1, 3)
        apart = at[point] - found.centres[photo] - of_photos[photo, 3:]
        inside = np.einsum("rij,rj->ri", turns[photo], apart)
        inside = inside + np.cross(of_photos[photo, :3], inside)
        place = inside[:, :2] / inside[:, 2:] * measured.focal[photo][:, None]
        return np.concatenate(
            [
                (place / measured.sigma[used][:, None]).ravel(),
                (at[at_known] / known.sigma[0, 0]).ravel(),
            ]
        )

    count = 6 * photos + 3 * points
    size = np.concatenate(
        [np.tile([1e-6] * 3 + [1e-3] * 3, photos), [1e-3] * 3 * points]
    )
    steps = np.diag(size)
    a = [(values(s) - values(-s)) / (2 * d) for s, d in zip(steps, size, strict=True)]
    a = np.array(a).T
    assert a.shape[1] == count
    return np.linalg.inv(a.T @ a)
