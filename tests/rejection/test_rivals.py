"""Two poses that explain some of the points each are both told, and none of them is used
unless it stands out."""

import dataclasses
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import problems
import pytest
import scenes

import jaxro
from jaxro.batches.padding import Plan
from jaxro.batches.ragged import clean_ragged, join
from jaxro.geometry.pairs import unstack
from jaxro.orientation.results import RESULTS
from jaxro.rejection import OUTCOMES, Recommended, classification
from jaxro.rejection.evidence import cells, held_by, one_of_each
from jaxro.rejection.judgement import nothing_known
from jaxro.rejection.rivals import judge_contest, tell_rivals
from jaxro.rejection.visibility import seen

POINTS = 100
PLAN = Plan((112,), (4,), (112,))
"""Programs of one size."""


def pairs_of(found: scenes.Scenes) -> list[jaxro.Pair]:
    sigma = np.broadcast_to(found.sigma[:, None], found.good.shape)
    return unstack(jaxro.pair(*found.coordinates, focal=found.focal, sigma=sigma))


def distances(pose, found, k):
    """Of every match of pair k from a pose (qw, qx, qy, qz, bx, by, bz), in sigma."""
    w, v, base = pose[0], pose[1:4], pose[4:]
    cross = np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])
    rotation = np.eye(3) + 2 * w * cross + 2 * cross @ cross
    sides = found.coordinates[:2], found.coordinates[2:]
    left, right = (np.stack(side, axis=-1)[k] for side in sides)
    far = scenes.sampson(left, right, found.focal[k], rotation, base)
    return np.abs(far) / found.sigma[k]


@cache
def told():
    """Two pairs of two scenes, one in which less moves, and two of one scene, shorter
    ones, cleaned as one table."""
    parts = [
        scenes.two_scenes(2, 50, 40, POINTS, seed=1),
        scenes.two_scenes(1, 60, 20, POINTS, seed=2),
        scenes.photographs(2, 84, 0.5, seed=3),
    ]
    table = join([pair for part in parts for pair in pairs_of(part)])
    return parts, table, clean_ragged(table, Recommended(), plan=PLAN)


def of_pair(k):
    """The decisions about a pair: kept points, those of each rival, and what is told."""
    _, table, found = told()
    rows = slice(*table.begins[k : k + 2])
    pose = np.stack([leaf[k] for leaf in jax.tree.leaves(found.pose)], axis=-1)
    outcome, own = int(found.outcome[k]), float(found.own[k])
    return found.kept[rows], found.rival[rows], outcome, own, found.probability[k], pose


@pytest.mark.parametrize("k", [0, 1])
def test_both_poses_are_told_and_none_is_used(k):
    """Of two halves of a scene: the points and the pose of each, which explains the
    points that were made with it."""
    (both, *_), _, found = told()
    kept, rival, outcome, own, probability, pose = of_pair(k)
    assert found.rival.dtype == bool
    assert outcome == int(OUTCOMES.not_oriented._value)
    assert np.sum(kept & both.good[k]) >= 45 and np.sum(kept) <= 55
    one, none = rival.T
    assert np.sum(one & both.undecidable[k]) >= 25 and not np.any(one & kept)
    assert np.sum(one & ~both.undecidable[k]) <= 3 and not np.any(none)
    assert 0 < own < 1e-9 and 0 < probability[0] < 1e-6 and probability[1] == 1
    assert np.linalg.norm(pose[0, :4]) == pytest.approx(1)
    assert np.mean(distances(pose[0], both, k)[both.undecidable[k]] < 5) > 0.9
    assert np.mean(distances(pose[0], both, k)[both.good[k]] < 5) < 0.4


def test_what_moves_in_a_scene_is_told_beside_its_pose():
    """A pose with three times the points of the other one stands out."""
    (_, moves, _), _, _ = told()
    kept, rival, outcome, own, probability, _ = of_pair(2)
    assert outcome == int(OUTCOMES.finished._value)
    assert np.sum(kept & moves.good[0]) >= 55
    assert np.sum(rival[:, 0] & moves.undecidable[0]) >= 12
    assert own < probability[0] < 1e-3


def test_wrong_matches_of_one_scene_are_no_rival():
    """Half of the matches wrong, among them repeated structure."""
    (*_, scene), _, _ = told()
    for k in (3, 4):
        kept, rival, outcome, own, probability, _ = of_pair(k)
        assert outcome == int(OUTCOMES.finished._value)
        assert np.mean(kept[scene.good[k - 3]]) > 0.9
        assert not np.any(rival) and own == 1 and np.all(probability == 1)


def test_the_result_says_so_where_it_would_be_usable():
    """The rivals are told the strongest first."""
    focal, mask = jnp.asarray(100.0), jnp.ones(8, bool)
    known = nothing_known(focal, mask)
    first, second = mask.at[4:].set(False), mask.at[:5].set(False)
    contest = known.contest._replace(
        own=focal * 0 - 50.0,
        contested=focal > 0,
        accidents=jnp.array([-10.0, -20.0]),
        pose=jnp.stack([jnp.arange(7.0), 10 + jnp.arange(7.0)]),
        use=(first, second),
    )
    rivals = tell_rivals(contest)
    np.testing.assert_array_equal(rivals.mask, [second, first])
    np.testing.assert_allclose(rivals.probability, np.exp([-20.0, -10.0]))
    np.testing.assert_array_equal(rivals.pose.qw, [10.0, 0.0])
    solved = problems.orient(problems.dewitt())
    assert judge_contest(contest, solved).result == RESULTS.several_solutions
    assert judge_contest(known.contest, solved).result == RESULTS.successful
    refused = dataclasses.replace(solved, result=RESULTS.zero_base)
    assert judge_contest(contest, refused).result == RESULTS.zero_base


def test_an_image_pair_of_several_poses_keeps_the_matches_of_all():
    pair = problems.dewitt()
    solved, mask = problems.orient(pair), np.array([1, 1, 1, 1, 0, 0], bool)
    verdict = classification.Verdict(
        mask=jnp.asarray(mask),
        others=jnp.asarray(np.arange(6) == 4),
        pose=solved.pose,
        result=RESULTS.several_solutions,
        outcome=OUTCOMES.not_oriented,
    )
    found = problems.jit(classification.classify)(pair, verdict)
    assert found.kind == classification.Kind.several
    np.testing.assert_array_equal(found.kept, np.arange(6) < 5)


def test_points_that_agree_tell_the_side_of_the_base():
    """Most of the wrong points lie behind both photos of the right pose."""
    rng = np.random.default_rng(0)
    space = rng.uniform(-1, 1, (10, 3)) * (2, 2, 0.5) - (0, 0, 4)
    left = -space[:, :2] / space[:, 2:]
    right = -(space - (1.0, 0, 0))[:, :2] / space[:, 2:]
    crossed = np.arange(10) >= 3
    right[crossed, 0] = 2 * left[crossed, 0] - right[crossed, 0]
    pair = jaxro.pair(*left.T, *right.T, focal=1.0, sigma=1e-3)
    pose = jaxro.RelativePose(*jnp.array([1.0, 0, 0, 0, 1.0, 0, 0]))
    right_ones = jnp.asarray(~crossed)
    np.testing.assert_array_equal(seen(pair, pose, 0.0, right_ones), right_ones)
    np.testing.assert_array_equal(seen(pair, pose, 0.0, pair.mask), ~right_ones)


def test_cells_are_counted_by_the_points_that_hold_them():
    """Against sets in Python."""
    (pair, *_) = pairs_of(scenes.two_scenes(1, 50, 40, POINTS))
    use = np.random.default_rng(1).random(POINTS) < 0.3
    cell = np.asarray(cells(pair))
    there = jnp.asarray(cell), jnp.asarray(use)
    assert np.sum(held_by(*there)) == len(set(cell[use]))
    first = np.flatnonzero(one_of_each(*there))
    wanted = [k for k in np.flatnonzero(use) if cell[k] not in set(cell[:k][use[:k]])]
    assert list(first) == wanted


@pytest.mark.slow
def test_one_program_tells_the_same():
    """Under jit, of a pair of two scenes and one of one."""
    one = jax.jit(Recommended().clean)
    found = pairs_of(scenes.two_scenes(1, 50, 40, POINTS, seed=1))
    found += pairs_of(scenes.photographs(1, POINTS, 0.5, seed=3))
    for pair, result in zip(found, ("several_solutions", "successful"), strict=True):
        here, there = one(pair), Recommended()(pair)
        for each in (here, there):
            assert each.orientation.result == getattr(RESULTS, result)
        np.testing.assert_array_equal(here.mask, there.mask)
        np.testing.assert_array_equal(here.rivals.mask, there.rivals.mask)
        np.testing.assert_allclose(here.rivals.probability, there.rivals.probability)


@pytest.mark.slow
def test_scores_tell_which_pose_stands_out():
    """Scores that are higher in one scene than in the other; where they are the same in
    both, they say nothing."""
    found = scenes.two_scenes(1, 50, 40, POINTS, seed=1)
    (pair,) = pairs_of(found)
    score = np.random.default_rng(0).random(POINTS)
    for more, usable in ((1.0, True), (0.0, False)):
        scored = dataclasses.replace(
            pair, score=jnp.asarray(score + more * found.good[0])
        )
        cleaned = Recommended()(scored)
        assert cleaned.orientation.usable == usable
        assert np.sum(cleaned.rivals.mask[0]) >= 25


@pytest.mark.slow
@pytest.mark.parametrize(("first", "second"), [(40, 40), (50, 40), (60, 20)])
def test_of_a_hundred_pairs(first, second):
    """Of two scenes of about one size two pairs of a hundred may be used; beside a much
    smaller one no pair more is lost than without it."""
    found = scenes.two_scenes(100, first, second, POINTS, seed=5)
    sigma = np.broadcast_to(found.sigma[:, None], found.good.shape)
    pairs = jaxro.pair(*found.coordinates, focal=found.focal, sigma=sigma)
    select = lambda r: (r.orientation.usable, r.outcome == OUTCOMES.no_consensus)
    usable, lost = jaxro.clean_batch(pairs, Recommended(), select=select)
    used = np.sum(usable & ~lost)
    assert used >= 90 if second == 20 else used <= 6
