"""Pairs of every length together: the same results as one by one, and the least
padding."""

from itertools import combinations

import jax
import numpy as np
import problems
import pytest

import jaxro
from jaxro import Pair
from jaxro.batches import padding, ragged
from jaxro.geometry import mock_pairs
from jaxro.rejection import PROCEDURES

LENGTHS = [6, 9, 3, 12, 9, 5, 8, 7, 12, 9]


@pytest.fixture(scope="module")
def pairs() -> list[Pair]:
    """Near-vertical pairs of several lengths, every third in another position, one with
    a number missing."""
    key = jax.random.key(3)
    anywhere = jax.tree.map(
        np.asarray, mock_pairs.random_pairs(key, len(LENGTHS), 12, focal=100.0)[0]
    )
    near = jax.tree.map(
        lambda a: a[:12] if np.ndim(a) else a,
        jax.tree.map(np.asarray, problems.tilted()),
    )
    out = []
    for i, n in enumerate(LENGTHS):
        whole = jax.tree.map(lambda a, i=i: a[i], anywhere) if i % 3 == 2 else near
        out.append(
            jax.tree.map(lambda a, n=n: np.array(a[:n]) if np.ndim(a) else a, whole)
        )
    out[4].x_left[2] = np.nan
    return out


@pytest.fixture(scope="module")
def together(pairs):
    return ragged.join(pairs)


PLAN = padding.Plan((8, 12), (4, 4), (12,))


@pytest.mark.slow
def test_ragged_equals_one_by_one(pairs, together):
    told = []
    found = ragged.orient_ragged(
        together, plan=PLAN, progress=lambda done, total: told.append((done, total))
    )
    assert told[-1] == (10, 10) and [done for done, _ in told] == sorted(
        done for done, _ in told
    )
    for i, one in enumerate(pairs):
        alone = problems.orient(jaxro.pad(jax.tree.map(jax.numpy.asarray, one), 12))
        rows = slice(*together.begins[i : i + 2])
        assert int(found.result._value[i]) == int(alone.result._value)
        if bool(alone.usable):
            names = ("qw", "qx", "qy", "qz", "bx", "by", "bz")
            np.testing.assert_allclose(
                [getattr(found.pose, name)[i] for name in names],
                [getattr(alone.pose, name) for name in names],
                atol=1e-12,
            )
            for name in ("parallax", "residuals", "redundancy"):
                np.testing.assert_allclose(
                    getattr(found, name)[rows],
                    getattr(alone, name)[: LENGTHS[i]],
                    atol=1e-11,
                )


@pytest.mark.slow
@pytest.mark.parametrize(
    ("length", "size"), [(8, 8), (7, 8), pytest.param(8, 12, marks=pytest.mark.slow)]
)
def test_pairs_of_one_length(pairs, length, size):
    """One of them in any position; where they have the size of a batch there is nothing
    to put in order."""
    even = [
        jax.tree.map(lambda a: a[:length] if np.ndim(a) else a, pair)
        for pair in (pairs[i] for i in (3, 1, 8, 9))
    ]
    found = ragged.orient_ragged(
        ragged.join(even), plan=padding.Plan((size,), (4,), (12,))
    )
    both = ragged.orient_ragged(
        ragged.join([*even, pairs[6]]), plan=PLAN
    )  # with another one: in another way
    assert np.all(found.usable) and len(found.parallax) == 4 * length
    np.testing.assert_allclose(found.pose.qw, both.pose.qw[:4], atol=1e-12)
    np.testing.assert_allclose(found.parallax, both.parallax[: 4 * length], atol=1e-11)
    kept = ragged.clean_ragged(
        ragged.join(even),
        PROCEDURES["worst-point"],
        plan=padding.Plan((size,), (4,), (12,)),
    ).kept
    assert kept.shape == (4 * length,)


def test_what_is_no_list_of_pairs_is_refused(pairs):
    with pytest.raises(ValueError, match="single pairs are wanted"):
        ragged.join(
            [jaxro.stack([jax.tree.map(jax.numpy.asarray, one) for one in pairs])]
        )
    nothing = ragged.Ragged(
        np.zeros(1, int), *np.zeros((5, 0)), np.zeros(0, bool), np.zeros(0), np.zeros(0)
    )
    for call in (
        ragged.orient_ragged,
        lambda none: ragged.clean_ragged(none, PROCEDURES["tau"]),
    ):
        with pytest.raises(ValueError, match="no pairs"):
            call(nothing)


def test_what_would_leave_results_unwritten_is_refused(together):
    near = {"plan": PLAN, "start": jaxro.starts.Vertical()}
    short = padding.Plan((8,), (4,), (8,))
    with pytest.raises(ValueError, match=r"up to 8 points, but pair 3 has 12"):
        ragged.orient_ragged(together, plan=short)
    with pytest.raises(ValueError, match=r"up to 8 points, but pair 3 has 12"):
        ragged.clean_ragged(together, PROCEDURES["tau"], plan=short)
    with pytest.raises(TypeError, match="no option 'chunk'"):
        ragged.orient_ragged(together, chunk=3)
    with pytest.raises(
        ValueError,
        match=r"points on its first axis, 12 of them here, .* shape \(3, 12\)",
    ):
        ragged.orient_ragged(
            together, **near, read=lambda pair, o: (None, jax.numpy.stack(o.model))
        )


@pytest.mark.slow
def test_cleaning_equals_one_by_one(pairs, together):
    procedure = PROCEDURES["worst-point"]
    found = ragged.clean_ragged(together, procedure, plan=PLAN)
    batch = jaxro.stack([jax.tree.map(jax.numpy.asarray, one) for one in pairs])
    alone = problems.jit(jax.vmap(procedure))(batch)
    np.testing.assert_array_equal(found.outcome, alone.outcome._value)
    flat = lambda values: np.concatenate(
        [np.asarray(values)[i, :n] for i, n in enumerate(LENGTHS)]
    )
    np.testing.assert_array_equal(found.kept, flat(alone.mask))
    np.testing.assert_array_equal(found.order, flat(alone.order))


@pytest.fixture
def every_step(monkeypatch):
    """The sizes of users, where other tests have fewer."""
    monkeypatch.setattr(padding, "steps", padding.steps.__wrapped__)


@pytest.mark.usefixtures("every_step")
@pytest.mark.parametrize("longest", [2_000, 10_000])
def test_padding_of_any_lengths_stays_under_a_quarter(longest):
    lengths = np.exp(
        np.random.default_rng(0).uniform(np.log(5), np.log(longest), 100_000)
    ).astype(int)
    sizes = np.array(padding.sizes(lengths))
    padded = sizes[np.searchsorted(sizes, lengths)]
    assert len(sizes) <= padding.SIZES and np.all(padded >= lengths)
    assert 1 - lengths.sum() / padded.sum() < 0.25


@pytest.mark.usefixtures("every_step")
def test_sizes_have_the_least_padding():
    rng = np.random.default_rng(1)
    lengths = rng.choice(
        [8, 11, 14, 20, 33, 50, 64, 90], 500_000, p=rng.dirichlet(np.ones(8))
    )
    known = [size for size in padding.steps(90) if size <= 96]

    def cost(sizes):
        return np.sum(
            np.array(sizes)[np.searchsorted(sizes, lengths)]
        ) + padding.CHEAP * (len(sizes) - 1)

    every = [(*some, 96) for k in range(3) for some in combinations(known[:-1], k)]
    assert cost(padding.sizes(lengths, 3)) == min(map(cost, every))
    assert padding.sizes(np.array([6, 7, 20])) == (20,)
    assert padding.sizes(np.zeros(0, int)) == (8,)
