"""The standard deviation of the coordinates of a table, from its own residuals, in
spite of wrong points.

Nothing has to be known beforehand. Of at most PAIRS pairs, evenly spread, and at most
POINTS points of each:

1. Where to begin: `Recommended(known=False)` finds the poses of some pairs from each of
   many standard deviations, in steps of 2. At the poses found, a trial standard
   deviation s is worth the logarithm of

       density of |r| = a 2/s phi(r/s) + (1 - a) / R,    R = f / 25,

   against that of wrong points alone, a fitted to each pair. Five points fit any pose,
   so that five count as wrong ones. The sum over the pairs chooses: of few points among
   many wrong ones a search finds noise of about the size with which it begins, and only
   all pairs together tell which size is right.
2. The poses of all pairs from there; `noise_of` each, and `pooled`. Repeated with what
   is found until that stays.

A pair without enough evidence for its pose takes no part.
"""

import math
from collections.abc import Iterable
from typing import NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..geometry.pairs import Pair, double, mask_unusable
from ..rejection import Noise, Recommended, noise_of, pooled
from ..rejection.hypotheses import squares
from ..rejection.noise import PARAMETERS
from ..rejection.search import Search
from ..rejection.thorough import Thorough
from ..xla.passes import count, sums, total
from .batch import map_batch
from .padding import sizes
from .ragged import Ragged, join

PAIRS, POINTS = 256, 128
"""Pairs that are looked at, at most, and points of each: a table of 16 points tells its
noise to 1.5 % by then."""

BLOCK, CHUNK = 64, 8
"""Pairs of a call, so that every call is the same program, and of a search."""

STARTS = tuple(2.0**k / 3000 for k in range(1, -8, -1))
"""Where to begin, as parts of the focal length: 0.1 mm to 0.4 µm of 150 mm."""

PASSED = 16.0
"""How far below the likeliest trial the starts end: searches that begin too small find
nothing, and take longest."""

FINENESS = 2
"""Trial standard deviations to each start, from twice the first on."""

FIELD = 0.04
"""Over what part of the focal length the distances of wrong points are spread: 6 mm of
150. Taken too wide, wrong points near the right ones look like noise."""

EVIDENCE, TOGETHER = 3.0, 10.0
"""Logarithm of the likelihood ratio from which a pair takes part, and by how much n
pairs must exceed that on the average, times sqrt(n): of eight right points among
sixteen a single pair tells nothing, twenty do."""

STEPS, AGREES, DRIFTS = 4, 0.05, 2.0
"""How often the poses are found anew at most, the change of log sigma at which that
ends, and the ratio to where they began beyond which nothing is believed: noise that
follows the search is none."""

FINDER = Recommended(known=False, stages=(Thorough(search=Search(count=2048)),))
"""Enough subsets for two thirds of wrong points. Pairs that need more can be left out;
searches that begin far from the noise would go on to their end."""

TELLING = 0.5
"""Share of the pairs that have to tell their noise: where fewer do, they are those with
the least."""

Pairs = TypeVar("Pairs", Pair, Ragged)


class TableNoise(NamedTuple):
    """The noise of a table: `sigma`, by which the standard deviations of its pairs are
    to be multiplied (those of a pair that states none are 1: it is in the unit of the
    coordinates), its standard `deviation`, and the number of `pairs` whose residuals
    tell it, of so many that were `asked`."""

    sigma: float
    deviation: float
    pairs: int
    asked: int

    def applied(self, pairs: Pairs) -> Pairs:
        """The same pairs with this noise as their standard deviations."""
        return eqx.tree_at(
            lambda p: p.sigma, pairs, np.asarray(pairs.sigma) * self.sigma
        )


def estimate(pairs: Pair | Ragged | Iterable[Pair]) -> TableNoise:
    """The noise of pairs of one camera: a batch, `Ragged` pairs, single pairs in a
    list, or one pair.

    Different standard deviations within `pairs` stay in their ratios. Raises ValueError
    where no pair tells: fewer than six points everywhere, or too few points that agree
    with a pose to be no accident, or this in most of the pairs.
    """
    chosen = _sample(pairs)
    asked = 0 if chosen is None else len(chosen.x_left)
    if chosen is None:
        raise ValueError(
            "no pair has six points or more, which would show the noise: state the "
            "standard deviation"
        )
    # a start is one for all pairs
    unit = float(np.median(_focal_in_sigma(jax.device_put(chosen))))
    blocks = -(-asked // BLOCK)
    size = asked // blocks
    parts = [
        jax.tree.map(lambda a, k=k: a[k::blocks][:size], chosen) for k in range(blocks)
    ]
    found, part = _settled(parts, _begin(parts[0], unit))
    if not part.any():
        raise ValueError(
            "the residuals tell no noise: not enough points agree with one pose of "
            "their pair; state the standard deviation"
        )
    if part.sum() < TELLING * len(part):
        raise ValueError(
            f"only {part.sum()} of {len(part)} pairs have enough points that agree to "
            "tell their noise, and those with the least noise are the first to: state "
            "the standard deviation"
        )
    noise = _together(found, part)
    return TableNoise(
        float(noise.sigma), float(noise.deviation), int(part.sum()), len(part)
    )


class _Read(NamedTuple):
    """|r| of the points of a pair at the pose found, as multiples of its own sigma,
    which of them there are, and the noise; R in the same unit."""

    distances: Float[Array, "*pairs point"]
    mask: Bool[Array, "*pairs point"]
    field: Float[Array, "*pairs"]
    noise: Noise


def _read(pair: Pair) -> _Read:
    """What the pose of a pair leaves, whose sigma is where the search begins."""
    pair = mask_unusable(pair)[0]
    s = squares(pair, FINDER(pair).orientation.pose)
    return _Read(
        jnp.sqrt(s), pair.mask, FIELD * _focal_in_sigma(pair), noise_of(s, pair.mask)
    )


def _from(pairs: Pair, start: float) -> _Read:
    """The same of a batch from this multiple of its sigma, as multiples of its
    sigma."""
    begun = eqx.tree_at(lambda p: p.sigma, pairs, pairs.sigma * start)
    found = map_batch(_read, begun, chunk=CHUNK)
    n = found.noise
    own = Noise(
        n.sigma * start,
        n.deviation * start,
        n.share,
        n.squares * start**2,
        n.redundancy,
    )
    return _Read(found.distances * start, found.mask, found.field * start, own)


def _begin(pairs: Pair, unit: float) -> float:
    """The trial standard deviation that all pairs together find likeliest, over all
    starts."""
    trials = (
        unit
        * STARTS[0]
        * 2.0 ** (1 - np.arange(FINENESS * (len(STARTS) + 1)) / FINENESS)
    )
    best = -1.0, 0.0
    for start in STARTS:
        if unit * start < best[1] / PASSED:
            break
        found = _from(pairs, unit * start)
        evidence = np.asarray(_evidence_of_all(found, jnp.asarray(trials)))
        worth = np.sum(np.maximum(evidence, 0.0), axis=1)
        best = max(best, (float(np.max(worth)), float(trials[np.argmax(worth)])))
    return best[1]


def _settled(
    parts: list[Pair], first: float
) -> tuple[Noise, Bool[np.ndarray, " pair"]]:
    """The noise of every pair, from where it stays, and which pairs tell theirs; none
    where it does not stay."""
    begin = first
    for _ in range(STEPS):
        each = [_from(pairs, begin) for pairs in parts]
        found = jax.tree.map(lambda *a: jnp.concatenate(a), *each)
        evidence = np.asarray(_evidence_of_all(found, jnp.asarray([begin])))[0]
        part = np.asarray(found.noise.known) & (evidence > EVIDENCE)
        part &= np.sum(np.where(part, evidence - EVIDENCE, 0.0)) > TOGETHER * math.sqrt(
            max(np.sum(part), 1)
        )
        if not part.any():
            break
        before, begin = begin, float(_together(found.noise, part).sigma)
        if abs(math.log(begin / first)) > math.log(DRIFTS):
            part[:] = False
        if not part.any() or abs(math.log(begin / before)) < AGREES:
            break
    return found.noise, part


def _together(noises: Noise, part: Bool[np.ndarray, " pair"]) -> Noise:
    """The noise of these pairs; of a single one its own, which is above the truth as
    often as below."""
    chosen = jax.tree.map(lambda a: a[part], noises)
    return pooled(chosen) if part.sum() > 1 else jax.tree.map(lambda a: a[0], chosen)


def _evidence(found: _Read, s: Float[Array, ""]) -> Float[Array, ""]:
    """The logarithm of the likelihood of one pair with noise s, against that of wrong
    points alone."""
    n = jnp.maximum(count(found.mask), 1.0)
    core = (
        jnp.sqrt(2 / jnp.pi)
        * found.field
        / s
        * jnp.exp(-0.5 * (found.distances / s) ** 2)
    )

    def improved(_, share):
        return jnp.clip(
            total(jnp.where(found.mask, share * core / (share * core + 1 - share), 0.0))
            / n,
            0.01,
            0.999,
        )

    share = jax.lax.fori_loop(0, 20, improved, 0.5 * jnp.ones_like(s))
    (ratio,) = sums((jnp.where(found.mask, jnp.log(share * core + 1 - share), 0.0),))
    return ratio - PARAMETERS * jnp.log(found.field / s)


@jax.jit
def _evidence_of_all(
    found: _Read, trials: Float[Array, "trial"]
) -> Float[Array, "trial pair"]:
    return jax.lax.map(lambda s: jax.vmap(lambda one: _evidence(one, s))(found), trials)


def _focal_in_sigma(pairs: Pair) -> Float[Array, "*pairs"]:
    """The focal length over the mean standard deviation of a coordinate."""
    n = jnp.maximum(count(pairs.mask), 1.0)
    return (
        pairs.focal_left
        * n
        / jnp.maximum(total(jnp.where(pairs.mask, pairs.sigma, 0.0)), 1e-300)
    )


def _sample(pairs: Pair | Ragged | Iterable[Pair]) -> Pair | None:
    """At most PAIRS pairs of six points or more, evenly spread, and at most POINTS of
    the points of each, as a batch in NumPy; None where there are none."""
    if isinstance(pairs, Pair):
        batch = jax.tree.map(np.asarray, double(pairs))
        batch = (
            batch if batch.x_left.ndim > 1 else jax.tree.map(lambda a: a[None], batch)
        )
        chosen = _spread(np.sum(batch.mask, axis=-1))
        rows = [jax.tree.map(lambda a, k=k: a[k], batch) for k in chosen]
    else:
        ragged = double(pairs if isinstance(pairs, Ragged) else join(list(pairs)))
        chosen = _spread(np.add.reduceat(ragged.mask.astype(int), ragged.begins[:-1]))
        rows = [
            jax.tree.map(
                lambda a: a[0], ragged.pad_to(np.array([k]), int(ragged.lengths[k]))
            )
            for k in chosen
        ]
    if not rows:
        return None
    rows = [_thinned(row) for row in rows]
    size = sizes(np.array([len(row.x_left) for row in rows]), 1)[0]
    fill = lambda a: np.pad(a, (0, size - len(a))) if np.ndim(a) else a
    batch = jax.tree.map(lambda *a: np.stack([fill(one) for one in a]), *rows)
    return eqx.tree_at(lambda p: p.sigma, batch, np.where(batch.mask, batch.sigma, 1.0))


def _spread(counts: Int[np.ndarray, " pair"]) -> Int[np.ndarray, " some"]:
    """Of the pairs with these numbers of points the ones that are looked at."""
    enough = np.flatnonzero(counts > PARAMETERS)
    return (
        enough
        if len(enough) <= PAIRS
        else enough[np.linspace(0, len(enough) - 1, PAIRS).astype(int)]
    )


def _thinned(row: Pair) -> Pair:
    """One pair with its points in use, evenly spread where they are too many."""
    use = np.flatnonzero(row.mask)
    use = (
        use
        if len(use) <= POINTS
        else use[np.linspace(0, len(use) - 1, POINTS).astype(int)]
    )
    return jax.tree.map(lambda a: a[use] if np.ndim(a) else a, row)
