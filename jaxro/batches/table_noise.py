"""The standard deviation of the coordinates of a table, from its own residuals, in
spite of wrong points.

Nothing has to be known beforehand. Of at most PAIRS pairs, evenly spread, and at most
POINTS points of each:

1. The first value (`_begin`): `Recommended(known=False)` finds the poses of some pairs
   from each of many standard deviations, in steps of 2. At these poses the evidence for
   a trial standard deviation s is the logarithm of the likelihood of

       density of |r| = a 2/s phi(r/s) + (1 - a) / R,    R = f / 25,

   over the likelihood of wrong points alone, 1 / R, with a fitted to each pair. Five
   points fit any pose, so that five count as wrong ones. The sum over the pairs
   chooses: of few points among many wrong ones a search finds noise of about the size
   with which it begins, and only all pairs together tell which size is right.
2. From there (`_repeat`): the poses of all pairs, `noise_of` each, and `pooled`. This
   is repeated with the value found until it no longer changes.

A pair without enough evidence for its pose takes no part.
"""

import math
from collections.abc import Iterable
from typing import Any, NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..geometry.pairs import Pair, double, mask_unusable
from ..rejection import Noise, Recommended, noise_of, pooled
from ..rejection.agreement import squares
from ..rejection.noise import PARAMETERS
from ..rejection.search import Search
from ..rejection.thorough import Thorough
from ..xla.passes import count, total
from .batch import map_batch
from .padding import sizes
from .ragged import Ragged, join

PAIRS, POINTS = 256, 128
"""Pairs that are looked at, at most, and points of each: a table of 16 points tells its
noise to 1.5 % by then."""

BLOCK, CHUNK = 64, 8
"""Pairs of a call, so that every call is the same program, and of a search."""

STARTS = tuple(2.0**k / 3000 for k in range(1, -8, -1))
"""First standard deviations, as parts of the focal length: 0.1 mm to 0.4 µm of 150
mm."""

PASSED = 16.0
"""How far below the likeliest trial the starts end: searches that begin too small find
nothing, and take longest."""

FINENESS = 2
"""Trial standard deviations to each start, from twice the first on."""

FIELD = 0.04
"""The part of the focal length over which the distances of wrong points are spread: 6
mm of 150. Taken too wide, wrong points near the right ones look like noise."""

EVIDENCE, TOGETHER = 3.0, 10.0
"""Logarithm of the likelihood ratio from which a pair takes part, and by how much n
pairs must exceed that on the average, times sqrt(n): of eight right points among
sixteen a single pair tells nothing, twenty do."""

STEPS, AGREES, DRIFTS = 4, 0.05, 2.0
"""How often the poses are found anew at most, the change of log sigma at which that
ends, and the ratio to the first value beyond which nothing is believed: a noise that
follows the search is no noise."""

FINDER = Recommended(known=False, stages=(Thorough(search=Search(count=2048)),))
"""Enough subsets for two thirds of wrong points. Pairs that need more can be left out;
searches that begin far from the noise would go on to their end."""

TELLING = 0.5
"""Share of the pairs that have to tell their noise: where fewer do, they are the pairs
with the least noise."""

LARGEST_SHARE, SMALLEST_SHARE, SHARE_STEPS = 0.999, 0.01, 20
"""Bounds of a, and the steps of EM by which it is found."""

Pairs = TypeVar("Pairs", Pair, Ragged)


class TableNoise(NamedTuple):
    """The noise of a table.

    `sigma`: the factor of the standard deviations of its pairs. Those of a pair that
    states none are 1, so that it is in the unit of the coordinates. `deviation`: its
    standard deviation. `pairs`: how many pairs tell their noise by their residuals, of
    so many that were `asked`.
    """

    sigma: float
    deviation: float
    pairs: int
    asked: int

    def applied(self, pairs: Pairs) -> Pairs:
        """The same pairs with this noise as their standard deviations."""
        return _with_sigma(pairs, np.asarray(pairs.sigma) * self.sigma)


def estimate(pairs: Pair | Ragged | Iterable[Pair]) -> TableNoise:
    """The noise of pairs of one camera: a batch, `Ragged` pairs, single pairs in a
    list, or one pair.

    Different standard deviations within `pairs` stay in their ratios. Raises ValueError
    where no pair tells: fewer than six points everywhere, or too few points that agree
    with a pose to be no accident, or this in most of the pairs.
    """
    chosen = _sample(pairs)
    if chosen is None:
        raise ValueError(
            "no pair has six points or more, which would show the noise: state the "
            "standard deviation"
        )
    parts = _blocks(chosen)
    # the starts are the same for all pairs
    unit = float(np.median(_focal_in_sigma(jax.device_put(chosen))))
    noises, telling = _repeat(parts, _begin(parts[0], unit))
    told, of = int(telling.sum()), len(telling)
    if told == 0:
        raise ValueError(
            "the residuals tell no noise: not enough points agree with one pose of "
            "their pair; state the standard deviation"
        )
    if told < TELLING * of:
        raise ValueError(
            f"only {told} of {of} pairs have enough points that agree to "
            "tell their noise, and those with "
            "the least noise are the first to: state the standard deviation"
        )
    noise = _pool(noises, telling)
    return TableNoise(float(noise.sigma), float(noise.deviation), told, of)


def _blocks(chosen: Pair) -> list[Pair]:
    """The pairs in blocks of equal size, at most BLOCK; some of the last are left
    out."""
    asked = len(chosen.x_left)
    blocks = -(-asked // BLOCK)
    size = asked // blocks
    block = lambda k: jax.tree.map(lambda a: a[k::blocks][:size], chosen)
    return [block(k) for k in range(blocks)]


class _Residuals(NamedTuple):
    """The residuals of a pair at the pose found.

    `distances`: |r| of its points as multiples of its own sigma; `mask`: which of them
    exist; `field`: R in the same unit; `noise`: of the pair.
    """

    distances: Float[Array, "*pairs point"]
    mask: Bool[Array, "*pairs point"]
    field: Float[Array, "*pairs"]
    noise: Noise


def _residuals(pair: Pair) -> _Residuals:
    """The residuals of a pair at the pose of a search that begins with its sigma."""
    pair = mask_unusable(pair)[0]
    s = squares(pair, FINDER(pair).orientation.pose)
    return _Residuals(
        distances=jnp.sqrt(s),
        mask=pair.mask,
        field=FIELD * _focal_in_sigma(pair),
        noise=noise_of(s, pair.mask),
    )


def _residuals_from(pairs: Pair, start: float) -> _Residuals:
    """The same of a batch for searches that begin with a multiple of its sigma, as
    multiples of its sigma."""
    scaled = _with_sigma(pairs, pairs.sigma * start)
    found = map_batch(_residuals, scaled, chunk=CHUNK)
    noise = found.noise
    own = Noise(
        sigma=noise.sigma * start,
        deviation=noise.deviation * start,
        share=noise.share,
        squares=noise.squares * start**2,
        redundancy=noise.redundancy,
    )
    return found._replace(
        distances=found.distances * start, field=found.field * start, noise=own
    )


def _begin(pairs: Pair, unit: float) -> float:
    """The trial standard deviation for which all pairs together have the most evidence,
    over all starts."""
    finer = 2.0 ** (1 - np.arange(FINENESS * (len(STARTS) + 1)) / FINENESS)
    trials = unit * STARTS[0] * finer
    most, best = -1.0, 0.0
    for start in STARTS:
        if unit * start < best / PASSED:
            break
        found = _residuals_from(pairs, unit * start)
        evidence = np.asarray(_evidence_of_all(found, jnp.asarray(trials)))
        together = np.sum(np.maximum(evidence, 0.0), axis=1)
        likeliest = np.argmax(together)
        here = float(together[likeliest]), float(trials[likeliest])
        most, best = max((most, best), here)
    return best


def _repeat(parts: list[Pair], first: float) -> tuple[Noise, Bool[np.ndarray, " pair"]]:
    """The noise of every pair, from the value that no longer changes, and which pairs
    tell theirs; none if the value drifts away from the first one."""
    begin = first
    for _ in range(STEPS):
        each = [_residuals_from(pairs, begin) for pairs in parts]
        found = jax.tree.map(lambda *a: jnp.concatenate(a), *each)
        evidence = np.asarray(_evidence_of_all(found, jnp.asarray([begin])))[0]
        telling = _telling(found.noise, evidence)
        if not telling.any():
            break
        before, begin = begin, float(_pool(found.noise, telling).sigma)
        if abs(math.log(begin / first)) > math.log(DRIFTS):
            telling[:] = False
            break
        if abs(math.log(begin / before)) < AGREES:
            break
    return found.noise, telling


def _telling(
    noises: Noise, evidence: Float[np.ndarray, " pair"]
) -> Bool[np.ndarray, " pair"]:
    """The pairs with enough evidence for their pose; none if all together have too
    little."""
    telling = np.asarray(noises.known) & (evidence > EVIDENCE)
    together = np.sum(np.where(telling, evidence - EVIDENCE, 0.0))
    return telling & (together > TOGETHER * math.sqrt(max(np.sum(telling), 1)))


def _pool(noises: Noise, telling: Bool[np.ndarray, " pair"]) -> Noise:
    """The noise of these pairs; of a single one its own, which is above the truth as
    often as below."""
    chosen = jax.tree.map(lambda a: a[telling], noises)
    single = lambda noises: jax.tree.map(lambda a: a[0], noises)
    return pooled(chosen) if telling.sum() > 1 else single(chosen)


def _evidence(found: _Residuals, s: Float[Array, ""]) -> Float[Array, ""]:
    """The logarithm of the likelihood of one pair with noise s, over the likelihood of
    wrong points alone."""
    n = jnp.maximum(count(found.mask), 1.0)
    normal = jnp.exp(-0.5 * (found.distances / s) ** 2)
    core = jnp.sqrt(2 / jnp.pi) * found.field / s * normal
    density = lambda share: share * core + 1 - share

    def improve(_, share):
        right = jnp.where(found.mask, share * core / density(share), 0.0)
        return jnp.clip(total(right) / n, SMALLEST_SHARE, LARGEST_SHARE)

    half = 0.5 * jnp.ones_like(s)
    share = jax.lax.fori_loop(0, SHARE_STEPS, improve, half)
    ratio = total(jnp.where(found.mask, jnp.log(density(share)), 0.0))
    return ratio - PARAMETERS * jnp.log(found.field / s)


@jax.jit
def _evidence_of_all(
    found: _Residuals, trials: Float[Array, "trial"]
) -> Float[Array, "trial pair"]:
    of_trial = lambda s: jax.vmap(lambda one: _evidence(one, s))(found)
    return jax.lax.map(of_trial, trials)


def _focal_in_sigma(pairs: Pair) -> Float[Array, "*pairs"]:
    """The focal length over the mean standard deviation of a coordinate."""
    n = jnp.maximum(count(pairs.mask), 1.0)
    sigmas = total(jnp.where(pairs.mask, pairs.sigma, 0.0))
    return pairs.focal_left * n / jnp.maximum(sigmas, 1e-300)


def _sample(pairs: Pair | Ragged | Iterable[Pair]) -> Pair | None:
    """At most PAIRS pairs of six points or more, evenly spread, and at most POINTS of
    the points of each, as a batch in NumPy; None where there are none."""
    if isinstance(pairs, Pair):
        rows = _rows_of_batch(jax.tree.map(np.asarray, double(pairs)))
    else:
        ragged = pairs if isinstance(pairs, Ragged) else join(list(pairs))
        rows = _rows_of_ragged(double(ragged))
    if not rows:
        return None
    rows = [_thin(row) for row in rows]
    size = sizes(np.array([len(row.x_left) for row in rows]), 1)[0]
    fill = lambda a: np.pad(a, (0, size - len(a))) if np.ndim(a) else a
    stack = lambda *fields: np.stack([fill(field) for field in fields])
    batch = jax.tree.map(stack, *rows)
    return _with_sigma(batch, np.where(batch.mask, batch.sigma, 1.0))


def _rows_of_batch(batch: Pair) -> list[Pair]:
    """The pairs to look at, of a batch or of one pair."""
    if batch.x_left.ndim == 1:
        batch = jax.tree.map(lambda a: a[None], batch)
    row = lambda k: jax.tree.map(lambda a: a[k], batch)
    return [row(k) for k in _spread_pairs(np.sum(batch.mask, axis=-1))]


def _rows_of_ragged(ragged: Ragged) -> list[Pair]:
    """The pairs to look at, of pairs of every length."""
    rows = []
    counts = np.add.reduceat(ragged.mask.astype(int), ragged.begins[:-1])
    for k in _spread_pairs(counts):
        one = ragged.pad_to(np.array([k]), int(ragged.lengths[k]))
        rows.append(jax.tree.map(lambda a: a[0], one))
    return rows


def _spread_pairs(counts: Int[np.ndarray, " pair"]) -> Int[np.ndarray, " some"]:
    """The pairs to look at, of pairs with these numbers of points."""
    return _spread(np.flatnonzero(counts > PARAMETERS), PAIRS)


def _thin(row: Pair) -> Pair:
    """One pair with its points in use, at most POINTS of them."""
    use = _spread(np.flatnonzero(row.mask), POINTS)
    return jax.tree.map(lambda a: a[use] if np.ndim(a) else a, row)


def _spread(places: Int[np.ndarray, " all"], most: int) -> Int[np.ndarray, " some"]:
    """All places, or so many of them evenly spread."""
    if len(places) <= most:
        return places
    return places[np.linspace(0, len(places) - 1, most).astype(int)]


def _with_sigma(pairs: Pairs, sigma: Any) -> Pairs:
    """The same pairs with other standard deviations."""
    return eqx.tree_at(lambda pairs: pairs.sigma, pairs, sigma)
