"""What is written of a pair, of its points and of a decision: one list of columns.

The files of --out, CSV and Parquet, and the reports on the terminal read this list. A
column has a name, a kind of unit, and the function that reads it from an oriented pair.
A number that does not exist is NaN; of whole numbers, -1.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from enum import Enum
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Int

from ..assessment.reliability import CONTROL
from ..geometry.elements import AbstractElements, DependentElements, RelativePose
from ..orientation.results import RESULTS
from ..rejection import OUTCOMES
from ..tables.measured import COORDINATES, NUMBERS, PHOTOS, VERDICTS


def _names_and_sentences(kind: Any) -> tuple[dict[int, str], dict[str, str]]:
    """Of an enumeration the names by number, and the sentences by name."""
    items = kind._name_to_item.items()
    return (
        {int(item._value): name for name, item in items},
        {name: kind[item] for name, item in items},
    )


RESULT_NAMES, RESULT_ADVICE = _names_and_sentences(RESULTS)
"""Names of the results of an orientation by their number, and the advice of each."""

OUTCOME_NAMES, OUTCOME_ADVICE = _names_and_sentences(OUTCOMES)
"""The same of the outcomes of a procedure."""

WARNED = ("no_redundancy", "two_solutions")
"""Usable results with something to mind."""

USABLE = ("successful", *WARNED)
"""Results whose elements may be used."""


def is_usable(results: Int[np.ndarray, " pair"]) -> Bool[np.ndarray, " pair"]:
    """Whether the elements may be used, by the numbers of the results."""
    return np.isin(results, [k for k, name in RESULT_NAMES.items() if name in USABLE])


TABLES = ("elements", "residuals", "points", "reliability")
"""The tables by name; the first is always written."""


class Kind(Enum):
    """Kinds of units."""

    NONE = "none"
    ANGLE = "angle"
    PHOTO = "photo"
    MODEL = "model"
    BASE = "base"
    SIGMA0 = "sigma0"


@dataclass(frozen=True)
class Units:
    """Units of the photo coordinates, of base and model, and of sigma0 ("" where it is
    a ratio to given sigmas)."""

    photo: str
    model: str
    sigma0: str

    def of(self, kind: Kind) -> str:
        """The unit of a kind of number, "" where it has none."""
        base = "" if self.model == "bases" else self.model
        return {
            Kind.NONE: "",
            Kind.ANGLE: "deg",
            Kind.PHOTO: self.photo,
            Kind.MODEL: self.model,
            Kind.BASE: base,
            Kind.SIGMA0: self.sigma0,
        }[kind]


@dataclass(frozen=True)
class Column:
    """A column: its name without the unit, and the kind of its unit.

    `of`: reads it from an oriented pair (`reader.Told`); without it the command that writes
    the column has its values. `there`: the condition under which the values exist:
    "usable" elements, residuals that are "shown"; "" for always. `source`: the column
    that has the values, where it is not this one. `names`: texts that are written for
    whole numbers. `only`: the kind of file that has the column, "csv" or "parquet"; ""
    for both, "no" for neither.
    `infinity`: how CSV text writes an infinite value, which else is an empty field.
    """

    name: str
    kind: Kind = Kind.NONE
    of: Callable[[Any], Any] | None = None
    there: str = ""
    source: str = ""
    names: Mapping[int, str] = field(default_factory=dict)
    only: str = ""
    infinity: str = ""

    def head(self, units: Units) -> str:
        """The header of the column."""
        return head(self.name, units.of(self.kind))

    def hide(self, values: np.ndarray, missing: dict[str, np.ndarray]) -> np.ndarray:
        """The values, NaN or -1 where they do not exist; `missing`: the places without
        values by condition. Truths become whole numbers, which -1 may stand beside."""
        places = missing.get(self.there)
        if values.dtype == bool and self.there:
            values = values.astype(np.int8)
        if places is None or not places.size:
            return values
        values = values if values.flags.writeable else values.copy()
        values[places] = np.nan if values.dtype.kind == "f" else -1
        return values


def head(name: str, unit: str) -> str:
    """The header of a column of this name and unit."""
    return f"{name}_{unit}" if unit else name


def _orientation(name: str) -> Callable[[Any], Any]:
    """Reads a field of the orientation."""
    return lambda told: getattr(told.orientation, name)


def _entry(name: str, place: int) -> Callable[[Any], Any]:
    """Reads an entry of a tuple of `Told`."""
    return lambda told: getattr(told, name)[place]


def _reliability(name: str, place: int | None = None) -> Callable[[Any], Any]:
    """Reads a field of the reliability, or an entry of it."""

    def read(told: Any) -> Any:
        values = getattr(told.reliability, name)
        return values if place is None else values[place]

    return read


PAIR = Column("pair")
POINT = Column("point")

BEFORE_ELEMENTS = (
    PAIR,
    Column("outcome", names=OUTCOME_NAMES, only="parquet"),
    Column(
        "result", of=lambda told: told.orientation.result._value, names=RESULT_NAMES
    ),
    Column("points"),
    Column("used", only="parquet"),
    Column("degrees_of_freedom", of=_orientation("degrees_of_freedom")),
    Column("iterations", of=_orientation("iterations")),
)

BEHIND_ELEMENTS = (
    Column("m_q", Kind.PHOTO, of=_orientation("m_q"), there="usable"),
    Column("sigma0", Kind.SIGMA0, of=_orientation("sigma0"), there="usable"),
    Column("curvature", of=lambda told: told.curvature, there="usable"),
    Column(
        "advice",
        source="result",
        names={k: RESULT_ADVICE[name] for k, name in RESULT_NAMES.items()},
        only="csv",
    ),
    Column("causes"),
    Column("correlation", of=_orientation("correlation"), there="usable", only="no"),
    Column("cofactor", of=_orientation("cofactor"), there="usable", only="no"),
    Column(
        "pose",
        of=lambda told: jnp.stack(jax.tree.leaves(told.orientation.pose)),
        only="no",
    ),
)

RESIDUALS = (
    PAIR,
    POINT,
    Column("q", Kind.PHOTO, of=lambda told: told.parallax, there="shown"),
    *(
        Column(f"v_{c}", Kind.PHOTO, of=_entry("corrections", k), there="shown")
        for k, c in enumerate(COORDINATES)
    ),
    Column("redundancy", of=_orientation("redundancy"), there="usable"),
    Column("in_front", of=_orientation("in_front"), there="shown"),
)

OWN = tuple(f"own_{a}{b}" for k, a in enumerate("XYZ") for b in "XYZ"[: k + 1])
"""The root of the covariance that a model point has for itself, row by row."""

COMMON = tuple(f"common_{axis}{k}" for axis in "XYZ" for k in range(1, 6))
"""What the errors of the elements do to a model point: the derivatives by them times
the root of their covariance, row by row."""

POINTS = (
    PAIR,
    POINT,
    *(
        Column(
            axis,
            Kind.MODEL,
            of=lambda told, k=k: told.orientation.model[k],
            there="usable",
        )
        for k, axis in enumerate("XYZ")
    ),
    *(
        Column(name, Kind.MODEL, there="usable")
        for name in ("sX", "sY", "sZ", *OWN, *COMMON)
    ),
)

RELIABILITY = (
    PAIR,
    POINT,
    Column("redundancy", of=_reliability("redundancy"), there="usable"),
    Column(
        "w", of=lambda told: told.where_testable(told.reliability.w), there="usable"
    ),
    Column(
        "limit",
        of=lambda told: told.where_testable(told.reliability.limit),
        there="usable",
    ),
    Column("external_reliability", of=_reliability("external"), there="usable"),
    *(
        Column(
            f"control_{c}",
            of=_entry("control", k),
            there="usable",
            names=dict(enumerate(CONTROL)),
            only="csv",
        )
        for k, c in enumerate(COORDINATES)
    ),
    *(
        Column(
            f"detectable_{c}",
            Kind.PHOTO,
            of=_reliability("detectable", k),
            there="usable",
        )
        for k, c in enumerate(COORDINATES)
    ),
    *(
        Column(
            f"effect_on_Z_of_{c}",
            Kind.MODEL,
            of=_reliability("effect_height", k),
            there="usable",
        )
        for k, c in enumerate(COORDINATES)
    ),
)

CLEANED = (
    PAIR,
    *(Column(name) for name in PHOTOS),
    POINT,
    *(Column(name) for name in NUMBERS),
    Column("verdict", names=VERDICTS, only="csv"),
    Column("kept", only="parquet"),
    Column("undecided", only="parquet"),
    Column("other_solution", only="parquet"),
    Column("order"),
    Column("statistic", infinity="inf"),
    Column("limit"),
    Column("q", Kind.PHOTO),
)

ROUNDS = (
    PAIR,
    Column("round"),
    POINT,
    Column("statistic", infinity="inf"),
    Column("limit"),
    Column("rejected"),
    Column("parallax", Kind.PHOTO),
)


def columns_of(table: str, system: type[AbstractElements]) -> tuple[Column, ...]:
    """The columns of a table in their order; of elements those of the system."""
    if table == "elements":
        return BEFORE_ELEMENTS + element_columns(system) + BEHIND_ELEMENTS
    return {
        "residuals": RESIDUALS,
        "points": POINTS,
        "reliability": RELIABILITY,
        "cleaned": CLEANED,
        "decisions": ROUNDS,
    }[table]


def element_columns(system: type[AbstractElements]) -> tuple[Column, ...]:
    """Every element of a system and its standard deviation; a given one has none."""
    columns = []
    for place, name in enumerate(element_names(system)):
        kind = Kind.BASE if name in ("bx", "by", "bz") else Kind.ANGLE
        read = lambda told, which, place=place: told.elements[which][place]
        column = partial(Column, kind=kind, there="usable")
        columns.append(column(name, of=partial(read, which=0)))
        if not is_given(name, system):
            columns.append(column(f"sd_{name}", of=partial(read, which=1)))
    return tuple(columns)


def element_names(system: type[AbstractElements]) -> tuple[str, ...]:
    """Names of the numbers that are reported."""
    if system is RelativePose:
        return "bx", "by", "bz", "omega", "phi", "kappa"
    return ("bx", *system.names) if system is DependentElements else system.names


def is_given(name: str, system: type[AbstractElements]) -> bool:
    """Whether such a number is given, not adjusted."""
    return system is DependentElements and name == "bx"
