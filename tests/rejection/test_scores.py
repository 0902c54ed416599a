"""Scores of matches: carried with their points from every input, the order of the search,
and evidence for what is kept."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scenes
from scipy.stats import mannwhitneyu

import jaxro
from jaxro.batches.ragged import concatenate, join
from jaxro.geometry.elements import vertical
from jaxro.geometry.pairs import mask_unusable, pad, stack, swapped, unstack
from jaxro.rejection import Recommended
from jaxro.rejection.evidence import z_of_scores
from jaxro.rejection.search import Search, nothing_found
from jaxro.tables import csv
from jaxro.tables.measured import one_pair, to_ragged

POINTS = 100
WRONG = 0.8


def test_the_ranks_are_those_of_mann_and_whitney():
    """With ties; points without a score or that take no part count for nothing."""
    rng = np.random.default_rng(3)
    score = np.round(rng.normal(size=60), 1)
    use, others = rng.random(60) < 0.4, rng.random(60) < 0.5
    others &= ~use
    score[5:9] = np.nan
    known = np.isfinite(score)
    a, b = score[use & known], score[others & known]
    u = mannwhitneyu(a, b, use_continuity=False, method="asymptotic").statistic
    k, m = len(a), len(b)
    wanted = (u - k * m / 2) / np.sqrt(k * m * (k + m + 1) / 12)
    z = z_of_scores(*map(jnp.asarray, (score, use, others)))
    np.testing.assert_allclose(z, wanted, atol=1e-12)
    nobody = z_of_scores(*map(jnp.asarray, (score, use, others & False)))
    assert float(nobody) == 0


def scored(count, first=1.0):
    """A pair of so many points, each with its own score."""
    x = np.arange(count) + first
    return jaxro.pair(x, x + 1, x + 2, x + 3, focal=100, score=10 * x)


def is_carried(pair):
    """Whether each point that takes part has the score that belongs to it."""
    x = np.minimum(pair.x_left, pair.x_right)
    own = np.asarray(pair.mask)
    return np.array_equal(np.asarray(pair.score)[own], 10 * np.asarray(x)[own])


def test_scores_stay_with_their_points():
    """Padded, stacked, taken apart, swapped, one behind the other, without a bad point;
    beside pairs without scores they are unknown there, and other pairs stay as they
    are."""
    one, other = scored(6), scored(4, 20.0)
    plain = jaxro.pair(*np.ones((4, 3)), focal=100)
    assert plain.score is None and pad(plain, 8).score is None
    assert mask_unusable(plain)[0].score is None
    assert is_carried(pad(one, 9)) and is_carried(swapped(one))
    assert is_carried(mask_unusable(one)[0])
    batch = stack([one, other, plain])
    first, second, third = unstack(batch)
    assert is_carried(first) and is_carried(second)
    assert np.all(np.isnan(third.score))
    flat = concatenate([join([one, other]), join([plain])])
    assert is_carried(one_pair(flat, 0)) and is_carried(one_pair(flat, 1))
    assert np.all(np.isnan(one_pair(flat, 2).score))
    assert is_carried(jax.tree.map(lambda a: a[0], flat.pad_to(np.array([0, 1]), 6)))
    assert one_pair(join([plain, plain]), 1).score is None


def test_a_column_of_a_table_is_the_score():
    head = "pair,point,x_left,y_left,x_right,y_right,score"
    text = f"{head}\na,1,1,2,3,4,.5\nb,1,5,6,7,8,-2\na,2,9,8,7,6,.25\n"
    table = csv.parse(text, "file", "unused")
    camera = jaxro.Camera(100.0)
    pairs = to_ragged(table, (camera, camera))
    assert pairs.score.tolist() == [0.5, 0.25, -2]
    plain = csv.parse(text.replace(",score", ",sigma").replace("-2", "2"), "file", "")
    assert to_ragged(plain, (camera, camera)).score is None


@pytest.mark.parametrize("score", [np.ones(3), 1j * np.ones(4)])
def test_scores_that_do_not_fit_are_refused(score):
    with pytest.raises(ValueError, match="score"):
        jaxro.pair(*np.ones((4, 4)), focal=1, score=score)


def test_the_search_begins_with_the_highest_scores():
    """A fifth of the matches are true, and have the highest scores: the third block, which
    is drawn by them, meets a far better orientation in three pairs of six or more; where
    scores say the opposite the first blocks meet it by chance alone."""
    found = scenes.photographs(6, POINTS, WRONG, "sideways", seed=4)
    search = Search(count=192)
    sigma = np.broadcast_to(found.sigma[:, None], found.good.shape)
    pair = lambda score: jaxro.pair(
        *found.coordinates, focal=found.focal, sigma=sigma, score=score
    )

    @jax.jit
    def met(pairs):
        def one(pair):
            none = pair.focal_left * 0
            begin = nothing_found(vertical(none))._replace(enough=none + 1e9)
            return search.run(pair, begin).cost

        return jax.lax.map(one, pairs)

    high = np.asarray(met(pair(1.0 * found.good)))
    low = np.asarray(met(pair(-1.0 * found.good)))
    assert np.sum(high < low - 10) >= 3 and not np.any(low < high - 10)


@pytest.mark.slow
def test_pairs_with_scores_are_cleaned():
    """Scores that tell right from wrong lose no pair, and reject nothing themselves."""
    found = scenes.photographs(4, POINTS, 0.6, "sideways", seed=6)
    sigma = np.broadcast_to(found.sigma[:, None], found.good.shape)
    pairs = jaxro.pair(
        *found.coordinates, focal=found.focal, sigma=sigma, score=1.0 * found.good
    )
    read = lambda r: (r.orientation.usable, r.mask)
    usable, mask = jaxro.clean_batch(pairs, Recommended(), select=read)
    assert np.all(usable)
    assert np.mean(np.asarray(mask)[found.good]) > 0.9
