"""Oriented pairs as reports need them: NumPy values of the measured points, degrees,
names and units.

The terminal report and the files of --out read the same `Solution`s. Where a result is
not usable its elements, m_q and sigma0 are NaN here; the y-parallaxes, corrections and
`in_front` stay where they say which points are at fault.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..adjustment import critical_values
from ..adjustment.guarded import root
from ..assessment import Pattern, neighbours
from ..assessment.reliability import Reliability, assess
from ..geometry import rotations as rot
from ..geometry.elements import AbstractElements, DependentElements, RelativePose
from ..geometry.linear import Linear, linearise
from ..geometry.pairs import Camera, Coordinates, Pair, mask_unusable
from ..orientation.result import Orientation
from ..orientation.results import RESULTS
from ..tables.csv import Measurements
from ..xla.programs import Program
from ..xla.settings import COMPILE_FAST, RUN_FAST

NAMES = {int(item._value): name for name, item in RESULTS._name_to_item.items()}
"""Names of the results by their number."""

ADVICE = {name: RESULTS[item] for name, item in RESULTS._name_to_item.items()}
"""The sentence of each result, empty for a plain success."""

WARNED = ("no_redundancy", "two_solutions")
"""Usable results with something to mind."""


MOST_POINTS = 200
"""Points of a pair whose residuals are looked at together: of more, every second,
third, ... one."""

MOST_PAIRS = 100
"""Pairs of a table whose residuals are tested for a pattern: of more, every second,
third, ... one."""


@dataclass(frozen=True)
class Units:
    """Units of the photo coordinates, of base and model, and of sigma0 ("" where it is
    a ratio to given sigmas)."""

    photo: str
    model: str
    sigma0: str


@dataclass(frozen=True)
class Element:
    """One reported number of an orientation; `deviation` is None for what is given, not
    adjusted, and `half_width`, that of its interval, where none was asked for."""

    name: str
    unit: str
    value: float
    deviation: float | None
    half_width: float | None = None


class Solved(NamedTuple):
    """An orientation as it comes from the engine, the corrections of the coordinates,
    the numbers that are reported of its elements, and, if asked, its reliability, and
    the linearised conditions with the coordinates they stand at."""

    orientation: Orientation
    corrections: Coordinates
    elements: tuple[list[Array], list[Array]]
    reading: Reliability | None
    conditions: tuple[Linear, Coordinates] | None


def read(
    orientation: Orientation, pair: Pair, reliable: bool, sigma_known: bool
) -> Solved:
    """The orientation of a pair (or of a batch) with what is told of its points.

    `reliable`: whether it is the minimum that reliability is defined for;
    `sigma_known`: whether pair.sigma are true standard deviations.
    """
    testable = (
        sigma_known or np.max(np.asarray(orientation.degrees_of_freedom), initial=0) > 1
    )
    options = {
        "reliable": reliable and bool(testable),
        "sigma0": jnp.ones(()) if sigma_known else None,
    }
    one = jnp.ndim(orientation.sigma0) == 0
    # one program: the command line loads it in each of its calls
    return Solved(
        orientation,
        *Program(
            _told if one else _all_told, options, COMPILE_FAST if one else RUN_FAST
        )((pair, orientation)),
    )


def _told(read: tuple[Pair, Orientation], *, reliable: bool, sigma0) -> tuple:
    pair, o = read
    elements = element_values(o.elements, o.cofactor, o.sigma0)
    if not reliable:
        return o.corrections(pair), elements, None, None
    used = mask_unusable(pair)[0]
    conditions = linearise(used, o.pose), used.coordinates
    return o.corrections(pair), elements, assess(pair, o, sigma0=sigma0), conditions


def _all_told(read: tuple[Pair, Orientation], **options) -> tuple:
    return jax.vmap(lambda *one: _told(one, **options))(*read)


@dataclass(frozen=True)
class Solution:
    """One pair, its cameras, its finished orientation and the elements that are
    shown."""

    measured: Measurements
    cameras: tuple[Camera, Camera]
    orientation: Orientation
    corrections: tuple[Any, ...]
    reading: Reliability | None
    elements: list[Element]
    interval: "Interval | None" = None
    conditions: tuple[Linear, tuple[Any, ...]] | None = None

    @cached_property
    def pattern(self) -> Pattern | None:
        """Whether residuals of neighbouring points agree, of at most MOST_POINTS
        points; None where nothing tells."""
        if (
            self.conditions is None
            or not self.usable
            or int(self.orientation.degrees_of_freedom) < 2
        ):
            return None
        used = np.flatnonzero(self.conditions[0].weight > 0)
        used = used[:: -(-len(used) // MOST_POINTS)]
        return neighbours.of_linear(*jax.tree.map(lambda a: a[used], self.conditions))

    @cached_property
    def result(self) -> str:
        """The name of the result."""
        return _result(self.orientation)

    @cached_property
    def advice(self) -> str:
        """The sentence of the result, empty for a plain success."""
        return ADVICE[self.result]

    @cached_property
    def usable(self) -> bool:
        """Whether the elements may be used."""
        return _usable(self.orientation)

    @cached_property
    def m_q(self) -> float:
        return float(self.orientation.m_q) if self.usable else np.nan

    @cached_property
    def sigma0(self) -> float:
        return float(self.orientation.sigma0) if self.usable else np.nan

    @cached_property
    def points(self) -> list[dict[str, Any]]:
        """The values of every point: q, the four corrections, redundancy number, model
        X Y Z, in_front."""
        o = self.orientation
        shown = self.usable or self.result == "points_behind_camera"
        count = len(self.measured.points)  # padding comes after them
        numbers = np.stack([o.parallax, *self.corrections, o.redundancy, *o.model])[
            :, :count
        ]
        if not shown:
            numbers = np.full_like(numbers, np.nan)
        elif not self.usable:
            numbers[5:] = np.nan
        keys = (
            "q",
            "v_x_left",
            "v_y_left",
            "v_x_right",
            "v_y_right",
            "redundancy",
            "X",
            "Y",
            "Z",
        )
        front = [bool(f) if shown else None for f in o.in_front[:count]]
        return [
            {"point": name, **dict(zip(keys, values, strict=True)), "in_front": f}
            for name, values, f in zip(
                self.measured.points, numbers.T.tolist(), front, strict=True
            )
        ]

    @cached_property
    def correlations(self) -> dict[str, float]:
        """Correlation of every two elements, "first/second"; empty where not usable."""
        if not self.usable:
            return {}
        names, values = (
            type(self.orientation.elements).names,
            self.orientation.correlation,
        )
        return {
            f"{names[i]}/{names[j]}": float(values[i, j])
            for i in range(5)
            for j in range(i + 1, 5)
        }


def _result(orientation: Orientation) -> str:
    return NAMES[int(orientation.result._value)]


def _usable(orientation: Orientation) -> bool:
    return _result(orientation) in ("successful", *WARNED)


def element_values(
    found: AbstractElements, cofactor: Array, sigma0: Array
) -> tuple[list[Array], list[Array]]:
    """The numbers that are reported of elements and their standard deviations: angles
    in degrees.

    Of a `RelativePose`: the unit base vector and the angles of M = R3(kappa) R2(phi)
    R1(omega), with sqrt(diag(J C Jᵀ)). Of `DependentElements` bx first, which is given:
    deviation 0.
    """
    degrees = lambda numbers, angles: [
        jnp.rad2deg(n) if angle else n for n, angle in zip(numbers, angles, strict=True)
    ]
    if not isinstance(found, RelativePose):
        bx = [found.bx] if isinstance(found, DependentElements) else []
        angles, zero = (
            (False,) * len(bx) + found.angles,
            [jnp.zeros_like(sigma0)] * len(bx),
        )
        deviations = [sigma0 * root(cofactor[i, i]) for i in range(5)]
        return degrees([*bx, *found.values()], angles), degrees(
            [*zero, *deviations], angles
        )

    def values(*step: Array) -> tuple[Array, ...]:
        rotation, base = found.move(step).relative()
        return (*base, *rot.omega_phi_kappa(rot.transpose(rotation)))

    zero = (jnp.zeros_like(sigma0),) * 5
    jacobian = jax.jacfwd(values, argnums=tuple(range(5)))(*zero)
    variance = lambda row: sum(
        (row[i] * row[j] * cofactor[i, j] for i in range(5) for j in range(5)), zero[0]
    )
    angles = (False,) * 3 + (True,) * 3
    return degrees(values(*zero), angles), degrees(
        [sigma0 * root(variance(row)) for row in jacobian], angles
    )


def element_names(system: type[AbstractElements]) -> tuple[str, ...]:
    """Names of the numbers that are reported."""
    if system is RelativePose:
        return "bx", "by", "bz", "omega", "phi", "kappa"
    return ("bx", *system.names) if system is DependentElements else system.names


def unit_of(name: str, units: Units) -> str:
    """The unit of such a number."""
    return (
        "deg"
        if name not in ("bx", "by", "bz")
        else ""
        if units.model == "bases"
        else units.model
    )


def given(name: str, system: type[AbstractElements]) -> bool:
    """Whether such a number is given, not adjusted."""
    return system is DependentElements and name == "bx"


class Interval(NamedTuple):
    """What was asked for: the probability, and whether the sigmas are true standard
    deviations."""

    confidence: float
    sigma_known: bool

    def factor(self, o: Orientation) -> float:
        """Half width over the standard deviation a posteriori: of Student's t, or of a
        normal number and sigma0 = 1."""
        if self.sigma_known:
            sigma0 = float(o.sigma0)
            return (
                float(critical_values.normal(1 - self.confidence)) / sigma0
                if sigma0 > 0
                else np.nan
            )
        return float(
            critical_values.half_width(self.confidence, int(o.degrees_of_freedom))
        )


def shown_elements(
    found: Solved, units: Units, interval: Interval | None = None
) -> list[Element]:
    """The elements of an orientation with their standard deviations, NaN where it is
    not usable."""
    system = type(found.orientation.elements)
    factor = None if interval is None else interval.factor(found.orientation)
    known = float if _usable(found.orientation) else lambda number: np.nan
    return [
        Element(
            name,
            unit_of(name, units),
            known(value),
            None if given(name, system) else known(deviation),
            None
            if factor is None or given(name, system)
            else known(deviation) * factor,
        )
        for name, value, deviation in zip(
            element_names(system), *found.elements, strict=True
        )
    ]


def solutions(
    measured: list[Measurements],
    cameras: list[tuple[Camera, Camera]],
    found: list[Solved],
    units: Units,
    interval: Interval | None = None,
) -> list[Solution]:
    """One `Solution` a pair, the elements of unusable ones NaN."""
    return [
        Solution(
            measured=m,
            cameras=c,
            orientation=s.orientation,
            corrections=s.corrections,
            reading=s.reading,
            elements=shown_elements(s, units, interval),
            interval=interval,
            conditions=s.conditions,
        )
        for m, c, s in zip(measured, cameras, found, strict=True)
    ]


def with_pattern(solved: list[Solution]) -> list[Solution]:
    """The pairs that are tested for a pattern in their residuals, at most
    MOST_PAIRS."""
    return solved[:: max(1, -(-len(solved) // MOST_PAIRS))]


def pattern_of_all(solved: list[Solution]) -> Pattern | None:
    """The test of all pairs together, from those `with_pattern`; None where nothing
    tells."""
    found = [s.pattern for s in with_pattern(solved) if s.pattern is not None]
    return (
        neighbours.pool(jax.tree.map(lambda *a: np.stack(a), *found)) if found else None
    )
