"""Pairs of every length in few batches: flat arrays, padded to the few sizes that waste
least."""

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache
from itertools import starmap
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Bool, Float, Int, PyTree

from ..geometry.cofactor_roots import UNIT, CofactorRoots
from ..geometry.pairs import Pair, double, pair, with_roots, with_score
from ..orientation.result import PER_POINT, Orientation
from ..orientation.starts import AbstractStart, Auto
from ..rejection import AbstractProcedure, Rejection
from ..rejection.base import InSteps
from ..rejection.judgement import Judgement, nothing_known
from ..xla.settings import keep_plain
from ..xla.slabs import Progress, Split, silent
from .batch import (
    clean_slabs,
    conclude_slabs,
    judge_slabs,
    orient_slabs,
    orient_slabs_near,
    problem_of_all,
)
from .decisions import Decisions as Decisions, decisions
from .padding import Plan, plan_for

LONG = 64
"""Points from which values are moved quicker pair by pair than all together."""

Flat = Float[np.ndarray, " row"]


class Ragged(NamedTuple):
    """Pairs of any lengths one behind the other, in NumPy: pair k has the rows
    `begins[k]` to `begins[k + 1]`. `roots` and `score` as of a `Pair`, for every
    row."""

    begins: Int[np.ndarray, " pairs+1"]
    x_left: Flat
    y_left: Flat
    x_right: Flat
    y_right: Flat
    sigma: Flat
    mask: Bool[np.ndarray, " row"]
    focal_left: Float[np.ndarray, " pair"]
    focal_right: Float[np.ndarray, " pair"]
    roots: CofactorRoots | None = None
    score: Flat | None = None

    @property
    def lengths(self) -> Int[np.ndarray, " pair"]:
        """Points of every pair."""
        return np.diff(self.begins)

    def pad_to(self, members: Int[np.ndarray, " some"], size: int) -> Pair:
        """These pairs as one batch, in NumPy. What stands behind a shorter one up to
        `size` points is masked out."""
        first, last, lengths = members[0], members[-1], self.lengths[members]
        points = (
            self.x_left,
            self.y_left,
            self.x_right,
            self.y_right,
            self.sigma,
            self.mask,
            *(self.roots or ()),
            *(() if self.score is None else (self.score,)),
        )
        if last - first + 1 == len(members) and np.all(
            lengths == size
        ):  # a batch as they are
            fields = [
                a[self.begins[first] : self.begins[last + 1]].reshape(-1, size)
                for a in points
            ]
        else:
            # all windows of this size, of which some are copied whole: many times
            # faster than point by point
            end = self.begins[members[-1]] + size
            enough = lambda a: (
                a if end <= len(a) else np.append(a, np.zeros(size, a.dtype))
            )
            windows = lambda a: np.lib.stride_tricks.sliding_window_view(
                enough(a), size
            )
            fields = [windows(a)[self.begins[members]] for a in points]
            there = np.arange(size)[None, :] < lengths[:, None]
            fields[5] = np.logical_and(fields[5], there)
        of_pairs = self.focal_left[members], self.focal_right[members]
        structure = _structure(self.roots is not None, self.score is not None)
        return jax.tree.unflatten(structure, [*fields[:6], *of_pairs, *fields[6:]])

    def gather(
        self,
        members: Int[np.ndarray, " some"],
        batches: Sequence[np.ndarray],
        out: Sequence[np.ndarray],
    ) -> None:
        """The values (pair, point) of these pairs into their rows of `out`, for several
        values of one batch."""
        size = batches[0].shape[1] if batches else 0
        begins, lengths = self.begins[members], self.lengths[members]
        if size >= LONG:
            spans = list(zip(begins.tolist(), lengths.tolist(), strict=True))
            for target, batch in zip(out, batches, strict=True):
                for values, (begin, length) in zip(batch, spans, strict=True):
                    target[begin : begin + length] = values[:length]
            return
        there = np.arange(size)[None, :] < lengths[:, None]
        rows = (begins[:, None] + np.arange(size)[None, :])[there]
        for target, batch in zip(out, batches, strict=True):
            target[rows] = batch[there]


@lru_cache
def _structure(roots: bool, score: bool) -> Any:
    """Of a `Pair`, with roots and score or without, to be filled with arrays of
    NumPy."""
    one = pair(*np.zeros((4, 1)), focal=1.0)
    one = with_roots(one) if roots else one
    return jax.tree.structure(with_score(one) if score else one)


def join(pairs: Sequence[Pair]) -> Ragged:
    """Single pairs of any lengths as one `Ragged`. Raises ValueError for none."""
    if not pairs:
        raise ValueError("join: no pairs given")
    if any(one.x_left.ndim != 1 for one in pairs):
        raise ValueError(
            "join: single pairs are wanted, got a batch (pair, point): take it apart "
            "with unstack"
        )
    if any(one.roots is not None for one in pairs):
        pairs = [with_roots(one) for one in pairs]
    if any(one.score is not None for one in pairs):
        pairs = [with_score(one) for one in pairs]
    begins = np.cumsum([0] + [one.x_left.shape[-1] for one in pairs])
    together = lambda *fields: (
        np.concatenate(fields) if np.ndim(fields[0]) else np.stack(fields)
    )
    host = [jax.tree.map(np.asarray, one) for one in pairs]
    flat = jax.tree.map(together, *host)
    return Ragged(begins, *(getattr(flat, name) for name in Ragged._fields[1:]))


def with_roots_of_rows(pairs: Ragged) -> Ragged:
    """The pairs with `roots`: if they have none, those of equally accurate
    coordinates."""
    if pairs.roots is not None:
        return pairs
    fill = lambda value: np.full(len(pairs.x_left), value)
    return pairs._replace(roots=CofactorRoots(*map(fill, UNIT)))


def concatenate(parts: Sequence[Ragged]) -> Ragged:
    """The pairs of several `Ragged` one behind the other."""
    if any(part.roots is not None for part in parts):
        parts = [with_roots_of_rows(part) for part in parts]
    if any(part.score is not None for part in parts):
        unknown = lambda part: np.full(len(part.x_left), np.nan)
        parts = [
            part._replace(score=unknown(part)) if part.score is None else part
            for part in parts
        ]
    ends = np.cumsum([0] + [part.begins[-1] for part in parts])
    begins = np.concatenate(
        [[0], *(part.begins[1:] + end for part, end in zip(parts, ends, strict=False))]
    )
    together = lambda *fields: np.concatenate(fields)
    rows = [part._replace(begins=None) for part in parts]
    return jax.tree.map(together, *rows)._replace(begins=begins)


def check(pairs: Ragged) -> Ragged:
    """The pairs in double precision. Raises ValueError where there are none."""
    if len(pairs.begins) < 2:
        raise ValueError(
            "no pairs: `begins` has to hold the first row of every pair and the end of "
            "the last"
        )
    return double(pairs)


def split(pair: Pair, orientation: Orientation) -> tuple[PyTree, PyTree]:
    """An orientation in what it holds of the pair and of the points."""
    fields = lambda o: [getattr(o, name) for name in PER_POINT]
    nothing = eqx.tree_at(
        fields, jax.tree.map(lambda _: True, orientation), replace_fn=lambda _: False
    )
    return eqx.partition(orientation, nothing)


def orient_ragged(
    pairs: Ragged,
    *,
    read: Callable[[Pair, Orientation], tuple[PyTree, PyTree]] = split,
    plan: Plan | None = None,
    progress: Progress | None = None,
    threads: int | None = None,
    start: AbstractStart | Any = Auto(),  # noqa: B008 (frozen)
    **options,
) -> PyTree:
    """`orient` of pairs of any lengths, on all cores: an `Orientation` in NumPy whose
    fields of the points are flat, in the rows of `pairs`.

    `read(pair, orientation)`: what is wanted instead, of the pair and of every point;
    the result then is these two. Other keywords are those of `orient`. The results are
    those of `orient` one by one, to rounding.
    """
    pairs = check(pairs)
    plan = _fitting(plan, pairs)
    problem = problem_of_all(options | {"start": start})
    out = _Out(pairs, progress)
    rest = [np.zeros(0, int)]
    batches = _batches(pairs, plan.sizes, plan.slabs, threads)
    in_turn = threads == 1 or len(batches) == 1
    # what runs beside the calling thread tells nobody
    told = out.told if in_turn else silent

    def near(
        members: np.ndarray, size: int, slabs: Split
    ) -> tuple[np.ndarray, int, PyTree, np.ndarray]:
        found, fits = orient_slabs_near(
            pairs.pad_to(members, size), problem, read, slabs, told
        )
        return members, size, found, members[~fits]

    def given(
        members: np.ndarray, size: int, slabs: Split
    ) -> tuple[np.ndarray, int, PyTree, np.ndarray]:
        return (
            members,
            size,
            orient_slabs(pairs.pad_to(members, size), problem, read, slabs, told),
            members[:0],
        )

    first = near if isinstance(start, Auto) else given
    for members, size, found, left in (
        starmap(first, batches) if in_turn else _overlapping(first, batches)
    ):
        out.store(members, size, found)
        if not in_turn:
            out.told(len(members), len(members))
        rest.append(left)
    general = problem.starting(start.general) if isinstance(start, Auto) else problem
    for members, size, slabs in _batches(
        pairs, plan.fewer, None, threads, np.concatenate(rest)
    ):
        again = orient_slabs(pairs.pad_to(members, size), general, read, slabs)
        out.store(members, size, again)
    return eqx.combine(*out.tree) if read is split else out.tree


def clean_ragged(
    pairs: Ragged,
    procedure: AbstractProcedure,
    *,
    read: Callable[[Pair, Rejection], tuple[PyTree, PyTree]] = decisions,
    plan: Plan | None = None,
    progress: Progress | None = None,
    threads: int | None = None,
) -> PyTree:
    """`procedure` of pairs of any lengths, on all cores: its `Decisions`, flat, in the
    rows of `pairs`.

    `read(pair, rejection)`: what is wanted instead, of the pair and of every point; the
    result then is these two.
    """
    pairs = check(pairs)
    plan = _fitting(plan, pairs)
    out = _Out(pairs, progress)
    batches = _batches(pairs, plan.sizes, None, threads)
    if not isinstance(procedure, InSteps):
        for members, size, slabs in batches:
            batch = pairs.pad_to(members, size)
            found = clean_slabs(batch, procedure, read, slabs, out.told)
            out.store(members, size, found)
    else:
        known = _judge(pairs, procedure, plan, threads, out.told)
        for members, size, slabs in batches:
            batch, own = pairs.pad_to(members, size), known(members, size)
            found = conclude_slabs(batch, own, procedure, read, slabs)
            out.store(members, size, found)
    if read is not decisions:
        return out.tree
    (outcome, probability, own, pose), of_points = out.tree
    kept, order, statistic, undecided, rival = of_points
    return Decisions(
        kept=kept,
        order=order,
        statistic=statistic,
        outcome=outcome,
        undecided=undecided,
        rival=rival,
        probability=probability,
        own=own,
        pose=pose,
    )


def _judge(
    pairs: Ragged, procedure: InSteps, plan: Plan, threads: int | None, told: Progress
) -> Callable[[Int[np.ndarray, " some"], int], Judgement]:
    """What is known of all pairs after the steps of a procedure, each for the pairs that
    are open to it, as a function of (members, size)."""
    out = _Out(pairs, None)
    out.tree = nothing_known(pairs.focal_left, pairs.mask).split()

    def known(members: Int[np.ndarray, " some"], size: int) -> Judgement:
        of_pairs, of_points = out.tree
        padded = lambda rows: pairs._replace(mask=rows).pad_to(members, size).mask
        own = jax.tree.map(lambda a: a[members], of_pairs)
        return own.join(jax.tree.map(padded, of_points))

    sizes = plan.sizes
    for step in procedure.steps():
        open_ = np.flatnonzero(step.is_open(out.tree[0]))
        for members, size, slabs in _batches(pairs, sizes, None, threads, open_):
            batch = pairs.pad_to(members, size)
            new = judge_slabs(batch, known(members, size), step, slabs, told)
            out.store(members, size, new.split())
        sizes, told = plan.fewer, silent
    return known


def _fitting(plan: Plan | None, pairs: Ragged) -> Plan:
    """The plan, or one for these pairs. Raises ValueError if it is for shorter ones."""
    if plan is None:
        return plan_for(pairs.lengths)
    longest, most = int(np.max(pairs.lengths)), min(plan.sizes[-1], plan.fewer[-1])
    if longest > most:
        raise ValueError(
            f"the plan is for pairs of up to {most} points, but pair "
            f"{int(np.argmax(pairs.lengths))} has {longest}: plan with the longest of "
            "all parts"
        )
    return plan


def _batches(
    pairs: Ragged,
    sizes: tuple[int, ...],
    slabs: tuple[int, ...] | None,
    threads: int | None,
    members: Int[np.ndarray, " some"] | None = None,
) -> list[tuple[np.ndarray, int, Split]]:
    """(members, size to pad them to, slabs) of each size; of all pairs or of some.
    Without `slabs` a call takes one chunk."""
    members = np.arange(len(pairs.lengths)) if members is None else np.sort(members)
    bucket = np.searchsorted(sizes, pairs.lengths[members])
    every = [members[bucket == number] for number in range(len(sizes))]
    calls = slabs or (1,) * len(sizes)
    return [
        (own, size, Split(threads, slab=call))
        for own, size, call in zip(every, sizes, calls, strict=True)
        if own.size
    ]


def _overlapping(work: Callable, batches: Sequence[tuple]) -> Iterator[tuple]:
    """work(*batch) of every batch, two at a time: one is padded, or put in order by the
    caller, while another is calculated. The longest first, so that both end
    together."""
    pool = ThreadPoolExecutor(2)
    try:
        one = keep_plain(lambda batch: work(*batch))
        yield from pool.map(one, reversed(batches))
    finally:
        # who interrupts does not wait for a program to be compiled
        pool.shutdown(wait=False, cancel_futures=True)


class _Out:
    """The results of all pairs, filled batch by batch, and how many are done."""

    def __init__(self, pairs: Ragged, progress: Progress | None):
        self.tree: Any = None
        self._pairs, self._progress, self._before = pairs, progress or silent, 0

    def told(self, done: int, total: int) -> None:
        """Progress within one batch."""
        if done == total:
            self._before += total
        self._progress(
            self._before + (0 if done == total else done), len(self._pairs.lengths)
        )

    def store(
        self, members: np.ndarray, size: int, found: tuple[PyTree, PyTree]
    ) -> None:
        """The values of these pairs, and of their points in the rows of all. Raises
        ValueError for anything else."""
        if not isinstance(found, tuple) or len(found) != 2:
            raise ValueError(
                "of ragged pairs two things are read: (what is of the pair, what is of "
                "every point)"
            )
        for of_points in jax.tree.leaves(found[1]):
            if of_points.shape[:2] != (len(members), size):
                raise ValueError(
                    "what is read of every point has the points on its first axis, "
                    f"{size} of them here, but a value has the shape "
                    f"{of_points.shape[1:]}"
                )
        if len(members) == len(self._pairs.lengths) and np.all(
            self._pairs.lengths == size
        ):
            # nothing to put in order
            self.tree = (
                found[0],
                jax.tree.map(lambda a: a.reshape(-1, *a.shape[2:]), found[1]),
            )
            return
        if self.tree is None:
            sizes = len(self._pairs.lengths), len(self._pairs.x_left)
            empty = lambda count, drop: (
                lambda a: np.empty((count, *a.shape[drop:]), a.dtype)
            )
            self.tree = (
                jax.tree.map(empty(sizes[0], 1), found[0]),
                jax.tree.map(empty(sizes[1], 2), found[1]),
            )
        for target, source in zip(
            jax.tree.leaves(self.tree[0]), jax.tree.leaves(found[0]), strict=True
        ):
            target[members] = source
        self._pairs.gather(
            members, jax.tree.leaves(found[1]), jax.tree.leaves(self.tree[1])
        )
