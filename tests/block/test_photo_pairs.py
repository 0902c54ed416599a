"""Pairs of photos that a block is chained from."""

import numpy as np

from jaxro.block.measured_block import MeasuredBlock
from jaxro.block.photo_pairs import FEWEST, PARTNERS, choose_pairs, common_points


def seen(of_photos):
    """A block whose photos see these points."""
    photo = np.repeat(np.arange(len(of_photos)), [len(some) for some in of_photos])
    point = np.concatenate(of_photos)
    order = np.random.default_rng(4).permutation(len(photo))
    photo, point = photo[order], point[order]
    return MeasuredBlock(
        photos=tuple(f"p{k}" for k in range(len(of_photos))),
        points=tuple(f"t{k}" for k in range(int(np.max(point)) + 1)),
        photo=photo,
        point=point,
        x=1.0 * photo,
        y=1.0 * point,
        sigma=np.ones(len(photo)),
        focal=np.full(len(of_photos), 100.0),
    )


def test_common_points_are_those_of_sets():
    rng = np.random.default_rng(1)
    sets = [rng.choice(60, rng.integers(1, 30), replace=False) for _ in range(12)]
    block = seen(sets)
    common = common_points(block.photo, block.point, len(block.photos))
    found = {}
    for k, (left, right) in enumerate(zip(common.left, common.right, strict=True)):
        rows = slice(common.begins[k], common.begins[k + 1])
        one, other = common.one[rows], common.other[rows]
        assert np.all(block.photo[one] == left) and np.all(block.photo[other] == right)
        np.testing.assert_array_equal(block.point[one], block.point[other])
        found[int(left), int(right)] = set(block.point[one].tolist())
    expected = {
        (i, j): both
        for i in range(12)
        for j in range(i + 1, 12)
        if (both := set(sets[i].tolist()) & set(sets[j].tolist()))
    }
    assert found == expected


def test_of_many_photos_each_has_few_pairs_and_all_are_joined():
    """Two groups of forty photos, each of which sees the points of its group, and one
    photo that sees six of both."""
    one, other = np.arange(100), np.arange(100, 180)
    between = np.concatenate([one[:FEWEST], other[:FEWEST]])
    block = seen([one] * 40 + [other] * 40 + [between])
    chosen = choose_pairs(
        common_points(block.photo, block.point, len(block.photos)), 81
    )
    assert len(chosen.left) <= 81 * PARTNERS
    joined = {0}
    for _ in range(5):
        for left, right in zip(chosen.left, chosen.right, strict=True):
            if joined & {left, right}:
                joined |= {left, right}
    assert len(joined) == 81
    pairs = chosen.as_pairs(block)
    np.testing.assert_array_equal(pairs.x_left, block.x[chosen.one])
    assert np.all(chosen.counts >= FEWEST)
