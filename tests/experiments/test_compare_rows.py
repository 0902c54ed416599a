"""Comparison of procedures on a net of levelling: what is known of it otherwise."""

import zlib

import jax
import numpy as np
import pytest
from gemael import rows_of_net

from jaxro.adjustment import losses
from jaxro.experiments.compare_rows import compare_rows
from jaxro.experiments.row_procedures import ROW_PROCEDURES, Reweighting
from jaxro.statistics.promise import draw_errors, orthonormal, repeat_job

TRIALS = 300


@pytest.fixture(scope="module")
def given():
    return rows_of_net()


@pytest.mark.slow
def test_levels_and_the_scores_of_named_sets(given):
    """Without errors the level is that of every procedure; the scores of one that the
    promise simulates are its shares, by the same draws."""
    names = ("data-snooping", "named-sets", "huber")
    chosen = {name: ROW_PROCEDURES[name] for name in names}
    scores = compare_rows(
        "net", given, chosen, errors=(0, 1), sizes=(8.0,), trials=TRIALS, level=0.05
    )
    of = {(s.setting.errors, s.procedure): s for s in scores}
    for name in names:
        value, error = of[0, name].noticed
        assert abs(value - 0.05) < 4 * error, name
        assert np.isnan(of[0, name].found.value)
        assert of[0, name].off.value == pytest.approx(1, abs=0.06)
    both = of[1, "named-sets"], of[1, "data-snooping"]
    assert both[0].noticed == both[1].noticed  # one test, and the same trials
    assert both[0].misnamed.value < both[1].misnamed.value
    assert both[0].undecided.value > both[1].undecided.value
    assert of[1, "huber"].undecided.value == 0
    p = both[0].exactly.value
    assert both[0].exactly.error == pytest.approx(np.sqrt(p * (1 - p) / (TRIALS - 1)))


def test_scores_are_counts(given):
    """By hand of the rows that the job leaves out."""
    (score,) = compare_rows(
        "net",
        given,
        {"named-sets": ROW_PROCEDURES["named-sets"]},
        errors=(1,),
        sizes=(8.0,),
        trials=TRIALS,
    )
    key = jax.random.fold_in(jax.random.key(0), zlib.crc32(b"1 8.0"))
    errors, wrong = draw_errors(given, key, 1, 8.0, TRIALS)
    trials = repeat_job(given, errors, level=0.05, rounds=4)
    exactly = [
        bool(done) and out.tolist() == own.tolist()
        for done, out, own in zip(trials.accepted, trials.left_out, wrong, strict=True)
    ]
    assert score.exactly.value == pytest.approx(np.mean(exactly))
    assert score.among.value == pytest.approx(np.mean(np.sum(trials.named & wrong, 1)))
    away = []
    for e, out in zip(errors, trials.left_out, strict=True):
        design = given.design[:, 1:]
        x = np.linalg.lstsq(design[~out], e[~out], rcond=None)[0]
        away.append(np.sum((design @ x) ** 2) / design.shape[1])
    assert score.off.value == pytest.approx(np.sqrt(np.mean(away)), rel=1e-9)


@pytest.mark.parametrize(
    ("loss", "weigh"),
    [
        (losses.Huber(), lambda r: 1.345 / np.maximum(np.abs(r), 1.345)),
        (losses.Cauchy(), lambda r: 1 / (1 + (r / 2.385) ** 2)),
    ],
)
def test_reweighting_ends_where_the_sum_of_the_loss_is_least(given, loss, weigh):
    """Its gradient vanishes; by plain iterations of each trial."""
    errors, _ = draw_errors(given, jax.random.key(3), 2, 9.0, 20)
    statistic = Reweighting(loss)._statistic(given, errors)
    q, _ = orthonormal(given)
    root = np.sqrt(1 - np.sum(q**2, axis=1))
    size = statistic * root
    for e, r in zip(errors, size, strict=True):
        fit = _refine(q, e, weigh)
        np.testing.assert_allclose(np.abs(e - q @ fit), r, atol=1e-3)


def _refine(q, e, weigh):
    """Plain iterated weights of one trial."""
    x = q.T @ e
    for _ in range(500):
        r = e - q @ x
        w = weigh(r)
        x = np.linalg.solve(q.T @ (w[:, None] * q), q.T @ (w * e))
    r = e - q @ x
    np.testing.assert_allclose(q.T @ (weigh(r) * r), 0, atol=1e-6)
    return x
