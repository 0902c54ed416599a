"""Orientations of many pairs as columns: what the files of --out hold of a pair, of its
points and of its model.

The columns and their units are those of elements.csv, residuals.csv, points.csv and
reliability.csv (with `used`, the points that take part, and without advice); what does
not exist is NaN here, null in a table.
"""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
import pyarrow as pa
from jaxtyping import Array

from ..assessment.reliability import assess
from ..geometry import coplanarity
from ..geometry.elements import (
    AbstractElements,
    DependentElements,
    IndependentElements,
    RelativePose,
)
from ..geometry.pairs import Pair
from ..orientation.result import Orientation
from ..orientation.results import RESULTS
from ..xla.passes import count
from .files import POINTS, RESIDUALS, head
from .solutions import Units, element_names, element_values, given, unit_of

COORDINATES = ("x_left", "y_left", "x_right", "y_right")

TABLES = ("elements", "residuals", "points", "reliability")
"""The tables by name; the first is always written."""

SYSTEMS = (RelativePose, DependentElements, IndependentElements)

Columns = dict[str, Array]


class Recorder(NamedTuple):
    """read(pair, orientation) -> columns of the pair, {table: columns of the points},
    for tables of any size."""

    system: type[AbstractElements]
    tables: tuple[str, ...]
    sigma_known: bool
    all_parallaxes: bool = False

    def __call__(
        self, pair: Pair, orientation: Orientation
    ) -> tuple[Columns, dict[str, Columns]]:
        """The columns, NaN where the orientation is not usable."""
        o = orientation
        good = lambda value: jnp.where(o.usable, value, jnp.nan)
        values, deviations = element_values(o.elements, o.cofactor, o.sigma0)
        of_pair = {"result": o.result._value, "used": count(pair.mask).astype(int)}
        of_pair |= {
            "degrees_of_freedom": o.degrees_of_freedom,
            "iterations": o.iterations,
        }
        for name, value, deviation in zip(
            element_names(self.system), values, deviations, strict=True
        ):
            of_pair |= {name: good(value)} | (
                {} if given(name, self.system) else {f"sd_{name}": good(deviation)}
            )
        of_pair |= {"m_q": good(o.m_q), "sigma0": good(o.sigma0)}
        return of_pair, {
            name: getattr(self, name)(pair, o)
            for name in self.tables
            if name != "elements"
        }

    def residuals(self, pair: Pair, o: Orientation) -> Columns:
        """Parallaxes and corrections, also where points lie behind a photo: they say
        which."""
        told = o.usable | (o.result == RESULTS.points_behind_camera)
        there = lambda value: jnp.where(told, value, jnp.nan)
        v = {
            f"v_{c}": there(value)
            for c, value in zip(COORDINATES, o.corrections(pair), strict=True)
        }
        front = jnp.where(told, o.in_front.astype(jnp.int8), jnp.int8(-1))
        q = coplanarity.parallaxes(pair, o.pose) if self.all_parallaxes else o.parallax
        return {
            "q": there(q),
            **v,
            "redundancy": jnp.where(o.usable, o.redundancy, jnp.nan),
            "in_front": front,
        }

    def points(self, pair: Pair, o: Orientation) -> Columns:
        """Model points."""
        return {
            name: jnp.where(o.usable, c, jnp.nan)
            for name, c in zip(POINTS, o.model, strict=True)
        }

    def reliability(self, pair: Pair, o: Orientation) -> Columns:
        """What the measurements tell of errors in each other; infinite: an error of any
        size may hide."""
        r = assess(
            pair, o, sigma0=jnp.ones_like(o.sigma0) if self.sigma_known else None
        )
        good = lambda value: jnp.where(o.usable, value, jnp.nan)
        tested = lambda value: jnp.where(r.testable, value, jnp.nan)
        out = {
            "redundancy": good(r.redundancy),
            "w": tested(r.w),
            "limit": tested(r.limit),
        }
        out["external_reliability"] = good(r.external)
        out |= {
            f"detectable_{c}": good(value)
            for c, value in zip(COORDINATES, r.detectable, strict=True)
        }
        effects = zip(COORDINATES, r.effect_height, strict=True)
        return out | {f"effect_on_Z_of_{c}": good(value) for c, value in effects}


COLUMNS = {
    "residuals": RESIDUALS,
    "points": POINTS,
    "reliability": (
        *("redundancy", "w", "limit", "external_reliability"),
        *(f"detectable_{c}" for c in COORDINATES),
        *(f"effect_on_Z_of_{c}" for c in COORDINATES),
    ),
}
"""The columns of the points in their order, by table."""


def element_columns(system: type[AbstractElements]) -> tuple[str, ...]:
    """The columns of a pair in their order."""
    each = [
        (name,) if given(name, system) else (name, f"sd_{name}")
        for name in element_names(system)
    ]
    return (
        "result",
        "points",
        "used",
        "degrees_of_freedom",
        "iterations",
        *sum(each, ()),
        "m_q",
        "sigma0",
    )


def header(name: str, units: Units) -> str:
    """The name of a column with its unit, as in the CSV files."""
    bare = name.removeprefix("sd_")
    if any(bare in element_names(system) for system in SYSTEMS):
        unit = unit_of(bare, units)
    elif bare == "sigma0":
        unit = units.sigma0
    elif bare in POINTS or bare.startswith("effect_on_Z"):
        unit = units.model
    else:
        unit = units.photo if bare.startswith(("q", "v_", "m_q", "detectable")) else ""
    return head(name, unit)


def table(named: dict[str, Any], values: dict[str, Any], units: Units) -> Any:
    """An Arrow table of columns as they are and of values, whose headers get their
    units."""
    return pa.table(
        {**named, **{header(name, units): _column(v) for name, v in values.items()}}
    )


def names_of(numbers: np.ndarray, names: dict[int, str]) -> Any:
    """Names instead of numbers, as an Arrow column."""
    known = pa.array([names.get(i, "") for i in range(max(names) + 1)])
    return pa.DictionaryArray.from_arrays(pa.array(numbers.astype(np.int8)), known)


def where(values: np.ndarray, there: np.ndarray) -> Any:
    """An Arrow column, null where the value is not `there`."""
    return pa.array(values, mask=~there)


def _column(values: Any) -> Any:
    """An Arrow column, null where the value is NaN (or, of a small integer for yes and
    no, negative)."""
    if not isinstance(values, np.ndarray):
        return values
    if values.dtype == np.int8:
        return pa.array(values > 0, mask=values < 0 if np.any(values < 0) else None)
    if values.dtype.kind == "f":
        return pa.array(values, from_pandas=bool(np.isnan(values).any()))
    return pa.array(values)
