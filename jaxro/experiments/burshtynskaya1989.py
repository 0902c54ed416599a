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
The rates that the paper prints are not reproduced with it: 48 % of the errors found by
residual parallaxes, 45 % by Grubbs' test, 7 % missed; calculated are 60, 35 and 5 %.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..batches.batch import clean_batch
from ..geometry import mock_pairs
from ..geometry.mock_pairs import draw_points, noisy, plant
from ..geometry.pairs import Pair
from ..rejection import AbstractProcedure, Rejection, TwoStage
from ..xla.programs import compiled
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
    """The rows of table 2: numbers of points, and of pairs.

    `errors`: wrong points. `by_parallax`, `by_grubbs`: wrong points rejected by the
    first and by the second stage; `good`: good points rejected; `missed`: wrong points
    kept. `pairs_by_parallax`: pairs left with exactly their good points by the first
    stage, `pairs_by_grubbs`: by the second; `pairs_good`: pairs that lost a good point.
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


PAPER = Counts(
    points=544,
    errors=44,
    by_parallax=21,
    by_grubbs=20,
    good=8,
    missed=3,
    pairs=34,
    pairs_by_parallax=9,
    pairs_by_grubbs=16,
    pairs_good=8,
)


@dataclass(frozen=True)
class Run:
    """One tolerance (mm), without or with noise: counts over all pairs and by class."""

    eps4: float
    noise: bool
    total: Counts
    by_class: dict[str, Counts]


@dataclass(frozen=True)
class Results:
    """All runs, and what the pairs that the text describes tell.

    `named`: by tolerance and pair the points rejected by parallax and by Grubbs, on the
    first layout. `fitting`: by layout and pair (above, up to), the tolerances eps4 (mm)
    with which the first stage rejects just the points that the text names.
    `conclusions`: the paper's six, with the last tolerance.
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

    All pairs go as one batch, so that each stage is compiled once: the variants without
    noise, the same with noise, the described pairs of every layout, and the pairs of
    the conclusions.
    """
    report = progress if progress is not None else lambda done, total: None
    steps = len(TOLERANCES) + 1
    planned = conclusions.plan()
    pairs, classes, wrong = _pairs(variants, seed, planned)
    described = slice(2 * variants, 2 * variants + len(NAMED) * len(LAYOUTS))
    runs, named = [], {}
    first = second = np.zeros(0)
    for done, eps4 in enumerate(TOLERANCES):
        first, second = reject(pairs, eps4)
        for noise in (False, True):
            part = slice(variants * noise, variants * (noise + 1))
            one = _count_run(classes, wrong, first[part], second[part])
            runs.append(Run(eps4, noise, *one))
        named[eps4] = _name_points(first[described], second[described])
        report(done + 1, steps)
    rest = slice(described.stop, None)
    concluded = conclusions.conclude(planned, first[rest], second[rest])
    fitting = _fit_tolerances(excesses(pairs)[described])
    report(steps, steps)
    return Results(runs, named, fitting, concluded)


def _pairs(
    variants: int, seed: int, planned: conclusions.Plan
) -> tuple[Pair, np.ndarray, np.ndarray]:
    """All pairs as a batch, and the class and the wrong points of each variant."""
    classes, errors = (np.resize(each, variants) for each in _pattern())
    limits = np.array([CLASSES[name][:2] for name in classes])
    key = jax.random.key(seed)
    keys = jax.random.split(key, variants)
    drawn = keys, errors, limits
    noise_key = jax.random.fold_in(key, 1989)
    pairs, wrong = _simulate(drawn, np.asarray(planned.errors), noise_key)
    return pairs, classes, np.asarray(wrong)


def _count_run(
    classes: np.ndarray, wrong: np.ndarray, first: np.ndarray, second: np.ndarray
) -> tuple[Counts, dict[str, Counts]]:
    """The rows of table 2 of all pairs, and by class."""
    by_class = {}
    for name in CLASSES:
        rows = classes == name
        by_class[name] = counts(wrong[rows], first[rows], second[rows])
    return counts(wrong, first, second), by_class


def _name_points(
    first: np.ndarray, second: np.ndarray
) -> dict[str, tuple[list[int], list[int]]]:
    """The numbers of the points rejected by each stage, of the described pairs on the
    first layout."""
    numbers = lambda mask: [int(i) + 1 for i in np.flatnonzero(mask)]
    return {
        name: (numbers(first[row]), numbers(second[row]))
        for row, name in enumerate(NAMED)
    }


def _fit_tolerances(excess: np.ndarray) -> dict[str, dict[str, tuple[float, float]]]:
    """The tolerances that reject the points described and no other, by layout and
    pair."""
    fitting = {}
    by_layout = excess.reshape(len(LAYOUTS), len(NAMED), -1)
    for layout, rows in zip(LAYOUTS, by_layout, strict=True):
        fitting[layout] = {}
        for (name, variant), row in zip(NAMED.items(), rows, strict=True):
            out = np.isin(np.arange(len(row)) + 1, variant.rejected)
            fitting[layout][name] = float(np.max(row[~out])), float(np.min(row[out]))
    return fitting


def reject(pairs: Pair, eps4: float) -> tuple[np.ndarray, np.ndarray]:
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
    """The interval common to all intervals (above, up to); empty where the first number
    is not below the second."""
    above, up_to = zip(*intervals, strict=True)
    return max(above), min(up_to)


def _first(eps4: float) -> AbstractProcedure:
    # an array: one program for all tolerances
    return eqx.tree_at(lambda p: p.eps4, TwoStage().first, jnp.asarray(eps4))


def counts(wrong: np.ndarray, first: np.ndarray, second: np.ndarray) -> Counts:
    """The rows of table 2 from the points planted wrong and those that each stage
    rejected, all (pair, point)."""
    number = lambda flags: int(np.sum(flags))
    out = first | second
    at_once = np.all(first == wrong, axis=1)
    in_the_end = np.all(out == wrong, axis=1)
    return Counts(
        points=wrong.size,
        errors=number(wrong),
        by_parallax=number(first & wrong),
        by_grubbs=number(second & wrong),
        good=number(out & ~wrong),
        missed=number(wrong & ~out),
        pairs=len(wrong),
        pairs_by_parallax=number(at_once),
        pairs_by_grubbs=number(in_the_end & ~at_once),
        pairs_good=number(np.any(out & ~wrong, axis=1)),
    )


def _pattern() -> tuple[np.ndarray, np.ndarray]:
    """The class and the number of errors of each of the 34 variants."""
    names, errors = [], []
    for name, of_class in CLASSES.items():
        for number, pairs in enumerate(of_class.pairs, 1):
            names += [name] * pairs
            errors += [number] * pairs
    return np.array(names), np.array(errors)


@compiled
def _simulate(drawn: tuple, errors: Array, key: Array):
    """All pairs as a batch, and the wrong points of the variants."""
    exact = mock_pairs.mock_pair(mock_pairs.row_layout())
    points = exact.mask.shape

    def vary(key, errors, limits):
        noise, place, size, sign = jax.random.split(key, 4)
        wrong = draw_points(place, exact.mask, errors)
        least, most = limits
        sizes = jax.random.uniform(size, points, float, least, most) * SIGMA
        signed = jnp.where(jax.random.bernoulli(sign, shape=points), sizes, -sizes)
        exact_but_wrong = plant(exact, y_right=jnp.where(wrong, signed, 0.0))
        return exact_but_wrong, noisy(exact_but_wrong, noise, SIGMA), wrong

    without, measured, wrong = jax.vmap(vary)(*drawn)
    described = [_describe(mock_pairs.mock_pair(layout)) for layout in LAYOUTS.values()]
    concluded = conclusions.measure(exact, errors, key)
    parts = without, measured, *described, concluded
    return jax.tree.map(lambda *fields: jnp.concatenate(fields), *parts), wrong


def _describe(exact: Pair) -> Pair:
    """The pairs that the text describes, as a batch."""
    errors = np.zeros((len(NAMED), exact.x_left.shape[0]))
    for row, variant in zip(errors, NAMED.values(), strict=True):
        row[[point - 1 for point in variant.errors]] = list(variant.errors.values())
    return jax.vmap(lambda y: plant(exact, y_right=y))(jnp.asarray(errors))


def _decision(found: Rejection):
    return found.mask, found.statistic


def _mask(found: Rejection):
    return found.mask
