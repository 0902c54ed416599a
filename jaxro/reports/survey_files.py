"""A finished survey over a grid as names and NumPy values, and the content of its
files."""

import math
from dataclasses import astuple, dataclass
from typing import Any, NamedTuple

import jax
import numpy as np

from ..adjustment.results import RESULTS
from ..surveys import grid_survey
from ..tables.fields import TableError
from ..tables.survey import Named
from . import files

DOUBTFUL = 4.0
"""Standard deviations by which a known height may differ from what is read there."""


@dataclass(frozen=True)
class Traverse:
    """A traverse between nodes as it is reported (mm): `names` of the user's traverses
    it is part of."""

    names: str
    first: str
    last: str
    legs: int
    misclosure: float
    deviation: float
    w: float
    detectable: float
    redundancy: float

    @property
    def error(self) -> float:
        """What an error of one leg would have to be to leave this misclosure."""
        return (
            -self.misclosure / self.redundancy if self.redundancy > 1e-6 else math.nan
        )


class Closure(NamedTuple):
    """A traverse of the user that is closed or leads from one known height to another:
    sum of its legs less the difference of these heights, and its standard deviation by
    the readings of the legs (mm)."""

    name: str
    legs: int
    misclosure: float
    deviation: float


@dataclass(frozen=True)
class Done:
    """A finished survey with its names, as NumPy values."""

    named: Named
    found: grid_survey.Surveyed
    traverses: list[Traverse]
    closures: list[Closure]
    origin: list[str]

    @property
    def doubtful(self) -> list[int]:
        """Points whose known height is not what is read there."""
        known = np.asarray(self.named.survey.known)[: self.named.points]
        given, read, sd = (
            np.asarray(a)[: self.named.points]
            for a in (
                self.found.heights.value,
                self.found.heights.over_grid,
                self.found.deviations.over_grid,
            )
        )
        return np.flatnonzero(known & (np.abs(given - read) > DOUBTFUL * sd)).tolist()

    @property
    def suspicious(self) -> list[Traverse]:
        """Traverses beyond the limit, the worst and its equals first."""
        limit = float(self.found.limit)
        return sorted(
            (t for t in self.traverses if abs(t.w) > limit), key=lambda t: -abs(t.w)
        )


def calculate(named: Named) -> Done:
    """The survey calculated. Raises TableError where the network of its traverses has
    no solution."""
    found = jax.tree.map(np.asarray, grid_survey.solve(named.survey))
    adjusted = found.adjusted
    if adjusted is not None and int(adjusted.result._value) != int(
        RESULTS.successful._value
    ):
        expected = (
            "readings, lengths and standard deviations that are near one another in "
            "size"
        )
        raise TableError(
            "traverses", found="a network without a solution", expected=expected
        )
    one = jax.tree.map(np.asarray, named.survey)
    levelled, support, origin = set(one.levelled.tolist()), one.support, []
    for i in range(named.points):
        if one.known[i]:
            origin.append("known")
        elif i in levelled:
            origin.append("traverses")
        elif support[i] != i:
            origin.append(named.names[support[i]])
        else:
            origin.append("grid")
    return Done(
        named=named,
        found=found,
        traverses=_traverses(named, one, found),
        closures=_closures(named, one, found),
        origin=origin,
    )


def _traverses(named: Named, one, found: grid_survey.Surveyed) -> list[Traverse]:
    if one.network is None or found.adjusted is None:
        return []
    network, adjusted = one.network, found.adjusted
    nodes = np.concatenate([network.free, network.fixed])
    point = lambda node: named.names[one.levelled[nodes[node]]]
    result = []
    for k in range(len(network.first)):
        legs = network.leg[network.traverse == k]
        result.append(
            Traverse(
                names=", ".join(dict.fromkeys(named.traverses[leg] for leg in legs)),
                first=point(network.first[k]),
                last=point(network.last[k]),
                legs=len(legs),
                misclosure=float(found.heights.misclosure[k]),
                deviation=float(found.deviations.misclosure[k]),
                w=float(found.w[k]),
                detectable=float(found.detectable[k]),
                redundancy=float(adjusted.redundancy[k]),
            )
        )
    return result


def _closures(named: Named, one, found: grid_survey.Surveyed) -> list[Closure]:
    if found.adjusted is None:
        return []
    height, result = np.asarray(found.heights.value), []
    rises = height[one.end] - height[one.start] - found.adjusted.corrections
    variances = np.square(found.leg_deviations)
    for name in dict.fromkeys(named.traverses):
        legs = [k for k, other in enumerate(named.traverses) if other == name]
        first, last = one.start[legs[0]], one.end[legs[-1]]
        if first == last or (one.known[first] and one.known[last]):
            misclosure = float(np.sum(rises[legs]) - (height[last] - height[first]))
            result.append(
                Closure(
                    name, len(legs), misclosure, float(np.sqrt(np.sum(variances[legs])))
                )
            )
    return result


TRAVERSES = (
    *("traverse", "from", "to", "legs", "misclosure_mm", "sd_mm", "w"),
    *("detectable_mm", "redundancy"),
)
"""The header of traverses.csv: the fields of a `Traverse`."""


def contents(done: Done) -> dict[str, Any]:
    """The files of --out by name."""
    texts = {"heights.csv": files.columns_text(_heights(done))}
    adjusted = done.found.adjusted
    if done.traverses and adjusted is not None:
        rows = [TRAVERSES, *map(astuple, done.traverses)]
        texts["traverses.csv"] = files.csv_text(rows)
        names, survey = np.array(done.named.names, object), done.named.survey
        legs = {
            "traverse": done.named.traverses,
            "from": names[np.asarray(survey.start)],
            "to": names[np.asarray(survey.end)],
            "v_mm": adjusted.corrections.tolist(),
            "redundancy": adjusted.leg_redundancy.tolist(),
        }
        texts["legs.csv"] = files.columns_text(legs)
    return texts | {"summary.json": files.json_text(summary(done))}


def _heights(done: Done) -> dict[str, Any]:
    """The columns of heights.csv."""
    named, found = done.named, done.found
    own = lambda values: np.asarray(values)[: named.points].tolist()
    return {
        "point": named.names[: named.points],
        "square": [named.squares[k] for k in own(named.survey.square)],
        "height_mm": own(found.heights.value),
        "sd_mm": own(found.deviations.value),
        "from": done.origin,
        "over_grid_mm": own(found.heights.over_grid),
        "sd_over_grid_mm": own(found.deviations.over_grid),
        **{f"share_{name}": own(a) for name, a in found.shares._asdict().items()},
    }


def summary(done: Done) -> dict[str, Any]:
    """What summary.json says."""
    from .. import __version__

    measured, adjusted = done.named.survey.measured, done.found.adjusted
    network: dict[str, Any] = {}
    if adjusted is not None:
        network = {
            "degrees_of_freedom": int(adjusted.degrees_of_freedom),
            "sigma0": float(adjusted.sigma0),
            "limit": float(done.found.limit),
            "suspicious": [t.names for t in done.suspicious],
        }
    return {
        "program": f"jaxro {__version__}",
        "unit": "mm",
        "camera_height": float(measured.camera_height),
        "base": float(measured.base),
        "points": done.named.points,
        **network,
        "mean_shares": {
            name: float(np.mean(share)) for name, share in shares(done).items()
        },
    }


def shares(done: Done) -> dict[str, np.ndarray]:
    """The parts of the variance of every height that is not known, of 1."""
    free = done.found.deviations.value[: done.named.points] > 0
    return {
        name: share[: done.named.points][free]
        for name, share in done.found.shares._asdict().items()
    }
