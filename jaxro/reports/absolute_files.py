"""A model on the ground with names and NumPy values, and the tables of --out of `jaxro
absolute`, in full precision. Angles are degrees."""

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float, Int

from ..adjustment import critical_values as critical
from ..block.absolute_result import NAMES, AbsoluteOrientation
from ..block.absolute_verdict import RESULTS
from ..block.columns import Cause
from ..block.contradictions import FITTING, tell_sigma0
from ..tables.ground import GroundPoints
from ..tables.model import ModelPoints
from . import files
from .calibration_model import limit_of_w
from .control import AXES, LEVEL, Compared, Row, control_rows

RESULT_NAMES = {int(item._value): name for name, item in RESULTS._name_to_item.items()}


@dataclass(frozen=True)
class Done:
    """A finished absolute orientation.

    `found`: the solution that is used and, where there is one, the other. `control` and
    `checks`: what it is compared with; `redundancy` of the control coordinates. `roles`
    of the model points ("" for new ones); `strange`: ground points that the model has
    not got; `approximate`: how many points are no more than that. `unit_weights`:
    nothing has a standard deviation; `sigma_known`: the model has some, so that sigma0
    is to be 1 (without them it stands for errors of the model, too). `suspects`:
    control points without which the rest fits far better, with `sigma0_without` them;
    `cause`: what is wrong with a whole column of the control.
    """

    title: str
    unit: str
    unit_weights: bool
    sigma_known: bool
    model: ModelPoints
    found: list[AbsoluteOrientation]
    roles: list[str]
    control: Compared
    redundancy: Float[np.ndarray, "control 3"]
    checks: Compared
    strange: list[str]
    approximate: int
    suspects: list[str] = field(default_factory=list)
    sigma0_without: float = np.nan
    cause: Cause | None = None

    @property
    def is_doubtful(self) -> bool:
        """Whether some control point may be wrong: a residual is too large, or the model
        is weakly determined because all are."""
        beyond = bool(np.any(np.abs(self.control.w) > self.limit))
        weak = bool(self.first.result == RESULTS.weakly_determined)
        return weak or (bool(self.first.usable) and beyond)

    @property
    def first(self) -> AbsoluteOrientation:
        """The solution that is used."""
        return self.found[0]

    @property
    def result(self) -> str:
        """The name of its result, or of what is wrong with the control as a whole."""
        if self.cause is not None:
            return self.cause.name
        if self.contradiction:
            return "contradicts"
        return RESULT_NAMES[int(self.first.result._value)]

    @property
    def usable(self) -> bool:
        """Whether the numbers may be used."""
        found = bool(self.first.usable)
        return found and self.cause is None and not self.contradiction

    @property
    def contradiction(self) -> str:
        """What of the control does not fit as a whole, in a sentence."""
        known = np.any(self.control.known, axis=1)
        fit = known & np.all(np.abs(self.control.w) <= self.limit, axis=1)
        if bool(self.first.usable) and np.sum(fit) < FITTING * np.sum(known):
            return (
                f"Only {np.sum(fit)} of {np.sum(known)} control points fit the model."
            )
        if not (self.sigma_known and bool(self.first.usable)):
            return ""
        return " ".join(tell_sigma0(float(self.first.sigma0), self.freedom))

    @property
    def freedom(self) -> int:
        return int(self.first.degrees_of_freedom)

    @property
    def sigma0(self) -> float | None:
        """What cofactors are multiplied with: 1 for given standard deviations unless the
        estimated sigma0 is larger than chance allows, as a few degrees of freedom tell
        less of it than these do; without them the estimated one, None without both."""
        found = float(self.first.sigma0)
        if not self.sigma_known:
            return found if self.freedom > 0 else None
        return float(critical.trusted_sigma0(found, self.freedom))

    @property
    def limit(self) -> float:
        """What the largest |w| of the control exceeds with the probability LEVEL if no
        coordinate is wrong."""
        count = int(np.sum(self.control.known))
        return limit_of_w(count, self.freedom, sigma_known=self.sigma_known)

    @property
    def limit_of_checks(self) -> float:
        """The same of the check points."""
        level = critical.sidak(LEVEL, max(int(np.sum(self.checks.known)), 1))
        if self.sigma_known:
            return float(critical.normal(level))
        if self.freedom == 0:
            return np.inf
        return float(critical.student(level / 2, self.freedom))

    def elements(self, one: AbsoluteOrientation) -> tuple[np.ndarray, np.ndarray]:
        """Scale, angles in degrees and shift, and their standard deviations (NaN where
        they do not exist)."""
        units = np.array([1, *[np.degrees(1.0)] * 3, 1, 1, 1])
        sigma0 = np.nan if self.sigma0 is None else self.sigma0
        spread = np.asarray(one.deviations(sigma0))
        return np.asarray(one.values) * units, spread * units

    @property
    def point_deviations(self) -> np.ndarray:
        """Standard deviations of the points, NaN where they do not exist."""
        return np.asarray(
            self.first.point_deviations(np.nan if self.sigma0 is None else self.sigma0)
        )


def compare(
    *,
    title: str,
    unit: str,
    unit_weights: bool,
    sigma_known: bool,
    model: ModelPoints,
    ground: GroundPoints,
    rows: Int[np.ndarray, " ground"],
    deviations: Float[np.ndarray, "ground 3"] | None,
    found: list[AbsoluteOrientation],
) -> Done:
    """A model that has been placed beside control and check points. `rows`: of the
    ground points in the model, -1 where it has not got them."""
    first, there = found[0], rows >= 0
    control = np.flatnonzero(ground.is_a("control") & there)
    checks = np.flatnonzero(ground.is_a("check") & there)
    # true standard deviations, or what the residuals say of them
    sigma0 = 1.0 if sigma_known else float(first.sigma0)
    roles = [""] * len(model.names)
    for point in (*control, *checks):
        roles[rows[point]] = ground.roles[point]

    def beside(points: np.ndarray, differences: np.ndarray, w: np.ndarray) -> Compared:
        known = ground.known[points]
        return Compared(
            names=[ground.names[k] for k in points],
            given=ground.coordinates[points],
            known=known,
            differences=np.where(known, differences, 0.0),
            w=np.where(known, w, 0.0),
        )

    places = np.asarray(first.points)[rows[checks]]
    off = places - ground.coordinates[checks]
    cofactors = np.asarray(first.point_cofactors)[rows[checks]]
    variances = np.diagonal(cofactors, axis1=1, axis2=2)
    if deviations is not None:
        variances = variances + deviations[checks] ** 2
    elif unit_weights:
        variances = variances + 1.0
    spread = sigma0 * np.sqrt(variances)
    safe = np.where(spread > 0, spread, np.inf)
    own = rows[control]
    return Done(
        title=title,
        unit=unit,
        unit_weights=unit_weights,
        sigma_known=sigma_known,
        model=model,
        found=found,
        roles=roles,
        control=beside(
            control,
            np.asarray(first.residuals)[own],
            np.asarray(first.ratios)[own] / (sigma0 if sigma0 > 0 else 1.0),
        ),
        redundancy=np.asarray(first.redundancy)[own],
        checks=beside(checks, off, off / safe),
        strange=[n for n, row in zip(ground.names, rows, strict=True) if row < 0],
        approximate=int(np.sum(ground.is_a("approximate") & there)),
    )


# -------------------------------------------------------------------------------------
# the tables


def contents(done: Done) -> dict[str, str]:
    """The tables by name; those of points only where the numbers may be used."""
    tables = {"absolute.csv": [_elements(done, k) for k in range(len(done.found))]}
    if done.usable:
        tables = {
            "points.csv": _points(done),
            "control.csv": _control(done),
            **tables,
        }
    return {name: files.rows_text(rows) for name, rows in tables.items() if rows}


def _control(done: Done) -> list[Row]:
    head = "w" if done.sigma_known else "tau"
    none = np.full_like(done.checks.w, np.nan)
    rows = control_rows(done.control, "control", head, done.redundancy)
    return rows + control_rows(done.checks, "check", head, none)


def _elements(done: Done, solution: int) -> Row:
    one = done.found[solution]
    number = lambda value: float(value) if done.usable else None
    row: Row = {
        "model": done.model.pair,
        "solution": solution + 1,
        "result": done.result,
        "control_coordinates": int(np.sum(done.control.known)),
        "degrees_of_freedom": done.freedom,
        "sigma0": number(one.sigma0),
    }
    for name, value, deviation in zip(NAMES, *done.elements(one), strict=True):
        head = f"{name}_deg" if name in ("omega", "phi", "kappa") else name
        row |= {head: number(value), f"s_{head}": number(deviation)}
    for i in range(3):
        for j in range(3):
            row[f"r{i + 1}{j + 1}"] = number(np.asarray(one.rotation)[i, j])
    return row


def _points(done: Done) -> list[Row]:
    places, deviations = np.asarray(done.first.points), done.point_deviations
    rows = []
    for k, name in enumerate(done.model.names):
        row: Row = {"point": name}
        for axis, value, deviation in zip(AXES, places[k], deviations[k], strict=True):
            row |= {axis: float(value), f"s{axis}": float(deviation)}
        rows.append(row | {"role": done.roles[k]})
    return rows
