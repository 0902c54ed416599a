"""The generators of scenes tell the truth about what they generate."""

import numpy as np
import pytest
import scenes

CASES = {
    **{
        kind: lambda kind=kind: scenes.photographs(16, 200, 0.5, kind)
        for kind in scenes.BASES
    },
    **{
        kind: lambda kind=kind: scenes.target_fields(40, kind) for kind in scenes.FIELDS
    },
    "any position": lambda: scenes.any_position(8, 400, 0.7),
}


def distances(pairs: scenes.Scenes, k: int) -> np.ndarray:
    """Of all matches of one pair from the true pose, in sigma."""
    left, right = (
        np.stack([c[k] for c in side], axis=1)
        for side in (pairs.coordinates[:2], pairs.coordinates[2:])
    )
    return (
        scenes.sampson(left, right, pairs.focal[k], pairs.rotation[k], pairs.base[k])
        / pairs.sigma[k]
    )


@pytest.mark.parametrize("name", CASES)
def test_true_matches_lie_sigma_from_the_true_pose(name):
    pairs = CASES[name]()
    every = np.abs(
        np.concatenate(
            [distances(pairs, k)[pairs.good[k]] for k in range(len(pairs.focal))]
        )
    )
    assert np.median(every) * 1.4826 == pytest.approx(1, abs=0.08)
    np.testing.assert_allclose(np.linalg.det(pairs.rotation), 1)
    np.testing.assert_allclose(np.linalg.norm(pairs.base, axis=1), 1)


@pytest.mark.parametrize("name", CASES)
def test_true_points_are_in_front_of_both_photos(name):
    pairs = CASES[name]()
    for k in range(len(pairs.focal)):
        m, f = pairs.good[k], -pairs.focal[k]
        p1 = np.stack(
            [pairs.x_left[k][m], pairs.y_left[k][m], np.full(m.sum(), f)], axis=1
        )
        p2 = (
            np.stack(
                [pairs.x_right[k][m], pairs.y_right[k][m], np.full(m.sum(), f)], axis=1
            )
            @ pairs.rotation[k].T
        )
        depths = [
            np.linalg.lstsq(np.stack([a, -b], axis=1), pairs.base[k], rcond=None)[0]
            for a, b in zip(p1, p2, strict=True)
        ]
        assert (
            np.mean(np.array(depths) > 0) > 0.97
        )  # noise puts few points near the epipoles behind


def test_wrong_matches_are_counted_and_seeded():
    pairs, again = scenes.photographs(8, 200, 0.7), scenes.photographs(8, 200, 0.7)
    assert np.all(pairs.good.sum(axis=1) == 60)
    assert not np.any(pairs.good & pairs.undecidable)
    for one, other in zip(pairs, again, strict=True):
        np.testing.assert_array_equal(one, other)
    assert not np.any(scenes.photographs(4, 200, 1.0, common=False).good)
