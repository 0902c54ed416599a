"""One call of `jaxro absolute` from its options to its report and files."""

import math
from dataclasses import dataclass, replace
from pathlib import Path

import jax
import numpy as np

from ..block import absolute
from ..block.absolute_causes import find_cause
from ..block.absolute_model import model
from ..block.absolute_suspects import find_suspects
from ..reports import absolute as report
from ..reports.absolute_files import Done, compare, contents
from ..reports.terminal import consoles, say_what
from ..tables import ground as ground_tables, model as model_tables, whole
from ..tables.examples import absolute as example
from ..tables.fields import TableError
from ..tables.ground import DEVIATIONS, GroundPoints
from ..tables.model import ModelPoints


@dataclass(frozen=True)
class Options:
    """What the user asked for; None where nothing was said."""

    file: Path | None = None
    control: Path | None = None
    pair: str | None = None
    sigma: float | None = None
    model_sigma: float | None = None
    second: bool = False
    unit: str = "m"
    out: Path | None = None
    force: bool = False


@dataclass(frozen=True)
class Task:
    """What is placed on the ground, read and checked. `rows` of the ground points in the
    model, -1 where it has not got them; standard deviations are None where there are
    none."""

    title: str
    model: ModelPoints
    ground: GroundPoints
    rows: np.ndarray
    deviations: np.ndarray | None
    model_deviations: np.ndarray | None

    @property
    def unit_weights(self) -> bool:
        """Whether nothing has a standard deviation."""
        return self.deviations is None and self.model_deviations is None


def run(options: Options) -> bool:
    """Read, place, show, write. True if the numbers may be used. Raises TableError, with
    nothing written."""
    console, _ = consoles()
    read = options.file, options.control
    inputs, texts = whole.Inputs(*read), {}
    with whole.claim(options.out, whole.check_target, options.force):
        done = calculate(prepare(options), options)
        if options.out is not None:
            texts = contents(done)
            inputs.check()
            whole.write(options.out, texts, read)
    report.show(console, done)
    if texts:
        console.print(f"Written to {options.out}: {', '.join(texts)}", markup=False)
    if options.file is None:
        console.print(
            "This was a simulated example. Your own model: jaxro absolute MODEL.csv "
            "--control GROUND.csv",
            markup=False,
        )
    return done.usable


def prepare(options: Options) -> Task:
    """Everything read and checked. Raises TableError."""
    for name, value in (
        ("--sigma", options.sigma),
        ("--model-sigma", options.model_sigma),
    ):
        if value is not None and not (math.isfinite(value) and value > 0):
            raise TableError(name, found=repr(value), expected="a positive number")
    title, points, ground = _read(options)
    for name, value, file, given in (
        ("--sigma", options.sigma, ground.file, ground.deviations),
        ("--model-sigma", options.model_sigma, points.file, points.deviations),
    ):
        if value is not None and given is not None:
            raise TableError(
                name,
                found=f"it beside the standard deviations of {file}",
                expected="only one of the two",
            )
    at = {name: row for row, name in enumerate(points.names)}
    rows = np.array([at.get(name, -1) for name in ground.names])
    if np.all(rows < 0):
        raise TableError(
            ground.file,
            column="point",
            found=f"no point of {points.file}; its points are {_some(ground.names)}",
            expected=f"names of {points.file}: {_some(points.names)}",
        )
    task = Task(
        title=title,
        model=points,
        ground=ground,
        rows=rows,
        deviations=_spread(ground.deviations, options.sigma, ground.coordinates),
        model_deviations=_spread(
            points.deviations, options.model_sigma, points.coordinates
        ),
    )
    _check_errors(task)
    return task


def _read(options: Options) -> tuple[str, ModelPoints, GroundPoints]:
    """The name of what is placed, and the tables."""
    if options.file is None:
        for name, value in (("--control", options.control), ("--pair", options.pair)):
            if value is not None:
                raise TableError(
                    name,
                    found="it without MODEL.csv",
                    expected="the model that it belongs to",
                )
        name = example.NAME
        points = model_tables.parse(example.MODEL, name, name)
        return name, points, ground_tables.parse(example.GROUND, name)
    if options.control is None:
        raise TableError(
            "--control",
            found="no table of points on the ground",
            expected="--control GROUND.csv with point,X,Y,Z, blank where unknown",
        )
    points = model_tables.read(options.file, options.pair)
    ground = ground_tables.read(options.control)
    return str(options.file), points, ground


def _spread(
    given: np.ndarray | None, sigma: float | None, coordinates: np.ndarray
) -> np.ndarray | None:
    """The standard deviations of a table, or one for all of its coordinates."""
    if given is not None or sigma is None:
        return given
    return np.where(np.isfinite(coordinates), sigma, np.nan)


def _check_errors(task: Task) -> None:
    """Raises TableError for a control coordinate without error where the model has none,
    either."""
    if task.deviations is None or task.model_deviations is not None:
        return
    used = task.ground.is_a("control") & (task.rows >= 0)
    exact = (task.deviations == 0) & used[:, None]
    if np.any(exact):
        point, axis = (int(k) for k in np.argwhere(exact)[0])
        raise task.ground.error(
            point,
            DEVIATIONS[axis],
            found="0, and model points without standard deviations",
            expected="more than 0, or --model-sigma (or sigma in the table of the "
            "model): weights are inverses of variances",
        )


def _some(names: list[str]) -> str:
    """The first names of a list."""
    most = model_tables.SHOWN
    return ", ".join(map(repr, names[:most])) + (", ..." if names[most:] else "")


# -------------------------------------------------------------------------------------
# the calculation


def calculate(task: Task, options: Options) -> Done:
    """Place the model, and compare it with its control and check points."""
    ground, rows = task.ground, task.rows
    control = np.flatnonzero(ground.is_a("control") & (rows >= 0))
    coordinates = np.full_like(task.model.coordinates, np.nan)
    coordinates[rows[control]] = ground.coordinates[control]
    # unit weights, or a ground free of error where only the model has deviations
    sigma = np.full_like(coordinates, 1.0 if task.unit_weights else 0.0)
    if task.deviations is not None:
        sigma[rows[control]] = np.nan_to_num(task.deviations[control])
    measured = model(
        task.model.coordinates,
        coordinates,
        ground_sigma=sigma,
        sigma=task.model_deviations if task.model.factors is None else None,
        factors=task.model.factors,
    )
    with say_what("Placing the model ..."):
        found = [jax.tree.map(np.asarray, one) for one in absolute.solutions(measured)]
    if options.second and len(found) < 2:
        raise TableError(
            "--second",
            found="one position of the model only",
            expected="no such option: the control leaves no choice",
        )
    done = compare(
        title=task.title,
        unit=options.unit if options.file is not None else example.UNIT,
        unit_weights=task.unit_weights,
        model=task.model,
        ground=ground,
        rows=rows,
        deviations=task.deviations,
        sigma_known=task.model_deviations is not None,
        found=found[::-1] if options.second else found,
    )
    with say_what("Looking for wrong columns of the control ..."):
        cause = find_cause(measured, found[0])
    if cause is not None:
        return replace(done, cause=cause)
    if not done.is_doubtful:
        return done
    with say_what("Looking for wrong control points ..."):
        suspects = find_suspects(measured, done.first)
    if suspects is None:
        return done
    names = [task.model.names[row] for row in suspects.rows]
    return replace(done, suspects=names, sigma0_without=suspects.sigma0)
