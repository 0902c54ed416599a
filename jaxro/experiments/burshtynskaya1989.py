"""Table 2 of Burshtynskaya and Tumskaya (1989): errors found by residual parallaxes, and by Grubbs' test besides.

Sixteen points in eight rows, flat mock pairs, f = b = y = 70 mm, sigma = 0.01 mm; errors of the right-hand y at random
points, of random sign. The paper measured 34 pairs, without noise. Its table 1, which listed the errors, is mostly
lost; taken here: 10, 14 and 10 pairs of its three classes, 26 with one error, 6 with two and 2 with three: its 44.

The paper does not give its tolerances either. The first stage is the algorithm of 1971 with eps4 = 0.01 mm as there,
and with 0.05 mm, which comes nearest to the printed rates and to the pairs that the text describes.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from .. import simulation
from ..batch import clean_batch
from ..pairs import Pair
from ..programs import QUICK, Program
from ..rejection import TwoStage
from ..simulation import noisy, planted

SIGMA = 0.01
"""mm"""
VARIANTS = 34
TOLERANCES = (0.01, 0.05)
"""eps4 of the first stage, mm"""


class ErrorClass(NamedTuple):
    """Least and largest error (sigma), and the numbers of pairs with one, two and three of them."""

    least: float
    most: float
    pairs: tuple[int, int, int]


CLASSES = {
    "I": ErrorClass(1, 1, (10, 0, 0)),
    "II": ErrorClass(10, 15, (8, 4, 2)),
    "III": ErrorClass(8, 10, (8, 2, 0)),
}


class Variant(NamedTuple):
    """A pair of the paper that its text describes: errors (mm) by point, and the points rejected by their parallax."""

    errors: dict[int, float]
    rejected: tuple[int, ...]


NAMED = {
    "II-13": Variant({4: 0.1, 7: 0.1, 14: -0.4}, (14, 16)),
    "III-7": Variant({11: 0.1, 13: 0.1}, (15,)),
    "II-9": Variant({7: 0.2, 9: 0.1}, (7,)),
}


@dataclass(frozen=True)
class Counts:
    """The rows of table 2: points and errors, and beside them the pairs.

    `by_parallax`, `by_grubbs`: wrong points rejected by the first and the second stage; `good`: good points rejected.
    Pairs left with exactly their good points: `pairs_by_parallax` after the first stage, `pairs_by_grubbs` by the
    second; `pairs_good`: that lost a good point.
    """

    points: int
    errors: int
    by_parallax: int
    by_grubbs: int
    good: int
    missed: int
    pairs: int
    pairs_by_parallax: int
    pairs_by_grubbs: int
    pairs_good: int


PAPER = Counts(544, 44, 21, 20, 8, 3, 34, 9, 16, 8)


@dataclass(frozen=True)
class Run:
    """One tolerance (mm), without or with noise: counts over all pairs and by class."""

    eps4: float
    noise: bool
    total: Counts
    by_class: dict[str, Counts]


@dataclass(frozen=True)
class Results:
    """All runs, and of the named variants by tolerance the points rejected by parallax and by Grubbs."""

    runs: list[Run]
    named: dict[float, dict[str, tuple[list[int], list[int]]]]


def run(variants: int = VARIANTS, seed: int = 0, progress: Callable[[int, int], None] | None = None) -> Results:
    """So many variants (the paper's 34, again and again) without and with noise, through both stages."""
    classes, errors = (np.resize(each, variants) for each in _pattern())
    limits = np.array([CLASSES[name][:2] for name in classes])
    plan = jax.random.split(jax.random.key(seed), variants), jnp.asarray(errors), jnp.asarray(limits)
    pairs, wrong = Program(_simulated, {}, QUICK)(plan)
    wrong = np.asarray(wrong)
    runs, named = [], {}
    for done, eps4 in enumerate(TOLERANCES):
        first, second = rejected(pairs, eps4)
        for noise in (False, True):
            part = slice(variants * noise, variants * (noise + 1))
            count = lambda rows, part=part, first=first, second=second: counts(
                wrong[rows], first[part][rows], second[part][rows]
            )
            by_class = {name: count(classes == name) for name in CLASSES}
            runs.append(Run(eps4, noise, count(slice(None)), by_class))
        described = [[_numbers(row) for row in stage[2 * variants :]] for stage in (first, second)]
        named[eps4] = dict(zip(NAMED, zip(*described, strict=True), strict=True))
        if progress is not None:
            progress(done + 1, len(TOLERANCES))
    return Results(runs, named)


def rejected(pairs: Pair, eps4: float) -> tuple[np.ndarray, np.ndarray]:
    """Points rejected by the first and by the second stage of `TwoStage`, (pair, point)."""
    stages = TwoStage()
    first = eqx.tree_at(lambda p: p.eps4, stages.first, jnp.asarray(eps4))  # an array: one program for all tolerances
    kept = clean_batch(pairs, first, select=_mask)
    left = clean_batch(pairs.with_mask(kept), stages.second, select=_mask)
    return ~np.asarray(kept), np.asarray(kept & ~left)


def _numbers(mask: np.ndarray) -> list[int]:
    return [int(i) + 1 for i in np.flatnonzero(mask)]


def counts(wrong: np.ndarray, first: np.ndarray, second: np.ndarray) -> Counts:
    """The rows of table 2 from what was planted and what each stage rejected, all (pair, point)."""
    out = first | second
    perfect, at_once = np.all(out == wrong, axis=1), np.all(first == wrong, axis=1)
    return Counts(
        wrong.size,
        *(int(np.sum(each)) for each in (wrong, first & wrong, second & wrong, out & ~wrong, wrong & ~out)),
        len(wrong),
        *(int(np.sum(each)) for each in (at_once, perfect & ~at_once, np.any(out & ~wrong, axis=1))),
    )


def _pattern() -> tuple[np.ndarray, np.ndarray]:
    """The class and the number of errors of each of the 34 variants."""
    rows = [(name, i) for name, c in CLASSES.items() for i, pairs in enumerate(c.pairs, 1) for _ in range(pairs)]
    names, errors = zip(*rows, strict=True)
    return np.array(names), np.array(errors)


def _simulated(plan: tuple):
    """Pairs without noise, with noise, and the named ones; wrong points of the first."""
    exact = simulation.mock_pair(simulation.row_layout())

    def one(key, errors, limits):
        noise, place, size, sign = jax.random.split(key, 4)
        wrong = jnp.argsort(jnp.argsort(jax.random.uniform(place, exact.mask.shape, float))) < errors
        sizes = jax.random.uniform(size, wrong.shape, float, limits[0], limits[1]) * SIGMA
        signed = jnp.where(jax.random.bernoulli(sign, shape=wrong.shape), sizes, -sizes)
        silent = planted(exact, y_right=jnp.where(wrong, signed, 0.0))
        return silent, noisy(silent, noise, SIGMA), wrong

    silent, measured, wrong = jax.vmap(one)(*plan)
    return jax.tree.map(lambda *parts: jnp.concatenate(parts), silent, measured, _named(exact)), wrong


def _named(exact: Pair) -> Pair:
    """The named variants as a batch."""
    errors = np.zeros((len(NAMED), exact.x_left.shape[0]))
    for row, variant in zip(errors, NAMED.values(), strict=True):
        row[[point - 1 for point in variant.errors]] = list(variant.errors.values())
    return jax.vmap(lambda y: planted(exact, y_right=y))(jnp.asarray(errors))


def _mask(found):
    return found.mask
