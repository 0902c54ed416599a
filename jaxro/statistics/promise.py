"""What the verdicts and intervals of an adjustment are worth, by simulation of the whole
job: test, name, leave out, adjust again, decide.

In every repetition all rows get normal errors of standard deviation 1, and some, drawn at
random, an error of a given size in addition. The job is that of a user who follows the
report. The largest |w| (|tau|, where sigma0 is estimated) is compared with the value that
it exceeds with the probability `level`, by the correlations of the rows in use. If it
exceeds it, and one row alone explains the misfit (`explanations`), this row is left out,
and the rest is adjusted and tested again; if several rows do, the job ends undecided.

Everything is linear. With orthonormal columns Q that span the design, the estimates are
T Qᵀ e. Without a row q of Q both are those of

    M = I + c q qᵀ,    c = (1 / sqrt(1 - |q|²) - 1) / |q|²,

that is, the rest of Q M, which is orthonormal again, and T M.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, ScalarLike

from ..adjustment import critical_values as critical
from ..xla.programs import compiled
from .explanations import DOUBT, misfit
from .familywise import largest_tau
from .identification import critical_w
from .normalised import Normalised, normalise
from .rows import SMALL, Rows

TOGETHER = 16
"""Repetitions that are computed at once."""


class Verdict(NamedTuple):
    """How often something is said, and how often it is right of these; NaN where it is
    never said."""

    said: float
    right: float


class Promise(NamedTuple):
    """Shares of the `repetitions`, from 0 to 1.

    The first verdict: `fits`, nothing is wrong; `named`, one row is; `several`, one of
    several is. After all rounds: `accepted`, no test rejects any more;
    `exactly_right`, this with just the wrong rows left out. Of the accepted ones
    (NaN, if there are none): `without_wrong`, no wrong row is left; and for each
    function how often its interval of the `confidence` holds the truth: `known`, with
    sigma0 = 1; `estimated`, with sigma0 of the rows in use and Student's t; `reported`,
    with sigma0 only where it is larger than chance allows.

    A share p of n has the standard deviation sqrt(p (1 - p) / n).
    """

    fits: Verdict
    named: Verdict
    several: Verdict
    accepted: float
    exactly_right: float
    without_wrong: float
    known: Float[np.ndarray, " function"]
    estimated: Float[np.ndarray, " function"]
    reported: Float[np.ndarray, " function"]
    confidence: float
    repetitions: int


class Trials(NamedTuple):
    """All repetitions: the rows named by the first verdict, the rows left out, whether
    no test rejects in the end, and which intervals hold the truth."""

    named: Bool[np.ndarray, "repetition row"]
    left_out: Bool[np.ndarray, "repetition row"]
    accepted: Bool[np.ndarray, " repetition"]
    known: Bool[np.ndarray, "repetition function"]
    estimated: Bool[np.ndarray, "repetition function"]
    reported: Bool[np.ndarray, "repetition function"]


def promise(
    given: Rows,
    key: PRNGKeyArray,
    *,
    wrong: int = 1,
    size: float = 6.0,
    functions: Float[np.ndarray, "function p"] | None = None,
    level: ScalarLike = 0.05,
    estimated: bool = False,
    confidence: float = 0.95,
    repetitions: int = 1000,
) -> Promise:
    """`Promise` of the rows of a solution.

    `wrong` rows of those that others check have an error of `size` standard deviations,
    of any sign. `functions`: linear ones of the parameters, that the rows determine; all
    parameters that they depend on, if None. `estimated`: sigma0 is not known.
    """
    errors, planted = draw_errors(given, key, wrong, size, repetitions)
    trials = repeat_job(
        given,
        errors,
        functions=functions,
        level=level,
        estimated=estimated,
        confidence=confidence,
        rounds=wrong + 2,
    )
    return _conclude(trials, planted, confidence)


def draw_errors(
    given: Rows, key: PRNGKeyArray, wrong: int, size: float, repetitions: int
) -> tuple[Float[np.ndarray, "repetition row"], Bool[np.ndarray, "repetition row"]]:
    """Errors of all rows, and in which there is one of this size in addition."""
    of_noise, of_places, of_signs = jax.random.split(key, 3)
    shape = repetitions, len(given.use)
    noise = np.asarray(jax.random.normal(of_noise, shape, float))
    score = np.asarray(jax.random.uniform(of_places, shape, float))
    q, _ = orthonormal(given)
    checked = given.use & (1 - np.sum(q**2, axis=1) > critical.UNTESTABLE)
    rank = np.argsort(np.argsort(np.where(checked, score, 2.0), axis=1), axis=1)
    planted = checked & (rank < wrong)
    sign = np.where(jax.random.bernoulli(of_signs, shape=shape), 1.0, -1.0)
    return noise + np.where(planted, size * sign, 0.0), planted


def repeat_job(
    given: Rows,
    errors: Float[np.ndarray, "repetition row"],
    *,
    functions: Float[np.ndarray, "function p"] | None = None,
    level: ScalarLike = 0.05,
    estimated: bool = False,
    familywise: bool = True,
    doubt: ScalarLike = DOUBT,
    confidence: float = 0.95,
    rounds: int = 3,
) -> Trials:
    """The job with these errors of the rows; at most so many `rounds` leave a row out.
    `familywise`, `doubt`: as in `identification.identify`; only w has a level of each
    test."""
    q, t = orthonormal(given)
    if functions is None:
        functions = np.eye(len(t))[np.any(given.design[given.use] != 0, axis=0)]
    freedom = np.sum(given.use) - q.shape[1] - np.arange(len(q) + 1)
    widths = critical.half_width(confidence, freedom)
    found = _repeat(
        q,
        functions @ t,
        np.asarray(given.use),
        errors,
        np.asarray(widths),
        np.asarray(rounds),
        level=level,
        normal=float(critical.normal(1 - confidence)),
        doubt=doubt,
        estimated=estimated,
        familywise=familywise,
    )
    return Trials(*(np.asarray(part) for part in found))


def orthonormal(
    given: Rows,
) -> tuple[Float[np.ndarray, "row rank"], Float[np.ndarray, "p rank"]]:
    """Q and T: the estimates of the parameters are T Qᵀ e, of all that leave the rows
    the same those of least length in the scaled parameters."""
    use = given.use
    length = np.linalg.norm(given.design[use], axis=0)
    length = np.where(length > 0, length, 1.0)
    left, size, right = np.linalg.svd(given.design[use] / length, full_matrices=False)
    there = size > SMALL * np.max(size, initial=0.0)
    q = np.zeros((len(use), int(np.sum(there))))
    q[use] = left[:, there]
    return q, (right[there] / size[there, None]).T / length[:, None]


class _State(NamedTuple):
    """Q, T and the rows in use; the number of rows left out, and whether the last test
    left nothing to do."""

    q: Float[Array, "row rank"]
    t: Float[Array, "function rank"]
    use: Bool[Array, " row"]
    out: Int[Array, ""]
    ended: Bool[Array, ""]
    accepted: Bool[Array, ""]


@compiled(static=("estimated", "familywise"))
def _repeat(
    q: Float[Array, "row rank"],
    t: Float[Array, "function rank"],
    use: Bool[Array, " row"],
    errors: Float[Array, "repetition row"],
    widths: Float[Array, " number"],
    rounds: Int[Array, ""],
    *,
    level: ScalarLike,
    normal: ScalarLike,
    doubt: ScalarLike,
    estimated: bool,
    familywise: bool,
) -> tuple[Array, ...]:
    """The fields of `Trials`."""
    no, none = jnp.asarray(False), jnp.asarray(0)
    start = _State(q, t, use, none, no, no)

    def test(known: Normalised) -> Bool[Array, " row"]:
        of_w = lambda: critical_w(known, level, familywise)
        limit = largest_tau(level, known) if estimated else of_w()
        return misfit(known, limit, doubt, estimated)[1]

    def job(e: Float[Array, " row"]) -> tuple[Array, ...]:
        # the first round is one for all: its limit is computed once
        state, named = _round(start, e, test, rounds)
        state = lax.while_loop(
            lambda state: ~state.ended,
            lambda state: _round(state, e, test, rounds)[0],
            state,
        )
        known = _normalised(state, e)
        away = jnp.abs(state.t @ (state.q.T @ e))
        spread = jnp.sqrt(jnp.sum(state.t**2, axis=1))
        sigma0 = jnp.sqrt(known.squares / jnp.maximum(known.freedom, 1.0))
        own = jnp.arange(len(widths)) == state.out
        width = jnp.sum(jnp.where(own, widths, 0.0))
        unit = critical.trusted_sigma0(sigma0, known.freedom)
        return (
            named,
            use & ~state.use,
            state.accepted,
            away <= normal * spread,
            away <= width * sigma0 * spread,
            away <= normal * unit * spread,
        )

    return lax.map(job, errors, batch_size=TOGETHER)


def _round(
    state: _State,
    e: Float[Array, " row"],
    test: Callable[[Normalised], Array],
    rounds: Int[Array, ""],
) -> tuple[_State, Bool[Array, " row"]]:
    """One test; a row that is named alone is left out. The rows that are named."""
    named = test(_normalised(state, e))
    number = jnp.sum(named)
    goes_on = (number == 1) & ~state.ended & (state.out < rounds)
    alone = named & goes_on
    row = jnp.sum(jnp.where(alone[:, None], state.q, 0.0), axis=0)
    square = jnp.sum(row**2)
    some = square > 0
    left = jnp.sqrt(jnp.maximum(1 - square, critical.UNTESTABLE))
    factor = jnp.where(some, (1 / left - 1) / jnp.where(some, square, 1.0), 0.0)
    turn = lambda a: a + factor * (a @ row)[:, None] * row[None, :]
    following = _State(
        q=jnp.where(alone[:, None], 0.0, turn(state.q)),
        t=turn(state.t),
        use=state.use & ~alone,
        out=state.out + goes_on.astype(state.out.dtype),
        ended=state.ended | ~goes_on,
        accepted=jnp.where(state.ended, state.accepted, number == 0),
    )
    return following, named


def _normalised(state: _State, e: Float[Array, " row"]) -> Normalised:
    residuals = e - state.q @ (state.q.T @ e)
    residuals = jnp.where(state.use, residuals, 0.0)
    return normalise(residuals, list(state.q.T), state.use, jnp.sum(residuals**2))


def _conclude(
    trials: Trials, planted: Bool[np.ndarray, "repetition row"], confidence: float
) -> Promise:
    number, hit = np.sum(trials.named, axis=1), np.any(trials.named & planted, axis=1)
    nothing = ~np.any(planted, axis=1)
    exactly = np.all(trials.left_out == planted, axis=1)
    cleared = ~np.any(planted & ~trials.left_out, axis=1)
    of_accepted = lambda part: _mean(part[trials.accepted])
    return Promise(
        fits=_verdict(number == 0, nothing),
        named=_verdict(number == 1, hit),
        several=_verdict(number > 1, hit),
        accepted=float(np.mean(trials.accepted)),
        exactly_right=float(np.mean(exactly & trials.accepted)),
        without_wrong=float(of_accepted(cleared)),
        known=of_accepted(trials.known),
        estimated=of_accepted(trials.estimated),
        reported=of_accepted(trials.reported),
        confidence=confidence,
        repetitions=len(planted),
    )


def _verdict(
    said: Bool[np.ndarray, " repetition"], right: Bool[np.ndarray, " repetition"]
) -> Verdict:
    return Verdict(float(np.mean(said)), float(_mean(right[said])))


def _mean(part: np.ndarray) -> np.ndarray:
    """Of every column; NaN of nothing."""
    if len(part) == 0:
        return np.full(part.shape[1:], np.nan)
    return np.asarray(np.mean(part, axis=0))
