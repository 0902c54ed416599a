"""Clean and orient pairs of any lengths: the one way of CSV and Parquet tables, of few
pairs and many. A table of a single pair goes through programs of one pair, which compile
sooner."""

import dataclasses
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Int

from ..batches.batch import clean_batch
from ..batches.buckets import by_size, choose, map_ragged, rows_of
from ..batches.copies import first_rows
from ..batches.padding import Plan
from ..batches.ragged import Ragged, clean_ragged, orient_ragged
from ..geometry import coplanarity
from ..geometry.elements import AbstractElements, DependentElements
from ..geometry.pairs import Pair, mask_unusable
from ..orientation.express import express
from ..orientation.orient import Orientation, orient
from ..orientation.results import RESULTS
from ..rejection import AbstractProcedure, Rejection
from ..rejection.base import InSteps
from ..reports.columns import USABLE, Units, columns_of, is_usable
from ..reports.model import Results
from ..reports.reader import Assessor, Oriented, Reader
from ..reports.verdicts import (
    Rounds,
    Verdicts,
    join_rounds,
    read_rounds,
    unusable,
    with_log,
    without_log,
)
from ..tables.measured import CameraPairs, Table, one_pair
from ..xla.programs import compiled
from ..xla.settings import MOMENT, settings_for

RESIDUALS = {"rigorous": coplanarity.rigorous, "parallax": coplanarity.parallax}
"""What is minimised, by the names of the command line."""

LOG_NUMBERS = 4_000_000
"""Entries of the log, (pair, round, point), that may be in memory at once: some 100
MB."""

Told = Callable[[int], None]
"""Is told the number of pairs that are finished."""


@dataclass(frozen=True)
class Task:
    """What is to be done with every pair. `tables`: of `columns.TABLES`, those of the
    points that are wanted; `rounds`: whether every round of the procedure is."""

    system: type[AbstractElements]
    tables: tuple[str, ...]
    sigma_known: bool
    base: float | None = None
    residual: str = "rigorous"
    procedure: AbstractProcedure | None = None
    rounds: bool = False

    @property
    def keywords(self) -> dict[str, Any]:
        """The options of `jaxro.orient` and `jaxro.orient_batch`."""
        residual = RESIDUALS[self.residual]
        return {"elements": self.system, "base": self.base, "residual": residual}

    @property
    def reader(self) -> Reader:
        """Reads what is wanted of an orientation; reliability needs the points."""
        wanted = self.tables
        if "reliability" in wanted and "points" not in wanted:
            wanted = (*wanted, "points")
        return Reader(self.system, wanted, self.sigma_known, self.procedure is not None)

    @property
    def cleaned_reader(self) -> "CleanedReader":
        """Reads what is wanted of a cleaned pair."""
        # where there is one round, its log is read in any case: by one program, whose
        # figures are the same to the last digit
        rounds = self.rounds or isinstance(self.procedure, InSteps)
        return CleanedReader(self.reader, self.system, self.base, rounds)

    @property
    def assessor(self) -> Assessor:
        """Reads what is wanted of the reliability."""
        return Assessor(self.system, self.sigma_known)


class CleanedReader(NamedTuple):
    """read(pair, rejection) -> the outcome, and what `reader` tells of the pair in the
    elements `system` with this `base`; the decision about its points, and what is told
    of them; with the rounds if they are wanted."""

    reader: Reader
    system: type[AbstractElements]
    base: float | None
    rounds: bool

    def __call__(self, pair: Pair, rejection: Rejection) -> tuple[Any, Any]:
        """The columns of the pair and of its points."""
        of_pair, of_points = (with_log if self.rounds else without_log)(rejection)
        _, bad_input = mask_unusable(pair)
        pair = pair.with_mask(rejection.in_use)
        orientation = express(pair, rejection.orientation, self.system, self.base)
        told = RESULTS.where(bad_input, RESULTS.non_finite_input, orientation.result)
        orientation = dataclasses.replace(orientation, result=told)
        columns, tables = self.reader(pair, orientation)
        return of_pair | {"pair": columns}, of_points | {"points": tables}


class Found(NamedTuple):
    """The columns of the pairs and, by table, of their points, in the rows of all; of
    cleaned pairs the outcomes, the columns of a `verdicts.Decision`, those of other
    consensuses, and the rounds."""

    of_pairs: dict[str, Any]
    of_points: dict[str, dict[str, Any]]
    outcome: Int[np.ndarray, " pair"] | None = None
    decided: dict[str, Any] | None = None
    rivals: dict[str, Any] | None = None
    rounds: Rounds | None = None


def solve(
    pairs: Ragged,
    task: Task,
    plan: Plan | None,
    threads: int | None = None,
    told: Told = lambda done: None,
) -> Found:
    """What is found of the pairs, in NumPy. `plan` is None where the table has one pair
    only."""
    if task.procedure is None:
        told_of = _orient(pairs, task, plan, threads, told)
        return Found(*_complete(pairs, *told_of, task, plan, threads))
    cleaned = _clean(pairs, task, plan, threads, told)
    of_pairs, of_points, outcome, decided, rivals, rounds = cleaned
    # of unusable points the orientation tells
    use = decided["in_use"] | unusable(decided["kept"], decided["order"])
    every = pairs
    pairs = pairs._replace(mask=pairs.mask & use)
    if task.residual != "rigorous":
        result = of_pairs["result"]
        of_pairs, of_points = _orient(pairs, task, plan, threads, lambda done: None)
        refused = is_usable(of_pairs["result"]) & ~is_usable(result)
        of_pairs["result"] = np.where(refused, result, of_pairs["result"])
    told_of = _complete(pairs, of_pairs, of_points, task, plan, threads)
    return _of_copies(Found(*told_of, outcome, decided, rivals, rounds), every)


def _of_copies(found: Found, pairs: Ragged) -> Found:
    """What is found, with that of the first one of each group of copies for all of
    them."""
    if np.all(pairs.mask):
        return found
    first = first_rows(pairs._replace(mask=np.ones_like(pairs.mask)))
    of_first = lambda tree: jax.tree.map(lambda a: np.asarray(a)[first], tree)
    of_points, decided = of_first(found.of_points), of_first(found.decided)
    return found._replace(of_points=of_points, decided=decided)


def _orient(
    pairs: Ragged, task: Task, plan: Plan | None, threads: int | None, told: Told
) -> tuple[dict[str, Any], dict[str, dict[str, Any]]]:
    """The columns of the pairs and of their points."""
    if plan is None:
        pair = one_pair(pairs, 0)
        orientation = orient(pair, **task.keywords)
        read = _read(pair, orientation, reader=task.reader)
        of_pair, of_points = jax.tree.map(np.asarray, read)
        of_pairs = jax.tree.map(lambda a: a[None], of_pair)
        told(1)
    else:
        of_pairs, of_points = orient_ragged(
            pairs,
            read=task.reader,
            plan=plan,
            threads=threads,
            progress=lambda done, total: told(done),
            **task.keywords,
        )
    return of_pairs, of_points


def _complete(
    pairs: Ragged,
    of_pairs: dict[str, Any],
    of_points: dict[str, dict[str, Any]],
    task: Task,
    plan: Plan | None,
    threads: int | None,
) -> tuple[dict[str, Any], dict[str, dict[str, Any]]]:
    """The columns with those of reliability, and without those of no use."""
    if "reliability" in task.tables:
        assessed = _assess(pairs, of_pairs, of_points, task, plan, threads)
        of_points = of_points | {"reliability": assessed}
    used = np.add.reduceat(pairs.mask.astype(int), pairs.begins[:-1])
    return hide(of_pairs | {"used": used}, of_points, pairs, task)


def hide(
    of_pairs: dict[str, Any],
    of_points: dict[str, dict[str, Any]],
    pairs: Ragged,
    task: Task,
) -> tuple[dict[str, Any], dict[str, dict[str, Any]]]:
    """The columns without the values of results that are not usable. Residuals stay
    where points lie behind a photo: they say which."""
    usable = is_usable(of_pairs["result"])
    behind = of_pairs["result"] == int(RESULTS.points_behind_camera._value)
    missing = {
        "usable": np.flatnonzero(~usable),
        "shown": np.flatnonzero(~(usable | behind)),
    }
    of_rows = {
        name: np.concatenate([*rows_of(pairs, members), np.zeros(0, int)]).astype(int)
        for name, members in missing.items()
    }

    def hide(table: str, values: dict[str, Any], places: dict[str, np.ndarray]) -> Any:
        there = {c.name: c for c in columns_of(table, task.system)}
        return {n: there[n].hide(np.asarray(a), places) for n, a in values.items()}

    hidden = {name: hide(name, a, of_rows) for name, a in of_points.items()}
    return hide("elements", of_pairs, missing), hidden


def _at_once(pair: Pair, *_: Any, **__: Any) -> dict[str, Any]:
    return settings_for(pair.x_left.size, MOMENT)


@compiled(settings=_at_once)
def _read(pair: Pair, orientation: Orientation, *, reader: Reader) -> Any:
    return reader(pair, orientation)


def _assess(
    pairs: Ragged,
    of_pairs: dict[str, Any],
    of_points: dict[str, dict[str, Any]],
    task: Task,
    plan: Plan | None,
    threads: int | None,
) -> dict[str, Any]:
    """The columns of the reliability of all points, which is defined at the minimum of
    the rigorous residuals only."""
    if task.residual != "rigorous":
        columns = [c for c in columns_of("reliability", task.system) if c.of]
        empty = lambda c: np.full(len(pairs.x_left), -1 if c.names else np.nan)
        return {column.name: empty(column) for column in columns}
    usable = is_usable(of_pairs["result"])
    # of dependent elements the base is given; of independent ones model heights tell it
    base = of_pairs["bx"] if task.system is DependentElements else np.ones(len(usable))
    height = of_points["points"]["Z"]

    def batch_of(members: np.ndarray, size: int) -> Oriented:
        return Oriented(
            pair=pairs.pad_to(members, size),
            usable=usable[members],
            degrees_of_freedom=of_pairs["degrees_of_freedom"][members],
            pose=of_pairs["pose"][members],
            base=base[members],
            z=pairs._replace(x_left=height).pad_to(members, size).x_left,
        )

    if plan is not None:
        return map_ragged(task.assessor, pairs, batch_of, plan, threads)
    one = jax.tree.map(lambda a: a[0], batch_of(np.zeros(1, int), len(pairs.x_left)))
    return jax.tree.map(np.asarray, _assess_one(one, assessor=task.assessor))


@compiled(settings=lambda one, **_: settings_for(one.pair.x_left.size, MOMENT))
def _assess_one(oriented: Oriented, *, assessor: Assessor) -> Any:
    return assessor(oriented)


class Cleaned(NamedTuple):
    """The columns of the pairs and of their points; the outcomes, the decision about
    every point, what is told of other consensuses, and the rounds if they are
    wanted."""

    of_pairs: dict[str, Any]
    of_points: dict[str, dict[str, Any]]
    outcome: Int[np.ndarray, " pair"]
    decided: dict[str, Any]
    rivals: dict[str, Any]
    rounds: Rounds | None = None


def _clean(
    pairs: Ragged, task: Task, plan: Plan | None, threads: int | None, told: Told
) -> Cleaned:
    """The decisions of the procedure, and its orientations."""
    assert task.procedure is not None
    read = task.cleaned_reader
    if plan is None:
        size = int(pairs.lengths[0])
        batch = pairs.pad_to(np.zeros(1, int), size)
        found = clean_batch(batch, task.procedure, read=read, threads=threads)
        of_pair, of_points = jax.tree.map(np.asarray, found)
        of_points = jax.tree.map(lambda a: a[0], of_points)
        told(1)
    elif not task.rounds:
        of_pair, of_points = clean_ragged(
            pairs,
            task.procedure,
            read=read,
            plan=plan,
            threads=threads,
            progress=lambda done, total: told(done),
        )
    else:
        return _clean_with_rounds(pairs, task, plan, threads, told)
    log, rounds = of_points.pop("rounds", None), None
    if task.rounds:
        of_round = jax.tree.map(lambda a: a[0], of_pair["rounds"])
        rounds = read_rounds(of_round, log)
    told_of = of_pair["pair"], of_points.pop("points"), of_pair["outcome"]
    return Cleaned(*told_of, of_points, of_pair["rivals"], rounds)


def _clean_with_rounds(
    pairs: Ragged, task: Task, plan: Plan, threads: int | None, told: Told
) -> Cleaned:
    """The same with the rounds, which take much memory: not all pairs together."""
    assert task.procedure is not None
    each: dict[int, Rounds] = {}
    whole: tuple[Any, Any] | None = None
    most = lambda size: max(1, LOG_NUMBERS // size**2)
    slabs = dict(zip(plan.sizes, plan.slabs, strict=True))
    for members, size in by_size(pairs, plan, most):
        rows, finished = rows_of(pairs, members), len(each)
        part = choose(pairs, members, rows)
        of_pairs, of_points = clean_ragged(
            part,
            task.procedure,
            read=task.cleaned_reader,
            plan=Plan((size,), (slabs[size],), (size,)),
            threads=threads,
            progress=lambda done, total, before=finished: told(before + done),
        )
        log = of_points.pop("rounds")
        found = _part_rounds(of_pairs.pop("rounds"), log, part.begins)
        each.update(zip(members.tolist(), found, strict=True))
        if whole is None:
            room = lambda count: lambda a: np.zeros((count, *a.shape[1:]), a.dtype)
            whole = (
                jax.tree.map(room(len(pairs.lengths)), of_pairs),
                jax.tree.map(room(len(pairs.x_left)), of_points),
            )
        for everywhere, values, places in zip(
            whole, (of_pairs, of_points), (members, np.concatenate(rows)), strict=True
        ):
            jax.tree.map(lambda a, b, at=places: _put(a, at, b), everywhere, values)
    assert whole is not None
    of_pairs, of_points = whole
    rounds = join_rounds([each[k] for k in range(len(each))], pairs.begins[:-1])
    told_of = of_pairs["pair"], of_points.pop("points"), of_pairs["outcome"]
    return Cleaned(*told_of, of_points, of_pairs["rivals"], rounds)


def _put(everywhere: np.ndarray, places: np.ndarray, values: np.ndarray) -> None:
    """Write the values to their places."""
    everywhere[places] = values


def _part_rounds(
    of_pairs: dict[str, Any], of_points: dict[str, Any], begins: np.ndarray
) -> list[Rounds]:
    """The rounds of pairs that begin with these rows."""
    spans = zip(begins[:-1].tolist(), begins[1:].tolist(), strict=True)
    return [
        read_rounds(
            {name: values[k] for name, values in of_pairs.items()},
            {name: values[begin:end] for name, values in of_points.items()},
        )
        for k, (begin, end) in enumerate(spans)
    ]


def in_use(pairs: Ragged, found: Found) -> Ragged:
    """The pairs without the points that were rejected."""
    if found.decided is None:
        return pairs
    return pairs._replace(mask=pairs.mask & found.decided["in_use"])


def make_results(
    table: Table,
    cameras: CameraPairs,
    found: Found,
    task: Task,
    units: Units,
    **more: Any,
) -> Results:
    """What is found of the pairs of a table, with its points that were kept."""
    of_pairs, of_points = found.of_pairs, found.of_points
    if found.decided is not None:
        rows = np.flatnonzero(found.decided["in_use"])
        table = table.choose(rows)
        of_points = jax.tree.map(lambda column: column[rows], of_points)
        of_pairs = of_pairs | {"outcome": found.outcome}
    return Results(
        table=table,
        cameras=cameras,
        system=task.system,
        units=units,
        sigma_known=task.sigma_known,
        of_pairs=of_pairs,
        of_points=of_points,
        **more,
    )


def make_verdicts(table: Table, found: Found) -> Verdicts:
    """The decisions about the points of a table."""
    assert found.outcome is not None and found.decided is not None
    assert found.rivals is not None
    q = {"q": found.of_points["residuals"]["q"]}
    return Verdicts(table, found.outcome, found.decided | q, found.rivals, found.rounds)


def is_good(results: Mapping[str, int], outcomes: Mapping[str, int] | None) -> bool:
    """Whether every pair is usable and, where pairs were cleaned, finished; by the
    number of pairs of every result and outcome."""
    pairs = sum(results.values())
    usable = sum(results.get(name, 0) for name in USABLE)
    finished = pairs if outcomes is None else outcomes.get("finished", 0)
    return usable == finished == pairs
