"""The simulated job is the one that a user does by hand: against plain NumPy, round by
round; its shares against counts."""

import functools

import jax
import numpy as np
import pytest
from gemael import rows_of_net
from scipy import stats

from jaxro.statistics.familywise import largest_tau, largest_w
from jaxro.statistics.promise import promise, repeat_job
from jaxro.statistics.rows import Rows, normalise_rows
from jaxro.xla.programs import compiled

LEVEL, DOUBT, ROUNDS = 0.05, 0.01, 3


@pytest.fixture(scope="module")
def given():
    return rows_of_net()


class Job:
    """By hand: least squares of the rows in use, and the formulas of `explanations`."""

    def __init__(self, design, estimated):
        self.design, self.estimated = design, estimated
        limit = largest_tau if estimated else largest_w

        @functools.cache
        def limit_of(use):
            n = len(use)
            rows = Rows(
                np.zeros(n), design, np.array(use), np.zeros(n, int), np.arange(n)
            )
            return float(compiled(limit)(LEVEL, normalise_rows(rows)))

        self.limit_of = limit_of

    def run(self, e):
        """Rows named first, rows left out, whether all is accepted in the end, the
        errors of the heights, their deviations for sigma0 = 1, sigma0 and freedom."""
        n = len(e)
        use, first = np.ones(n, bool), []
        for turn in range(ROUNDS + 1):
            a, own = self.design[use][:, 1:], np.flatnonzero(use)
            x = np.linalg.lstsq(a, e[use], rcond=None)[0]
            r = e[use] - a @ x
            inverse = np.linalg.inv(a.T @ a)
            left = np.eye(len(own)) - a @ inverse @ a.T
            freedom = len(own) - a.shape[1]
            sigma0 = np.sqrt(r @ r / freedom)
            size = np.diagonal(left)
            tested = size > 1e-6
            root = np.sqrt(np.where(tested, size, 1.0))
            w = np.where(tested, r / root, 0.0)
            rho = left / np.outer(root, root)
            named = []
            unit = sigma0 if self.estimated else 1.0
            if freedom > 0 and np.max(abs(w)) / unit > self.limit_of(tuple(use)):
                worst = int(np.argmax(abs(w)))
                bound = np.full(len(own), stats.norm.isf(DOUBT / 2))
                if self.estimated and freedom > 2:
                    f = freedom - 1
                    t = stats.t.isf(DOUBT / 2, f - 1)
                    rest = np.sqrt(np.maximum(r @ r - w**2, 0) / f)
                    bound = rest * np.sqrt(f) * t / np.sqrt(f - 1 + t**2)
                elif self.estimated:
                    bound[:] = np.inf
                for j in np.flatnonzero(tested):
                    c = rho[worst, j]
                    spread = np.sqrt(max(1 - c**2, 1e-12))
                    near = abs(w[worst] - c * w[j]) <= bound[j] * spread + 1e-6 * abs(
                        w[worst]
                    )
                    if j == worst or near:
                        named.append(int(own[j]))
            if turn == 0:
                first = named
            if len(named) != 1 or turn == ROUNDS:
                break
            use[named] = False
        return first, ~use, not named, x, np.sqrt(np.diagonal(inverse)), sigma0, freedom


def draw(count, n, seed):
    rng = np.random.default_rng(seed)
    e = rng.normal(size=(count, n))
    planted = np.zeros((count, n), bool)
    planted[np.arange(count), rng.integers(0, n, count)] = True
    return e + np.where(planted, 7.0 * rng.choice([-1, 1], (count, 1)), 0), planted


@pytest.mark.parametrize(
    "estimated", [False, pytest.param(True, marks=pytest.mark.slow)]
)
def test_every_repetition_is_the_job_by_hand(given, estimated):
    errors, _ = draw(60, 16, 3)
    found = repeat_job(given, errors, level=LEVEL, estimated=estimated, rounds=ROUNDS)
    job = Job(given.design, estimated)
    kinds = set()
    for k, e in enumerate(errors):
        first, out, accepted, x, spread, sigma0, freedom = job.run(e)
        kinds.add(min(len(first), 2))
        assert np.flatnonzero(found.named[k]).tolist() == first
        np.testing.assert_array_equal(found.left_out[k], out)
        assert found.accepted[k] == accepted
        width = stats.t.isf(0.025, freedom)
        np.testing.assert_array_equal(found.known[k], abs(x) <= 1.959964 * spread)
        np.testing.assert_array_equal(
            found.estimated[k], abs(x) <= width * sigma0 * spread
        )
    assert kinds == {0, 1, 2}


@pytest.mark.slow
@pytest.mark.parametrize("estimated", [False, True])
def test_shares_are_those_of_counts(given, estimated):
    """To 2 %, of 8,000 jobs by hand with other draws: 2.8 standard deviations."""
    found = promise(
        given,
        jax.random.key(1),
        size=7.0,
        level=LEVEL,
        estimated=estimated,
        repetitions=20000,
    )
    checked = np.asarray(normalise_rows(given).tested)
    assert np.all(checked)
    errors, planted = draw(8000, 16, 8)
    job = Job(given.design, estimated)
    number, hit, accepted, exactly, cleared, held = [], [], [], [], [], []
    for e, wrong in zip(errors, planted, strict=True):
        first, out, fine, x, spread, _, _ = job.run(e)
        number.append(len(first))
        hit.append(bool(np.any(wrong[first])))
        accepted.append(fine)
        exactly.append(fine and np.array_equal(out, wrong))
        cleared.append(not np.any(wrong & ~out))
        held.append(abs(x) <= 1.959964 * spread)
    number, hit, accepted, held = map(np.array, (number, hit, accepted, held))
    shares = [
        (found.fits.said, np.mean(number == 0)),
        (found.named.said, np.mean(number == 1)),
        (found.named.right, np.mean(hit[number == 1])),
        (found.several.said, np.mean(number > 1)),
        (found.accepted, np.mean(accepted)),
        (found.exactly_right, np.mean(exactly)),
        (found.without_wrong, np.mean(np.array(cleared)[accepted])),
        *zip(found.known, np.mean(held[accepted], axis=0), strict=True),
    ]
    for one, other in shares:
        assert one == pytest.approx(other, abs=0.02)


def test_without_errors_the_level_and_the_intervals_hold(given):
    found = promise(given, jax.random.key(2), wrong=0, level=LEVEL, repetitions=2000)
    assert found.fits.said == pytest.approx(1 - LEVEL, abs=0.015)
    assert found.fits.right == 1.0 and found.named.right == 0.0
    np.testing.assert_allclose(found.known, 0.95, atol=0.02)
    np.testing.assert_allclose(found.estimated, 0.95, atol=0.02)
