"""What tests of blocks share: the normal equations of a small block, dense and in NumPy,
and blocks with wrong rays."""

import numpy as np


def dense_cofactor(found):
    """(AᵀPA)⁻¹ of a linearisation by differences at the solution; small turns."""
    a = dense_slopes(found)
    return np.linalg.inv(a.T @ a)


def rotations_of(quaternions):
    """The matrices of unit quaternions (w, x, y, z)."""
    w, x, y, z = quaternions.T
    return np.array(
        [
            [w * w + x * x - y * y - z * z, 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), w * w - x * x + y * y - z * z, 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z],
        ]
    ).transpose(2, 0, 1)


def dense_slopes(found):
    """A of all rays, and of the known points where there are any, with their weights:
    by differences at the solution. The columns are small turns about the camera's axes
    and shifts of each photo, then shifts of each point."""
    measured, known = found.block, found.ground
    number = found.numbered.number
    photos, points = len(measured.photos), int(number.max()) + 1
    turns = rotations_of(np.asarray(found.stations.quaternion))
    used = found.numbered.rays
    photo, point = measured.photo[used], number[measured.point[used]]
    ground = found.coordinates[number >= 0]
    names = [name for name, k in zip(measured.points, number, strict=True) if k >= 0]
    of_known = () if known is None else known.points
    at_known = np.array([names.index(name) for name in of_known if name in names], int)
    spread = 1.0 if known is None else known.sigma[0, 0]

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
                (at[at_known] / spread).ravel(),
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
    return a


def with_wrong_rays(mock, seed, share):
    """The block with one ray of so many points moved by up to 20 mm, and which."""
    rng, measured = np.random.default_rng(seed), mock.block
    wrong = rng.random(len(measured.points)) < share
    order = rng.random(len(measured.x))
    last = np.zeros(len(measured.points))
    np.maximum.at(last, measured.point, order)
    bad = wrong[measured.point] & (order == last[measured.point])
    moved = lambda a: np.where(bad, a + rng.uniform(-20, 20, len(a)), a)
    return measured._replace(x=moved(measured.x), y=moved(measured.y)), bad


def find_rays(found, measured, some):
    """Which rays of a block that was made of pairs are those rays of what was
    measured."""
    places = set(zip(measured.x[some], measured.y[some], strict=True))
    return np.array([place in places for place in zip(found.x, found.y, strict=True)])
