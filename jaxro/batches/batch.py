"""Many pairs at once, on every core.

Pairs go through in slabs of fixed size, a slab in chunks that stay in the cache
(`lax.map` over `vmap`), slabs spread over threads, and over the devices where there are
several: XLA releases the interpreter lock and runs a chunk on one core, and nothing in
the program calls LAPACK, which would deadlock. Pairs that do not start from the
vertical are collected and oriented in a second, smaller pass, so that they do not hold
up their chunk.
"""

import math
import operator
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PyTree

from ..geometry.elements import AbstractElements
from ..geometry.pairs import Pair, double
from ..orientation.orient import orient_near, orient_once
from ..orientation.problem import Problem, problem_of
from ..orientation.result import Orientation
from ..orientation.starts import AbstractStart, Auto
from ..orientation.verdict import check_plane
from ..rejection import AbstractProcedure, Rejection
from ..rejection.base import InSteps, take_sigma
from ..rejection.hypotheses import AbstractHypotheses
from ..rejection.judgement import AbstractStep, Judgement, nothing_known
from ..rejection.search import Search
from ..xla.kernels import one_kernel, one_kernel_fusing_points
from ..xla.programs import Compiled, compiled
from ..xla.settings import (
    FEW,
    MOMENT,
    RUN_FAST,
    UNSPLIT_LOOPS,
    WIDE_VECTORS,
    settings_for,
)
from ..xla.slabs import (
    SLAB_POINTS,
    Progress,
    Split,
    count_cores,
    has_caches,
    map_chunks,
    silent,
    spread,
)

CHUNK_POINTS = 16384
"""Points per chunk: a working set of a few hundred kB, which stays in the cache of one
core."""

POINTS_AT_ONCE, SEARCHED_AT_ONCE = 1 << 20, 1 << 10
"""Points per chunk, and pairs in a call that searches, on other devices than a CPU."""

ALONE = 1 << 15
"""Points of a batch that are oriented from the vertical before other threads have
begun."""

SEARCHED = 4
"""Pairs in a call of a program that searches: a few milliseconds of work."""

SHORT, SOON = 1 << 13, 1 << 18
"""Points of a batch up to which a program runs for milliseconds, and up to which that
of a general start or of a procedure runs for seconds. The shorter it runs, the sooner
it has to be compiled. Up to SHORT points pairs go through one by one: `vmap` doubles
what there is to compile."""


def _everything(result: Any) -> Any:
    return result


class Selected(NamedTuple):
    """What is kept of a pair and its result where the pair does not matter."""

    select: Callable[[Any], PyTree]

    def __call__(self, _: Pair, result: Any) -> PyTree:
        """What is kept."""
        return self.select(result)


def _reading(select: Callable[[Any], PyTree], read: Callable | None) -> Callable:
    """What makes of a pair and its result what is wanted. Raises ValueError for two."""
    if read is None:
        return Selected(select)
    if select is not _everything:
        raise ValueError(
            "select and read exclude each other; read sees the result, too"
        )
    return read


def orient_batch(
    pairs: Pair,
    *,
    select: Callable[[Orientation], PyTree] = _everything,
    read: Callable[[Pair, Orientation], PyTree] | None = None,
    progress: Progress | None = None,
    threads: int | None = None,
    chunk: int | None = None,
    start: AbstractStart | Any = Auto(),  # noqa: B008 (frozen)
    **options,
) -> PyTree:
    """`orient` of every pair of a batch (pairs on the leading axis), on all cores.

    `select` picks what to keep of each orientation, and XLA computes nothing else:
    `lambda o: o.pose` is a bare solve. `read`, in its place, makes of a pair and its
    orientation whatever is wanted, in the same compiled program: `lambda pair, o:
    assess(pair, o, sigma0=0.01)`. A function object is compiled once. `progress(done,
    total)` is called from the calling thread. `threads` (all cores) and `chunk`, pairs
    that are worked on together, are chosen if not given. Other keywords are those of
    `orient`. The results are those of `orient` one by one, to rounding. Up to 512 MB of
    results that nobody holds any more are kept as memory for the next ones.
    """
    read = _reading(select, read)
    host, report = jax.tree.map(np.asarray, double(pairs)), progress or silent
    split = Split(threads, chunk)
    problem = problem_of_all(options | {"start": start})
    if not isinstance(start, Auto):
        return _finish(orient_slabs(host, problem, read, split, report))
    out, fits = orient_slabs_near(host, problem, read, split, report)
    rest = np.flatnonzero(~fits)
    if rest.size:
        left_over = jax.tree.map(lambda a: a[rest], host)
        general = problem.starting(start.general)
        out = _replace_rows(out, rest, orient_slabs(left_over, general, read, split))
    return _finish(out)


def problem_of_all(options: dict[str, Any]) -> Problem:
    """The problem of these options of `orient`, the same for all pairs. Raises
    TypeError for what is no option, ValueError for a base or start of each pair."""
    start = options.get("start")
    known = start if isinstance(start, AbstractElements) else None
    for name, given in (("base", options.get("base")), ("start", known)):
        if any(jnp.ndim(leaf) for leaf in jax.tree.leaves(given)):
            raise ValueError(
                f"`{name}` holds for all pairs of a batch; one of each pair goes with "
                f"jax.jit(jax.vmap(lambda pair, {name}: orient(pair, "
                f"{name}={name})))(pairs, {name})"
            )
    return problem_of(options)


def orient_slabs(
    pairs: Pair,
    problem: Problem,
    read: Callable[[Pair, Orientation], PyTree],
    split: Split = Split(),  # noqa: B008 (frozen)
    report: Progress = silent,
) -> PyTree:
    """read(pair, orientation) of every pair, in NumPy."""
    chunk = _chunk(pairs, split.chunk)
    program = _orient_slab.using(_settings(pairs))
    program = program.bind(problem=problem, read=read, chunk=chunk)
    return spread(pairs, program, split, chunk, report)


def orient_slabs_near(
    pairs: Pair,
    problem: Problem,
    read: Callable[[Pair, Orientation], PyTree],
    split: Split = Split(),  # noqa: B008 (frozen)
    report: Progress = silent,
) -> tuple[PyTree, np.ndarray]:
    """The same from the vertical, and for which pairs that fits; `problem.start` is an
    `Auto`."""
    chunk = _chunk(pairs, split.chunk)
    if pairs.x_left.size <= ALONE:
        split = split._replace(threads=split.threads or 1, calls=0)
        kernel, lasting = one_kernel, RUN_FAST | WIDE_VECTORS
    else:
        split = split._replace(calls=1)  # all take as long
        kernel, lasting = (
            one_kernel_fusing_points,
            RUN_FAST | WIDE_VECTORS | UNSPLIT_LOOPS,
        )
    kernel = kernel if problem.solver is None else None
    program = _orient_slab_near.using(_settings(pairs, lasting), kernel)
    program = program.bind(problem=problem, read=read, chunk=chunk)
    return spread(pairs, program, split, chunk, report)


def _replace_rows(out: PyTree, rows: np.ndarray, new: PyTree) -> PyTree:
    """The arrays with these rows new; in place but for those that are the program's
    own."""

    def one(target: np.ndarray, source: np.ndarray) -> np.ndarray:
        target = target if target.flags.writeable else target.copy()
        target[rows] = source
        return target

    return jax.tree.map(one, out, new)


def clean_batch(
    pairs: Pair,
    procedure: AbstractProcedure,
    *,
    select: Callable[[Rejection], PyTree] = _everything,
    read: Callable[[Pair, Rejection], PyTree] | None = None,
    progress: Progress | None = None,
    threads: int | None = None,
    chunk: int | None = None,
) -> PyTree:
    """`procedure` of every pair of a batch (pairs on the leading axis), on all cores;
    keywords as of `orient_batch`.

    `select=lambda r: r.mask` computes no log and no statistics that the decision does
    not need.
    """
    host, report = jax.tree.map(np.asarray, double(pairs)), progress or silent
    procedure, host = take_sigma(procedure, host)
    split = Split(threads, chunk)
    read = _reading(select, read)
    return _finish(clean_in_stages(host, procedure, read, split, report))


def clean_in_stages(
    pairs: Pair,
    procedure: AbstractProcedure,
    read: Callable[[Pair, Rejection], PyTree],
    split: Split,
    report: Progress,
) -> PyTree:
    """What is read of every pair's rejection, in NumPy: the stages in turn, each
    for the pairs that are still open, and one conclusion for all."""
    if not isinstance(procedure, InSteps):
        return clean_slabs(pairs, procedure, read, split, report)
    settings = _settings(pairs)  # whatever number of pairs is open
    known = nothing_known(pairs.focal_left, pairs.mask)
    for step in procedure.steps():
        open_ = np.flatnonzero(step.is_open(known))
        if open_.size == len(pairs.focal_left):
            known = judge_slabs(pairs, known, step, split, report, settings)
        elif open_.size:
            some = _rows((pairs, known), open_)
            own = _few_shapes(some[0], _split_of(step, some[0], split)[0])
            new = judge_slabs(*some, step, own, silent, settings)
            known = _replace_rows(known, open_, new)
        report = silent
    return conclude_slabs(pairs, known, procedure, read, split)


def _few_shapes(pairs: Pair, split: Split) -> Split:
    """How some pairs of a batch are split: whatever number of pairs that is, calls have
    one of few shapes, 4, 16, 64, ... pairs."""
    if split.slab is not None or not has_caches():
        return split
    total, points = pairs.x_left.shape
    each = -(-total // (max(split.calls, 1) * count_cores()))
    few = 4 ** max(1, math.ceil(math.log(max(each, 1), 4)))
    return split._replace(slab=min(few, max(1, SLAB_POINTS // max(points, 1))))


def clean_slabs(
    pairs: Pair,
    procedure: AbstractProcedure,
    read: Callable[[Pair, Rejection], PyTree],
    split: Split,
    report: Progress,
) -> PyTree:
    """What is read of every pair's rejection, in NumPy, by one program."""
    split, chunk = _split_of(procedure, pairs, split)
    program = _clean_slab.using(_settings(pairs))
    program = program.bind(procedure=procedure, read=read, chunk=chunk)
    return spread(pairs, program, split, chunk, report)


def judge_slabs(
    pairs: Pair,
    known: Judgement,
    step: AbstractStep,
    split: Split,
    report: Progress,
    settings: dict[str, Any] | None = None,
) -> Judgement:
    """What is known of pairs after a step, in NumPy."""
    split, chunk = _split_of(step, pairs, split)
    program = _judge_slab.using(settings or _settings(pairs))
    program = program.bind(step=step, chunk=chunk)
    read = [getattr(known, name) for name in step.reads]
    new = spread((pairs, read), program, split, chunk, report)
    return known._replace(**dict(zip(step.changes, new, strict=True)))


def conclude_slabs(
    pairs: Pair,
    known: Judgement,
    procedure: InSteps,
    read: Callable[[Pair, Rejection], PyTree],
    split: Split,
) -> PyTree:
    """What is read of the rejections that follow from what is known, in NumPy."""
    chunk, settings = _chunk(pairs, split.chunk), _settings(pairs)

    def run(slab: Compiled, rows: np.ndarray) -> PyTree:
        """What the program tells of these pairs."""
        program = slab.using(settings)
        program = program.bind(procedure=procedure, read=read, chunk=chunk)
        if rows.size == len(pairs.focal_left):
            return spread((pairs, known), program, split, chunk)
        some = _rows((pairs, known), rows)
        return spread(some, program, _few_shapes(some[0], split), chunk)

    usual = procedure.is_usual(known)
    first, rest = np.flatnonzero(usual), np.flatnonzero(~usual)
    if not first.size:
        return run(_conclude_slab, rest)
    out, holds = run(_conclude_usual_slab, first)
    if rest.size:
        room = lambda a: np.empty((usual.size, *a.shape[1:]), a.dtype)
        out = _replace_rows(jax.tree.map(room, out), first, out)
    rest = np.sort(np.concatenate([rest, first[~holds]]))
    if rest.size:
        out = _replace_rows(out, rest, run(_conclude_slab, rest))
    return out


def _rows(tree: PyTree, rows: np.ndarray) -> PyTree:
    """These rows of arrays."""
    return jax.tree.map(lambda a: a[rows], tree)


def map_batch(
    function: Callable[[Any], PyTree],
    pairs: Any,
    *,
    progress: Progress | None = None,
    threads: int | None = None,
    chunk: int | None = None,
) -> PyTree:
    """Any function of one pair, of every pair of a batch and on all cores; keywords as
    of `orient_batch`.

    For procedures and studies of one's own: `map_batch(lambda pair: orient(pair,
    loss=Huber()).m_q, pairs)`. A function object is compiled once. It should not use
    LAPACK (`jnp.linalg`): calls of it from several threads can wait for one another for
    ever; `threads=1` avoids that.
    """
    chunk = _chunk(pairs, chunk)
    program = _map_slab.using(_settings(pairs)).bind(function=function, chunk=chunk)
    host, split = jax.tree.map(np.asarray, pairs), Split(threads, chunk)
    return _finish(spread(host, program, split, chunk, progress or silent))


def _split_of(procedure: PyTree, pairs: Pair, split: Split) -> tuple[Split, int]:
    """How the pairs of a procedure or a stage are split, and pairs per chunk. A search
    has work enough in the subsets of one pair, which then waits for no other; and of
    any number of pairs, so that all calls have one shape and one program."""
    is_search = lambda part: isinstance(part, AbstractHypotheses | Search)
    searches = any(map(is_search, jax.tree.leaves(procedure, is_leaf=is_search)))
    if split.chunk is None and searches and not has_caches():
        return split, SEARCHED_AT_ONCE
    if split.chunk is None and searches:
        return split._replace(slab=split.slab or SEARCHED), 1
    return split, _chunk(pairs, split.chunk)


def _chunk(pairs: Any, chunk: int | None) -> int:
    """Pairs per chunk, as given or by the number of points."""
    if pairs.x_left.ndim != 2:
        raise ValueError(
            "a batch of pairs (pair, point) is wanted, got coordinates of shape "
            f"{pairs.x_left.shape}"
        )
    if chunk is not None:
        return operator.index(chunk)
    if not has_caches():
        return 1 << (POINTS_AT_ONCE // max(pairs.x_left.shape[1], 1)).bit_length() - 1
    if pairs.x_left.size <= SHORT:
        return 1
    fitting = max(CHUNK_POINTS // max(pairs.x_left.shape[1], 1), 4)
    return min(128, 1 << fitting.bit_length() - 1)


def _settings(pairs: Any, lasting: dict[str, Any] | None = None) -> dict[str, Any]:
    """How to compile for so many pairs: the longer they take, the more is gained by
    what takes long to compile."""
    points = pairs.x_left.size
    if points <= SHORT or (lasting is None and points <= SOON):
        return settings_for(points, MOMENT)
    if lasting is not None:
        return lasting
    # of more points wider vectors lose in what is not one kernel
    return RUN_FAST if pairs.x_left.shape[1] > FEW else RUN_FAST | WIDE_VECTORS


@compiled(unit="points")
def _orient_slab(
    pairs: Pair, *, problem: Problem, read: Callable, chunk: int
) -> PyTree:
    return map_chunks(lambda pair: read(pair, orient_once(pair, problem)), pairs, chunk)


@compiled(unit="points")
def _map_slab(pairs: Any, *, function: Callable, chunk: int) -> PyTree:
    return map_chunks(function, pairs, chunk)


@compiled(unit="points")
def _orient_slab_near(
    pairs: Pair, *, problem: Problem, read: Callable, chunk: int
) -> tuple[PyTree, Array]:
    def one(pair: Pair):
        unchecked, fits = orient_near(pair, problem)
        return read(pair, check_plane(pair, *unchecked)), fits

    return map_chunks(one, pairs, chunk)


@compiled(unit="points")
def _clean_slab(
    pairs: Pair, *, procedure: AbstractProcedure, read: Callable, chunk: int
) -> PyTree:
    return map_chunks(lambda pair: read(pair, procedure.clean(pair)), pairs, chunk)


@compiled(unit="points")
def _judge_slab(
    data: tuple[Pair, list[PyTree]], *, step: AbstractStep, chunk: int
) -> list[PyTree]:
    def one(data: tuple[Pair, list[PyTree]]) -> list[PyTree]:
        pair, read = data
        fields: dict[str, Any] = dict.fromkeys(Judgement._fields)
        fields |= zip(step.reads, read, strict=True)
        new = step.judge(pair, Judgement(**fields))
        return [getattr(new, name) for name in step.changes]

    return map_chunks(one, data, chunk)


@compiled(unit="points")
def _conclude_usual_slab(
    data: tuple[Pair, Judgement], *, procedure: InSteps, read: Callable, chunk: int
) -> tuple[PyTree, Array]:
    def one(data: tuple[Pair, Judgement]) -> tuple[PyTree, Array]:
        rejection, holds = procedure.conclude_usual(*data)
        return read(data[0], rejection), holds

    return map_chunks(one, data, chunk)


@compiled(unit="points")
def _conclude_slab(
    data: tuple[Pair, Judgement], *, procedure: InSteps, read: Callable, chunk: int
) -> PyTree:
    return map_chunks(lambda one: read(one[0], procedure.conclude(*one)), data, chunk)


def _finish(out: PyTree) -> PyTree:
    """NumPy leaves as JAX arrays in the same memory, which nobody else holds."""
    return jax.device_put(out, may_alias=True)
