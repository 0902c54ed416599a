"""An adjusted network with names and NumPy values, its tests, and the tables of --out of
`jaxro adjust`, in full precision."""

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from ..adjustment import RESULTS, critical_values as critical
from ..statistics.explanations import explanations
from ..statistics.familywise import largest_tau, largest_w
from ..statistics.groups import (
    GroupTests,
    assess_groups,
    estimated_probability,
    probability,
)
from ..statistics.identification import Identified, identify
from ..statistics.normalised import Normalised
from ..statistics.promise import Promise, Verdict, promise
from ..statistics.rows import Rows, normalise_rows, rows
from ..surveys.geodetic import KINDS, Solution, displacements
from ..tables.ground import GroundPoints
from ..tables.network import Measurement
from ..xla.programs import compiled
from . import files

AXES = ("X", "Y", "Z")


class Simulated(NamedTuple):
    """What is simulated: so many repetitions, each with so many wrong measurements whose
    errors are `size` standard deviations."""

    repetitions: int
    wrong: int
    size: float


@dataclass(frozen=True)
class Done:
    """A finished network. `names` of the points; `lines`: the measurements in the order
    of the terms; `angle`: radians of one unit of angles and its name. `sigma_known`:
    sigma0 is to be 1. `level`: of all tests together. `simulated`: what is promised of
    networks like this one."""

    title: str
    unit: str
    angle: tuple[float, str]
    names: list[str]
    lines: list[Measurement]
    ground: GroundPoints | None
    solution: Solution
    sigma_known: bool
    level: float
    seed: int = 0
    simulated: Simulated | None = None
    warnings: list[str] = field(default_factory=list)

    # ---------------------------------------------------------------------------------
    # what came of it

    @property
    def loose(self) -> list[str]:
        """The points that are not determined, though others are known."""
        return [self.names[k] for k in np.flatnonzero(self.solution.loose)]

    @property
    def result(self) -> str:
        if self.loose:
            return "not_determined"
        result = int(self.solution.adjusted.result._value)
        return next(
            name
            for name, item in RESULTS._name_to_item.items()
            if int(item._value) == result
        )

    @property
    def is_finite(self) -> bool:
        """Whether there are numbers at all: the search has not diverged."""
        return bool(np.all(np.isfinite(self.solution.coordinates)))

    @property
    def usable(self) -> bool:
        """Whether the numbers may be used: everything is determined, and no test
        rejects."""
        return self.result == "successful" and not self.wrong

    @property
    def freedom(self) -> int:
        return int(self.solution.adjusted.degrees_of_freedom)

    @property
    def sigma0(self) -> float:
        """The estimated standard deviation of unit weight; NaN without a degree of
        freedom."""
        return float(self.solution.adjusted.sigma0)

    @property
    def unit_weight(self) -> float:
        """What cofactors are multiplied with: 1 for given standard deviations unless
        sigma0 is larger than chance allows."""
        if not self.sigma_known:
            return self.sigma0
        return float(critical.trusted_sigma0(self.sigma0, self.freedom))

    @property
    def global_p(self) -> float:
        """Probability of a sigma0 as far from 1; 1 where it is not known."""
        if not (self.sigma_known and self.freedom > 0):
            return 1.0
        return float(critical.global_p(self.freedom * self.sigma0**2, self.freedom))

    # ---------------------------------------------------------------------------------
    # points

    @property
    def coordinates(self) -> Float[np.ndarray, "point 3"]:
        """Adjusted coordinates, NaN where the network has not got them."""
        there = self.solution.network.touched | self.solution.network.held
        return np.where(there, self.solution.coordinates, np.nan)

    @property
    def deviations(self) -> Float[np.ndarray, "point 3"]:
        """Their standard deviations: 0 where held, NaN where the network has not got
        them."""
        cofactors = np.asarray(self.solution.adjusted.cofactors("point"))
        variances = np.diagonal(cofactors, axis1=1, axis2=2)
        spread = self.unit_weight * np.sqrt(np.maximum(variances, 0.0))
        return np.where(np.isfinite(self.coordinates), spread, np.nan)

    # ---------------------------------------------------------------------------------
    # measurements

    @cached_property
    def rows(self) -> Rows:
        solution = self.solution
        return rows(solution.terms, solution.adjusted.parameters, held=solution.held)

    @cached_property
    def normalised(self) -> Normalised:
        return normalise_rows(self.rows)

    @cached_property
    def measurement(self) -> Int[np.ndarray, " row"]:
        """The place in `lines` of the measurement of every row."""
        sizes = [len(part.at) for part in self.solution.network.measured]
        begins = np.concatenate([[0], np.cumsum(sizes)])[:-1]
        return begins[self.rows.term] + self.rows.group

    @cached_property
    def tests(self) -> GroupTests:
        """Of every measurement, all its numbers together."""
        return assess_groups(
            self.normalised, self.measurement, sigma0_known=self.sigma_known
        )

    @cached_property
    def is_scalar(self) -> bool:
        """Whether every measurement is a single number."""
        return len(self.measurement) == len(self.lines)

    @cached_property
    def limit(self) -> float:
        """The probability below which a measurement is rejected: that of the largest
        |w| (|tau|, where sigma0 is estimated) by its correlations, with vectors that of
        Šidák."""
        if not self.is_scalar:
            count = max(int(np.sum(self.tests.freedom > 0)), 1)
            return float(critical.sidak(self.level, count))
        if self.sigma_known:
            return float(probability(self.largest**2, 1))
        square = (self.largest * self.sigma0) ** 2
        squares = self.freedom * self.sigma0**2
        return float(estimated_probability(square, 1, squares, self.freedom))

    @cached_property
    def largest(self) -> float:
        """What the largest |w| (|tau|) exceeds with the probability `level`."""
        limit = largest_w if self.sigma_known else largest_tau
        return float(compiled(limit)(self.level, self.normalised))

    @cached_property
    def wrong(self) -> list[int]:
        """The measurements of which one is wrong, as nothing tells them apart; empty if
        no test rejects."""
        if self.result != "successful" or self.freedom < 1:
            return []
        worst = int(np.argmin(self.tests.p))
        if self.tests.p[worst] >= self.limit:
            return []
        if not self.is_scalar:
            return [worst]
        row = int(np.argmax(np.abs(np.asarray(self.normalised.w))))
        named = compiled(explanations, static=("estimated",))(
            self.normalised, jnp.asarray(row), estimated=not self.sigma_known
        )
        return np.flatnonzero(np.asarray(named)).tolist()

    @cached_property
    def identified(self) -> Identified | None:
        """The errors that would be found, and attributed to their measurement; None with
        vectors, whose rows are no measurements."""
        if not self.is_scalar or self.freedom < 1:
            return None
        return identify(
            self.normalised,
            jax.random.key(self.seed),
            level=self.level,
            familywise=True,
        )

    @cached_property
    def promise(self) -> Promise | None:
        """What verdicts and intervals are worth in networks like this one; None where
        nobody asked, or nothing is tested."""
        if self.simulated is None or self.result != "successful" or self.freedom < 1:
            return None
        if not self.is_scalar:
            return None
        _, functions = displacements(self.solution)
        return promise(
            self.rows,
            jax.random.key(self.seed),
            wrong=self.simulated.wrong,
            size=self.simulated.size,
            functions=functions,
            level=self.level,
            estimated=not self.sigma_known,
            repetitions=self.simulated.repetitions,
        )

    def table(self) -> list[dict[str, Any]]:
        """Every measurement: its points, what was measured, residual, redundancy, test,
        and the errors that would be found and identified, in its unit; none of them
        where the search diverged."""
        found = []
        for k, line in enumerate(self.lines):
            unit = self.angle[0] if KINDS[line.kind].is_angle else 1.0
            row: dict[str, Any] = {
                "kind": line.kind,
                "points": "-".join(line.points),
                "value": " ".join(repr(float(v / unit)) for v in line.values),
            }
            found.append(row)
            if not self.is_finite:
                continue
            own = np.flatnonzero(self.measurement == k)
            residuals = line.root @ self.rows.residuals[own] / unit
            redundancy = np.asarray(self.normalised.redundancy)[own]
            row |= {
                "residual": " ".join(repr(float(v)) for v in residuals),
                "redundancy": float(np.sum(redundancy)),
                "p": float(self.tests.p[k]),
            }
            if self.is_scalar:
                row |= self._of_scalar(k, float(line.root[0, 0]) / unit)
        return found

    def _of_scalar(self, k: int, sigma: float) -> dict[str, Any]:
        """w (tau) of a number, and the errors of it that are detectable and
        identifiable."""
        unit = 1.0 if self.sigma_known else max(self.sigma0, 1e-300)
        tested = bool(np.asarray(self.normalised.tested)[k])
        w = float(np.asarray(self.normalised.w)[k]) / unit
        row: dict[str, Any] = {"w" if self.sigma_known else "tau": w}
        if self.identified is None:
            return row
        size = (
            unit * sigma / np.sqrt(float(np.asarray(self.normalised.redundancy)[k]))
            if tested
            else np.inf
        )
        partner = int(np.asarray(self.identified.partner)[k])
        return row | {
            "detectable": float(self.identified.found) * size,
            "identifiable": float(np.asarray(self.identified.identified)[k]) * size,
            "partner": "-".join(self.lines[partner].points) if tested else "",
            "correlation": float(np.asarray(self.identified.correlation)[k]),
        }


def contents(done: Done) -> dict[str, str]:
    """The files of --out by name."""
    points = [
        {
            "point": name,
            **{axis: _cell(value) for axis, value in zip(AXES, at, strict=True)},
            **{f"s{axis}": _cell(v) for axis, v in zip(AXES, spread, strict=True)},
        }
        for name, at, spread in zip(
            done.names, done.coordinates, done.deviations, strict=True
        )
    ]
    measurements = [
        {name: _cell(value) for name, value in row.items()} for row in done.table()
    ]
    return {
        "points.csv": files.rows_text(points),
        "measurements.csv": files.rows_text(measurements),
        "summary.json": files.json_text(summary(done)),
    }


def _cell(value: Any) -> Any:
    """A value as CSV holds it: nothing for NaN."""
    return None if isinstance(value, float) and np.isnan(value) else value


def summary(done: Done) -> dict[str, Any]:
    """The numbers of the report, for programs."""
    return {
        "network": done.title,
        "result": done.result,
        "usable": done.usable,
        "sigma0": done.sigma0,
        "sigma_known": done.sigma_known,
        "degrees_of_freedom": done.freedom,
        "global_p": done.global_p,
        "datum": done.solution.datum,
        "iterations": int(done.solution.adjusted.iterations),
        "limit_p": done.limit if done.is_finite and done.freedom > 0 else None,
        "wrong": ["-".join(done.lines[k].points) for k in done.wrong],
        "points": {
            name: {"coordinates": list(at), "deviations": list(spread)}
            for name, at, spread in zip(
                done.names,
                done.coordinates.tolist(),
                done.deviations.tolist(),
                strict=True,
            )
        },
        "measurements": done.table(),
        **({"promise": _told(done.promise)} if done.promise else {}),
    }


def _told(told: Promise) -> dict[str, Any]:
    """A promise for programs: shares from 0 to 1, of coordinates their means."""
    found: dict[str, Any] = {}
    for name, value in told._asdict().items():
        if isinstance(value, Verdict):
            found[name] = value._asdict()
        elif isinstance(value, np.ndarray):
            found[name] = float(np.mean(value))
        else:
            found[name] = value
    return found
