"""Oriented pairs as every report and file reads them: columns in NumPy, with names,
units and cameras. Elements, m_q and sigma0 are NaN where a result is not usable."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import combinations
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..adjustment import critical_values, normal_equations as normal
from ..assessment import Pattern, likelihood
from ..batches import table_neighbours
from ..batches.after_cleaning import AfterCleaning
from ..batches.closures import Closures
from ..batches.padding import sizes
from ..batches.ragged import Ragged
from ..geometry.elements import (
    AbstractElements,
    DependentElements,
    RelativePose,
    convert,
)
from ..geometry.linear import linearise
from ..geometry.pairs import Camera, Pair, mask_unusable
from ..orientation.pure_rotation import PureRotation, orient_rotation
from ..rejection.fading import fade_again
from ..tables.measured import CameraPairs, Table, take, to_list
from ..xla.programs import compiled
from .columns import (
    RESULT_ADVICE,
    RESULT_NAMES,
    USABLE,
    Column,
    Units,
    columns_of,
    element_columns,
    element_names,
    is_given,
    is_usable,
)
from .reader import report_numbers

WRONG_AS_A_WHOLE = ("mirrored", "out_of_field")
"""Results that name a cause, which is told first."""

MOST_PAIRS = 100
"""Pairs of a table of which more is told than their elements."""


@dataclass(frozen=True)
class Element:
    """One reported number of an orientation. `deviation` is None for what is given, not
    adjusted; `half_width` of its interval is None where none was asked for, and
    `by_likelihood`, the ends of that interval, where the deviation says it all."""

    name: str
    unit: str
    value: float
    deviation: float | None
    half_width: float | None = None
    by_likelihood: tuple[float, float] | None = None


@dataclass(frozen=True)
class Results:
    """Oriented pairs: the columns of the pairs and, by table, of the points that
    `table` holds, those kept. `confidence`: of the intervals that are asked for. By the
    numbers of the pairs: `patterns`, `rotations` of pairs without a base, `intervals`
    by likelihood of pairs whose deviations do not say it all. `growth`: by how much
    deviations allow for neighbours that agree; None where none do. `closures`: of
    triplets of photos; None where there are none. `promises`: what
    intervals really hold after cleaning, where that was simulated. `causes`: sentences
    about units, origin and sigma0 that are to be read first."""

    table: Table
    cameras: CameraPairs
    system: type[AbstractElements]
    units: Units
    sigma_known: bool
    of_pairs: dict[str, Any]
    of_points: dict[str, dict[str, Any]]
    confidence: float | None = None
    patterns: dict[int, Pattern] = field(default_factory=dict)
    rotations: dict[int, PureRotation] = field(default_factory=dict)
    intervals: dict[int, likelihood.Interval] = field(default_factory=dict)
    growth: float | None = None
    closures: Closures | None = None
    promises: dict[int, AfterCleaning] = field(default_factory=dict)
    causes: dict[int, list[str]] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.table.names)

    def __iter__(self) -> Iterator["One"]:
        return (One(self, number) for number in range(len(self)))

    @cached_property
    def usable(self) -> Bool[np.ndarray, " pair"]:
        """The pairs whose elements may be used."""
        return is_usable(self.of_pairs["result"])

    def written(self, name: str) -> tuple[Sequence[Column], dict[str, Any]]:
        """The columns of a table, and their values by name."""
        columns = columns_of(name, self.system)
        if name == "elements":
            causes = np.full(len(self), None, object)
            for number, said in self.causes.items():
                causes[number] = " ".join(said)
            own = {
                "pair": self.table.names,
                "points": self.table.lengths,
                "causes": causes,
            }
            return columns, self.of_pairs | own
        own = {
            "pair": take(self.table.names, self.table.owners),
            "point": self.table.points,
        }
        return columns, self.of_points[name] | own

    @cached_property
    def wrong(self) -> Int[np.ndarray, " some"]:
        """The pairs with something wrong as a whole."""
        named = [k for k, name in RESULT_NAMES.items() if name in WRONG_AS_A_WHOLE]
        found = np.flatnonzero(np.isin(self.of_pairs["result"], named))
        return np.union1d(found, np.array(list(self.causes), int))

    def causes_by_name(self, most: int | None = None) -> dict[str, list[str]]:
        """What is to be read first of the pairs that are `wrong`, of the first ones if
        there are more than `most`."""
        some = self.wrong[:most]
        told = {}
        for number, name in zip(
            some, to_list(take(self.table.names, some)), strict=True
        ):
            result = RESULT_NAMES[int(self.of_pairs["result"][number])]
            first = [RESULT_ADVICE[result]] if result in WRONG_AS_A_WHOLE else []
            told[str(name)] = [*first, *self.causes.get(int(number), [])]
        return told

    @cached_property
    def half_widths(self) -> dict[str, Float[np.ndarray, " pair"]]:
        """Of the intervals of the adjusted elements; none where none are asked for.

        Standard deviations times Student's t, or a normal quantile times sigma0 = 1
        where sigma is given.
        """
        if self.confidence is None:
            return {}
        sigma0, freedom = self.of_pairs["sigma0"], self.of_pairs["degrees_of_freedom"]
        if self.sigma_known:
            quantile = float(critical_values.normal(1 - self.confidence))
            there = sigma0 > 0
            factor = np.where(there, quantile / np.where(there, sigma0, 1.0), np.nan)
        else:
            some, place = np.unique(freedom, return_inverse=True)
            t = critical_values.half_width(self.confidence, some)
            factor = np.asarray(t)[place]
        deviations = [c for c in element_columns(self.system) if c.name[:3] == "sd_"]
        return {c.name[3:]: self.of_pairs[c.name] * factor for c in deviations}

    @cached_property
    def pattern(self) -> Pattern | None:
        """The test of all pairs together; None where nothing tells."""
        return table_neighbours.pool(self.patterns)


@dataclass(frozen=True)
class One:
    """One pair of `Results`."""

    results: Results
    number: int

    def value(self, column: str) -> Any:
        """The value of a column of the pairs, as a number of Python."""
        return self.results.of_pairs[column][self.number].item()

    @property
    def name(self) -> str:
        """The name of the pair."""
        return str(self.results.table.names[self.number])

    @property
    def count(self) -> int:
        """The number of its points."""
        return int(self.results.table.lengths[self.number])

    @cached_property
    def points(self) -> list[str]:
        """The names of its points."""
        return to_list(self.results.table.points[self._rows])

    def of_points(self, table: str) -> dict[str, np.ndarray]:
        """The columns of a table of its points."""
        columns = self.results.of_points[table]
        return {name: values[self._rows] for name, values in columns.items()}

    @property
    def _rows(self) -> slice:
        begins = self.results.table.begins
        return slice(int(begins[self.number]), int(begins[self.number + 1]))

    @cached_property
    def cameras(self) -> tuple[Camera, Camera]:
        """The left and the right camera."""
        all_cameras = self.results.cameras
        return (
            all_cameras if isinstance(all_cameras, tuple) else all_cameras[self.number]
        )

    @cached_property
    def result(self) -> str:
        """The name of the result."""
        return RESULT_NAMES[self.value("result")]

    @property
    def advice(self) -> str:
        """The sentence of the result, empty for a plain success."""
        return RESULT_ADVICE[self.result]

    @property
    def usable(self) -> bool:
        """Whether the elements may be used."""
        return self.result in USABLE

    @cached_property
    def elements(self) -> list[Element]:
        """The elements that are reported, NaN where they are not usable."""
        system, widths = self.results.system, self.results.half_widths
        names, ends = element_names(system), self.results.intervals.get(self.number)
        found = []
        for column in element_columns(system):
            name = column.name
            if name.startswith("sd_"):
                continue
            given = is_given(name, system)
            width = None if given or name not in widths else widths[name]
            between = None
            if ends is not None and not given:
                place = names.index(name)
                between = ends.least[place].item(), ends.most[place].item()
            found.append(
                Element(
                    name=name,
                    unit=self.results.units.of(column.kind),
                    value=self.value(name),
                    deviation=None if given else self.value(f"sd_{name}"),
                    half_width=None if width is None else width[self.number].item(),
                    by_likelihood=between,
                )
            )
        return found

    @property
    def correlations(self) -> dict[str, float]:
        """Correlation of every two elements, "first/second"; empty where not usable."""
        if not self.usable:
            return {}
        matrix = self.results.of_pairs["correlation"][self.number]
        pairs = combinations(enumerate(self.results.system.names), 2)
        return {f"{a}/{b}": float(matrix[i, j]) for (i, a), (j, b) in pairs}

    @property
    def pattern(self) -> Pattern | None:
        """Whether residuals of neighbouring points agree; None where nothing tells."""
        return self.results.patterns.get(self.number)

    @property
    def promise(self) -> AfterCleaning | None:
        """What its intervals really hold; None where that was not simulated."""
        return self.results.promises.get(self.number)

    @property
    def causes(self) -> list[str]:
        """What is to be read before anything else of the pair."""
        return self.results.causes.get(self.number, [])

    @property
    def rotation(self) -> PureRotation | None:
        """The rotation of a pair without a base; None of other pairs."""
        return self.results.rotations.get(self.number)


def find_rotations(pairs: Ragged, of_pairs: dict[str, Any]) -> dict[int, PureRotation]:
    """The rotations of pairs whose base is zero, by the numbers of the pairs; of the
    first MOST_PAIRS."""
    still = [k for k, name in RESULT_NAMES.items() if name == "zero_base"]
    chosen = np.flatnonzero(np.isin(of_pairs["result"], still))[:MOST_PAIRS]

    def find(number: int) -> PureRotation:
        size = int(pairs.lengths[number])
        padded = pairs.pad_to(np.array([number]), size)
        return orient_rotation(jax.tree.map(lambda a: a[0], padded))

    return {int(number): find(number) for number in chosen}


USUAL = 0.95
"""The confidence of intervals by likelihood where none was asked for."""

SAME_SQUARES = 1e-6
"""Relative difference of Σ r² from sigma0² (n - 5) that is not rounding: the elements
are then not those of least squares."""


def find_intervals(
    pairs: Ragged,
    of_pairs: dict[str, Any],
    system: type[AbstractElements],
    sigma_known: bool,
    confidence: float | None = None,
) -> dict[int, likelihood.Interval]:
    """The intervals by likelihood of the reported numbers of pairs with a large
    curvature, by the numbers of the pairs; of the first MOST_PAIRS. Of pairs whose
    weights have faded those by the sum of squares with these weights, as wide near the
    elements as their deviations say."""
    curved = is_usable(of_pairs["result"]) & (of_pairs["curvature"] > likelihood.CURVED)
    chosen = np.flatnonzero(curved)[:MOST_PAIRS]
    confidence = USUAL if confidence is None else confidence
    found = {}
    for number in chosen.tolist():
        batch = pairs.pad_to(np.array([number]), sizes(pairs.lengths[[number]], 1)[0])
        pair = jax.tree.map(lambda a: a[0], batch)
        of_pair = lambda name, number=number: of_pairs[name][number]
        sigma0, freedom = of_pair("sigma0"), of_pair("degrees_of_freedom")
        known = critical_values.normal(1 - confidence)
        own = critical_values.half_width(confidence, freedom) * sigma0
        limit = float(known if sigma_known else own) ** 2
        base = of_pair("bx") if system is DependentElements else 1.0
        asked = pair, of_pair("pose"), base, limit
        squares, interval = _find_interval(*asked, system=system)
        expected, there = sigma0**2 * freedom, True
        if freedom and abs(squares - expected) > SAME_SQUARES * expected:
            cofactor = of_pair("cofactor")
            there, interval = _find_faded(*asked, cofactor, sigma0, system=system)
        if there:
            found[number] = jax.tree.map(np.asarray, interval)
    return found


@compiled
def _find_interval(
    pair: Pair,
    pose: Float[Array, "7"],
    base: Float[Array, ""],
    limit: Float[Array, ""],
    *,
    system: type[AbstractElements],
) -> tuple[Float[Array, ""], likelihood.Interval]:
    """Σ r² at a pose, and the ends of the numbers that are reported of it in a system
    with this given length of the base."""
    elements = convert(RelativePose(*pose), system, base)
    ends = likelihood.ends(pair, elements, limit, quantity=report_numbers)
    return likelihood.misfit(pair, elements), ends


AT_MINIMUM = 0.1
"""Of a deviation: weights by which the minimum is farther from the pose than this are
not those that it was solved with."""


@compiled
def _find_faded(
    pair: Pair,
    pose: Float[Array, "7"],
    base: Float[Array, ""],
    limit: Float[Array, ""],
    cofactor: Float[Array, "5 5"],
    sigma0: Float[Array, ""],
    *,
    system: type[AbstractElements],
) -> tuple[Bool[Array, ""], likelihood.Interval]:
    """The same with the weights that have faded, and whether the pose is where they have
    their minimum. `limit`: as of a pair without; `cofactor` and `sigma0`: of the
    M-estimate."""
    relative = RelativePose(*pose)
    elements = convert(relative, system, base)
    weaker = fade_again(mask_unusable(pair)[0], relative)
    n, right, _ = linearise(weaker, elements).normal_equations()
    plain, right = normal.dense(normal.inverse(n)[0]), jnp.stack(right)
    away = plain @ right
    in_deviations = away @ right / sigma0**2
    moved = lambda x: report_numbers(elements, elements.move(x).normalise())
    slope = jax.jacfwd(moved)(jnp.zeros(5))
    variance = lambda q: jnp.sum((slope @ q) * slope, axis=1)
    wider = variance(cofactor) / variance(plain)
    ends = likelihood.ends(weaker, elements, limit * wider, quantity=report_numbers)
    return in_deviations < AT_MINIMUM**2, ends


def find_patterns(pairs: Ragged, of_pairs: dict[str, Any]) -> dict[int, Pattern]:
    """Whether residuals of neighbouring points agree, by the numbers of the pairs; of
    some pairs."""
    tells = is_usable(of_pairs["result"]) & (of_pairs["degrees_of_freedom"] >= 2)
    return table_neighbours.find(pairs, of_pairs["pose"], tells)
