"""One call of `jaxro clean`: wrong points found, the rest oriented, both told and
written."""

from collections.abc import Callable

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Float

from ..batches.batch import clean_batch, orient_batch
from ..batches.buckets import each
from ..geometry import coplanarity
from ..geometry.elements import AbstractElements
from ..geometry.pairs import Pair, stack
from ..orientation.orient import orient
from ..rejection import PROCEDURES, AbstractProcedure
from ..reports import cleaning as verdict_report, files, verdicts as judged
from ..reports.solutions import Solved, solutions
from ..reports.terminal import consoles, progress
from ..reports.verdicts import Verdict
from ..tables.examples import mock_pair as mock_example
from ..tables.fields import TableError
from ..xla.programs import Program
from ..xla.settings import COMPILE_FAST
from . import orient as jobs, sigma
from .orient import Example, Job, Options
from .tolerances import changed, check_sigma, tolerances

DEFAULT = "recommended"
"""The procedure of users who name none."""

SIMULATED = Example(mock_example.NAME, mock_example.FOCAL, mock_example.TABLE)

LOG_NUMBERS = 4_000_000
"""Entries of the log, (pair, round, point), that may be in memory at once: some 100
MB."""


def run(options: Options, name: str, changes: list[str]) -> bool:
    """Read, clean, orient, write, show. True if every pair is cleaned and usable.
    Raises TableError."""
    procedure = changed(named(name), changes)
    job = jobs.prepared(options, SIMULATED)
    check_sigma(name, procedure, job.sigma_known)
    console, errors = consoles()
    jobs.warn(errors, job)
    with progress(errors, "Cleaning", len(job.pairs)) as told:
        verdicts, oriented = clean_all(job, procedure, told)
    # where nothing is left, every row stands with its failure
    measured = [v.kept if v.kept.points else v.measured for v in verdicts]
    solved = solutions(measured, job.cameras, oriented, job.units)
    verdicts = [
        v if s.usable else v.without_parallax()
        for v, s in zip(verdicts, solved, strict=True)
    ]
    texts: dict[str, str] = {}
    if options.out is not None:
        summary = job.summary(solved)
        heading = {
            "program": summary["program"],
            "file": summary["file"],
            "procedure": name,
        }
        heading |= sigma.entry(job.noise)
        texts = judged.texts(
            verdicts, job.units.photo, heading | {"tolerances": tolerances(procedure)}
        )
        texts |= files.texts(solved, job.units, summary)
    jobs.show_sigma(console, job)
    verdict_report.show(console, verdicts, name, job.units.photo)
    jobs.show(console, job, solved)
    jobs.write(job, texts)
    jobs.tell(console, job, texts)
    if options.file is None:
        console.print(
            "This was a simulated example. Your own pairs: jaxro clean FILE.csv "
            "--focal F",
            markup=False,
        )
    return all(v.finished and s.usable for v, s in zip(verdicts, solved, strict=True))


def chosen(name: str, changes: list[str]) -> tuple[str, AbstractProcedure]:
    """The procedure with its changed tolerances, by its name. Raises TableError."""
    return name, changed(named(name), changes)


def named(name: str) -> AbstractProcedure:
    """The procedure of this name. Raises TableError."""
    if name not in PROCEDURES:
        raise TableError(
            "--procedure", found=repr(name), expected=f"one of {', '.join(PROCEDURES)}"
        )
    return PROCEDURES[name]


def clean_all(
    job: Job, procedure: AbstractProcedure, told: Callable[[int], None]
) -> tuple[list[Verdict], list[Solved]]:
    """The verdict on every pair, with the log if files are asked for, and the
    orientation of the points kept."""
    select = judged.without_log if job.options.out is None else judged.with_log

    def one(pair: Pair):
        found, log = jax.tree.map(
            lambda a: a[0], clean_batch(stack([pair]), procedure, select=select)
        )
        kept = _with_unusable(pair, found)
        oriented = job.read(orient(kept, **job.keywords), kept)
        return (
            found,
            log,
            oriented,
            Program(_parallaxes, {}, COMPILE_FAST)((pair, oriented.orientation.pose)),
        )

    def many(batch: Pair, progress: Callable[[int, int], None]):
        found, log = clean_batch(batch, procedure, select=select, progress=progress)
        kept = _with_unusable(batch, found)
        oriented = job.read(orient_batch(kept, **job.keywords), kept)
        return (
            found,
            log,
            oriented,
            Program(_all_parallaxes, {})((batch, oriented.orientation.pose)),
        )

    together = (
        (lambda points: 1 << 40)
        if job.options.out is None
        else lambda points: max(1, LOG_NUMBERS // points**2)
    )
    verdicts: dict[int, Verdict] = {}
    oriented: dict[int, Solved] = {}
    for i, (found, log, solved, parallax) in each(job.pairs, one, many, told, together):
        verdicts[i] = judged.verdict(job.table.pairs[i], found, parallax, log)
        oriented[i] = _of_points(solved, np.flatnonzero(found.kept))
    every = range(len(job.pairs))
    return [verdicts[i] for i in every], [oriented[i] for i in every]


def _with_unusable(pairs: Pair, found: judged.Decision) -> Pair:
    """With the points kept, and the unusable ones, of which the orientation tells."""
    return pairs.with_mask(
        np.asarray(pairs.mask) & (found.kept | judged.unusable(found.kept, found.order))
    )


def _parallaxes(pair_and_pose: tuple[Pair, AbstractElements]) -> Float[Array, "point"]:
    return coplanarity.parallaxes(*pair_and_pose)


def _all_parallaxes(
    pairs_and_poses: tuple[Pair, AbstractElements],
) -> Float[Array, "pair point"]:
    return jax.vmap(_parallaxes)(pairs_and_poses)


READ = (
    *("used", "sigma", "w", "coordinate_redundancy"),
    *("effect", "effect_m_q", "effect_height"),
)
"""What a reading holds of every point."""


def _of_points(solved: Solved, places: np.ndarray) -> Solved:
    """The orientation with the values of these points only."""
    if not places.size:
        return solved
    values = lambda s: (
        s.corrections,
        *(
            getattr(s.orientation, name)
            for name in ("parallax", "residuals", "redundancy", "model", "in_front")
        ),
        *(getattr(s.reading, name) for name in READ if s.reading is not None),
    )
    return eqx.tree_at(
        values, solved, jax.tree.map(lambda a: a[places], values(solved))
    )
