"""Thousands of blocks: the same numbers as the dense adjustment of the same terms."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxro.adjustment import RESULTS, Term, adjust
from jaxro.adjustment.sparse import adjust_sparse
from jaxro.adjustment.sparse_factor import Anchor, Datum

PHOTOS, SIGMA = 13, 0.01
"""Photos of a strip (not a number for which there is exact room), and the standard
deviation of a place."""


def image(photo, point, focal):
    """The place of a point: three small angles and the centre of the photo."""
    a, b, c = photo[0], photo[1], photo[2]
    x, y, z = point[0] - photo[3], point[1] - photo[4], point[2] - photo[5]
    u, v, w = x - c * y + b * z, c * x + y - a * z, -b * x + a * y + z
    return jnp.stack([u, v]) * -focal / w


def misfit(photo, point, focal, measured):
    return image(photo, point, focal[0]) - measured


def from_known(point, known):
    return point - known


def base_length(first, second, measured):
    return jnp.sqrt(jnp.sum((second[3:6] - first[3:6]) ** 2)) - measured


def from_position(photo, measured):
    return photo[3:6] - measured


@pytest.fixture(scope="module")
def strip():
    """Photos in random order, each point on the two or three that show it, one of them
    measured twice there; known points; distances between neighbours; one position."""
    rng = np.random.default_rng(5)
    names = rng.permutation(PHOTOS)
    photos = np.zeros((PHOTOS, 6))
    photos[names] = np.concatenate(
        [
            rng.normal(0, 0.02, (PHOTOS, 3)),
            np.arange(PHOTOS)[:, None] * 60.0 + rng.normal(0, 3, (PHOTOS, 1)),
            rng.normal(0, 3, (PHOTOS, 1)),
            150 + rng.normal(0, 3, (PHOTOS, 1)),
        ],
        axis=1,
    )
    points, rays = [], []
    for place in range(PHOTOS - 1):
        for k in range(6):
            x, y = place * 60 + rng.uniform(0, 60), (k - 2.5) * 25
            shown = names[max(0, place - 1 + k % 2) : place + 2]
            rays += [(photo, len(points)) for photo in shown]
            points.append([x, y, rng.uniform(-10, 10)])
    rays.append(rays[-1])
    points, (photo, point) = np.array(points), np.array(rays).T
    focal = np.array([[100.0]])
    places = jax.vmap(image, (0, 0, None))(photos[photo], points[point], 100.0)
    places = np.asarray(places) + rng.normal(0, SIGMA, (len(rays), 2))
    known = np.arange(0, len(points), 9)
    ground = points[known] + rng.normal(0, 0.02, (len(known), 3))
    first, second = names[:-1], names[1:]
    bases = np.linalg.norm(photos[second, 3:] - photos[first, 3:], axis=1)
    near = {
        "photo": photos + rng.normal(0, 1, photos.shape) * ([0.002] * 3 + [1.0] * 3),
        "camera": focal + 0.5,
        "point": points + rng.normal(0, 1, points.shape),
    }
    use = np.ones(len(rays), bool)
    use[np.flatnonzero(np.bincount(point)[point] == 3)[0]] = False
    zero = np.zeros(len(rays), int)
    touches = [("photo", photo), ("point", point), ("camera", zero)]
    terms = (
        Term(misfit, places, SIGMA**2, touches=touches, mask=use),
        Term(from_known, ground, 0.02**2, touches=[("point", known)]),
        Term(
            base_length,
            bases + rng.normal(0, 0.05, len(bases)),
            0.05**2,
            touches=[("photo", first), ("photo", second)],
        ),
        Term(
            from_position,
            photos[[4], 3:] + 0.01,
            0.1**2,
            touches=[("photo", np.array([4]))],
        ),
    )
    return terms, near


def dense(terms, near, **how):
    """The same by `adjust`."""
    return jax.jit(lambda start: adjust(terms, start, eliminate="point", **how))(near)


def assert_same(found, expected):
    """Parameters, cofactors (in deviations), redundancy, sigma0."""
    assert found.result == expected.result == RESULTS.successful
    for name in ("photo", "point"):
        q = np.asarray(expected.cofactors(name))
        deviations = np.sqrt(np.diagonal(q, axis1=1, axis2=2))
        apart = found.parameters[name] - expected.parameters[name]
        assert np.max(np.abs(apart) / deviations) < 1e-6
        unit = deviations[:, :, None] * deviations[:, None, :]
        own = found.cofactors[name]
        np.testing.assert_allclose(own / unit, q / unit, atol=1e-8)
    for own, other in zip(found.redundancy, expected.redundancy, strict=True):
        np.testing.assert_allclose(own, other, atol=1e-8)
    np.testing.assert_allclose(found.sigma0, expected.sigma0, rtol=1e-8)
    assert found.degrees_of_freedom == expected.degrees_of_freedom


def test_it_is_the_dense_adjustment(strip):
    terms, near = strip
    found = adjust_sparse(terms, near, eliminate="point", linked="photo")
    expected = dense(terms, near)
    assert_same(found, expected)
    places = expected.layout.places("camera", jnp.arange(1))[0]
    own = expected.cofactor[jnp.ix_(places, places)]
    np.testing.assert_allclose(found.common_cofactor, own, rtol=1e-7)


@pytest.mark.slow
def test_a_free_network(strip):
    """The datum is the mean of the photos' positions, where distances alone hold the
    scale and angles the directions."""
    terms, near = strip
    angles = Term(
        from_angles,
        near["photo"][:, :3],
        1e-3**2,
        touches=[("photo", np.arange(PHOTOS))],
    )
    focal = Term(
        from_known,
        np.full((1, 1), 100.0),
        0.1**2,
        touches=[("camera", np.zeros(1, int))],
    )
    terms = (terms[0], terms[2], angles, focal)
    start = near["photo"][:, 3:].copy()

    def datum(families):
        rows = np.zeros((3, PHOTOS, 6))
        rows[np.arange(3), :, 3 + np.arange(3)] = 1.0
        moved = np.sum(np.asarray(families["photo"])[:, 3:] - start, axis=0)
        anchors = tuple(Anchor(5, np.eye(6)[k]) for k in (3, 4, 5))
        return Datum(rows, moved, anchors)

    found = adjust_sparse(terms, near, eliminate="point", linked="photo", datum=datum)
    mean = lambda kept: jnp.sum(kept["photo"][:, 3:] - start, axis=0)
    assert_same(found, dense(terms, near, constraints=mean))


def from_angles(photo, measured):
    return photo[:3] - measured


def test_what_is_not_determined_is_told(strip):
    """Without known points the strip may go anywhere."""
    terms, near = strip
    found = adjust_sparse(terms[:1], near, eliminate="point", linked="photo")
    assert found.result != RESULTS.successful
