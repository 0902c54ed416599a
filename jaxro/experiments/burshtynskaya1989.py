"""Table 2 of Burshtynskaya and Tumskaya (1989): errors found by residual parallaxes,
and by Grubbs' test besides.

Sixteen points in eight rows, flat mock pairs, f = b = y = 70 mm, sigma = 0.01 mm;
errors of the right-hand y at random points, of random sign. The paper measured 34
pairs, without noise. Its table 1, which listed the errors, is mostly lost; taken here:
10, 14 and 10 pairs of its three classes, 26 with one error, 6 with two and 2 with
three: its 44.

The legible part of table 1 contradicts the classes of the text: pairs I-4 and I-5 have
errors of 0.02 mm (2 sigma, not 1), III-1 has 0.2 mm (20 sigma, not 8 to 10). The
classes here are those of the text.

The paper does not give its tolerances either. The first stage is the algorithm of 1971
with eps4 = 0.01 mm as there, and with 0.045 mm. The figure of the layout is lost, too.
With rows at 1, .9, .6, .1 every eps4 from .0405 to .0464 mm rejects just the points
that the text describes for all three pairs; with rows at 1, .85, .7, .1 no eps4 does.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ..batches.batch import clean_batch
from ..geometry import mock_pairs
from ..geometry.mock_pairs import noisy, plant
from ..geometry.pairs import Pair
from ..rejection import AbstractProcedure, Rejection, TwoStage
from ..xla.programs import Program
from ..xla.settings import COMPILE_FAST
from . import burshtynskaya1989_conclusions as conclusions
from .burshtynskaya1989_conclusions import Conclusions

SIGMA = 0.01
"""mm"""
VARIANTS = 34
TOLERANCES = (0.01, 0.045)
"""eps4 of the first stage, mm; the last is the one that fits."""
LAYOUTS = {
    "1, .9, .6, .1": mock_pairs.row_layout(),
    "1, .85, .7, .1": mock_pairs.row_layout(
        (1.0, 0.85, 0.7, 0.1, -0.1, -0.7, -0.85, -1.0)
    ),
}
"""Of the sixteen points; the first is used, the second cannot be the paper's."""
NOTHING = 1e3
"""mm, an eps4 that rejects nothing."""


class ErrorClass(NamedTuple):
    """Least and largest error (sigma), and the numbers of pairs with one, two and three
    of them."""

    least: float
    most: float
    pairs: tuple[int, int, int]


CLASSES = {
    "I": ErrorClass(1, 1, (10, 0, 0)),
    "II": ErrorClass(10, 15, (8, 4, 2)),
    "III": ErrorClass(8, 10, (8, 2, 0)),
}


class Variant(NamedTuple):
    """A pair of the paper that its text describes: errors (mm) by point, and the points
    rejected by their parallax."""

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

    `by_parallax`, `by_grubbs`: wrong points rejected by the first and the second stage;
    `good`: good points rejected. Pairs left with exactly their good points:
    `pairs_by_parallax` after the first stage, `pairs_by_grubbs` by the second;
    `pairs_good`: that lost a good point.
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
    """All runs; and of the pairs that the text describes, by layout (first key) and
    name:

    `named`: by tolerance the points rejected by parallax and by Grubbs, on the first
    layout; `fitting`: (above, up to), the tolerances eps4 (mm) with which the first
    stage rejects just the points that the text names. `conclusions`: the paper's six,
    with the last tolerance.
    """

    runs: list[Run]
    named: dict[float, dict[str, tuple[list[int], list[int]]]]
    fitting: dict[str, dict[str, tuple[float, float]]]
    conclusions: Conclusions


def run(
    variants: int = VARIANTS,
    seed: int = 0,
    progress: Callable[[int, int], None] | None = None,
) -> Results:
    """So many variants (the paper's 34, again and again) without and with noise,
    through both stages.

    All pairs go as one batch, so that each stage is compiled once.
    """
    classes, errors = (np.resize(each, variants) for each in _pattern())
    limits = np.array([CLASSES[name][:2] for name in classes])
    key, planned = jax.random.key(seed), conclusions.plan()
    drawn = jax.random.split(key, variants), jnp.asarray(errors), jnp.asarray(limits)
    pairs, wrong = Program(_simulated, {}, COMPILE_FAST)(
        (drawn, jnp.asarray(planned.errors), jax.random.fold_in(key, 1989))
    )
    wrong = np.asarray(wrong)
    described = slice(2 * variants, 2 * variants + len(NAMED) * len(LAYOUTS))
    rest = slice(described.stop, None)
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
        numbers = [
            [_numbers(row) for row in stage[described][: len(NAMED)]]
            for stage in (first, second)
        ]
        named[eps4] = dict(zip(NAMED, zip(*numbers, strict=True), strict=True))
        concluded = conclusions.conclude(
            planned, first[rest], second[rest]
        )  # the last tolerance stays
        if progress is not None:
            progress(done + 1, len(TOLERANCES) + 1)
    excess = excesses(pairs)[described].reshape(len(LAYOUTS), len(NAMED), -1)
    fitting = {
        layout: {
            name: _fitting(row, NAMED[name].rejected)
            for name, row in zip(NAMED, rows, strict=True)
        }
        for layout, rows in zip(LAYOUTS, excess, strict=True)
    }
    if progress is not None:
        progress(len(TOLERANCES) + 1, len(TOLERANCES) + 1)
    return Results(runs, named, fitting, concluded)


def rejected(pairs: Pair, eps4: float) -> tuple[np.ndarray, np.ndarray]:
    """Points rejected by the first and by the second stage of `TwoStage`, (pair,
    point)."""
    kept, _ = clean_batch(pairs, _first(eps4), select=_decision)
    left = clean_batch(pairs.with_mask(kept), TwoStage().second, select=_mask)
    return ~np.asarray(kept), np.asarray(kept & ~left)


def excesses(pairs: Pair) -> np.ndarray:
    """|q| - mean |q| in the final check of the first stage, (pair, point), where the
    stage rejected nothing before."""
    return np.asarray(clean_batch(pairs, _first(NOTHING), select=_decision)[1])


def common(intervals: Iterable[tuple[float, float]]) -> tuple[float, float]:
    """What intervals (above, up to) have in common; nothing where the first number is
    not below the second."""
    above, up_to = zip(*intervals, strict=True)
    return max(above), min(up_to)


def _fitting(excess: np.ndarray, described: tuple[int, ...]) -> tuple[float, float]:
    """The tolerances that reject the points described and no other."""
    out = np.isin(np.arange(len(excess)) + 1, described)
    return float(np.max(excess[~out])), float(np.min(excess[out]))


def _first(eps4: float) -> AbstractProcedure:
    # an array: one program for all tolerances
    return eqx.tree_at(lambda p: p.eps4, TwoStage().first, jnp.asarray(eps4))


def _numbers(mask: np.ndarray) -> list[int]:
    return [int(i) + 1 for i in np.flatnonzero(mask)]


def counts(wrong: np.ndarray, first: np.ndarray, second: np.ndarray) -> Counts:
    """The rows of table 2 from what was planted and what each stage rejected, all
    (pair, point)."""
    out = first | second
    perfect, at_once = np.all(out == wrong, axis=1), np.all(first == wrong, axis=1)
    return Counts(
        wrong.size,
        *(
            int(np.sum(each))
            for each in (
                wrong,
                first & wrong,
                second & wrong,
                out & ~wrong,
                wrong & ~out,
            )
        ),
        len(wrong),
        *(
            int(np.sum(each))
            for each in (at_once, perfect & ~at_once, np.any(out & ~wrong, axis=1))
        ),
    )


def _pattern() -> tuple[np.ndarray, np.ndarray]:
    """The class and the number of errors of each of the 34 variants."""
    rows = [
        (name, i)
        for name, c in CLASSES.items()
        for i, pairs in enumerate(c.pairs, 1)
        for _ in range(pairs)
    ]
    names, errors = zip(*rows, strict=True)
    return np.array(names), np.array(errors)


def _simulated(plan: tuple):
    """Pairs without noise, with noise, the described ones, those of the conclusions;
    wrong points of the first."""
    drawn, errors, key = plan
    exact = mock_pairs.mock_pair(mock_pairs.row_layout())

    def one(key, errors, limits):
        noise, place, size, sign = jax.random.split(key, 4)
        wrong = (
            jnp.argsort(jnp.argsort(jax.random.uniform(place, exact.mask.shape, float)))
            < errors
        )
        sizes = (
            jax.random.uniform(size, wrong.shape, float, limits[0], limits[1]) * SIGMA
        )
        signed = jnp.where(jax.random.bernoulli(sign, shape=wrong.shape), sizes, -sizes)
        silent = plant(exact, y_right=jnp.where(wrong, signed, 0.0))
        return silent, noisy(silent, noise, SIGMA), wrong

    silent, measured, wrong = jax.vmap(one)(*drawn)
    described = [_named(mock_pairs.mock_pair(layout)) for layout in LAYOUTS.values()]
    parts = silent, measured, *described, conclusions.measured(exact, errors, key)
    return jax.tree.map(lambda *parts: jnp.concatenate(parts), *parts), wrong


def _named(exact: Pair) -> Pair:
    """The named variants as a batch."""
    errors = np.zeros((len(NAMED), exact.x_left.shape[0]))
    for row, variant in zip(errors, NAMED.values(), strict=True):
        row[[point - 1 for point in variant.errors]] = list(variant.errors.values())
    return jax.vmap(lambda y: plant(exact, y_right=y))(jnp.asarray(errors))


def _decision(found: Rejection):
    return found.mask, found.statistic


def _mask(found: Rejection):
    return found.mask
