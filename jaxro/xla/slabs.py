"""A compiled program over many pairs: slabs of one size, spread over threads and
devices.

XLA releases the interpreter lock and runs a slab on one core; no program that goes
through here may call LAPACK, which would wait for itself for ever.
"""

import math
import os
import threading
import weakref
from collections import deque
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor, wait
from functools import lru_cache
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from .programs import Program

SLAB_POINTS = 1 << 16
"""Points per call of the compiled program: long enough to hide the call, short enough
that a result is still in the cache when it is put to its place, its memory is used
again for the next, and progress is seen."""


ALIGNMENT = 64
"""Bytes to which JAX wants memory that it takes over without a copy."""


class Split(NamedTuple):
    """How the pairs of a batch are split. None picks a good value.

    `threads`: all cores. `chunk`: pairs that are worked on together, by the number of
    points. `slab`: pairs in one call of the program, by the number of pairs; if given,
    every call has this shape. `calls`: at least so many for each core, so that no
    thread waits long for the last one (0: a single call if possible). The results are
    the same bits with any number of threads.
    """

    threads: int | None = None
    chunk: int | None = None
    slab: int | None = None
    calls: int = 2


Progress = Callable[[int, int], None]
"""Is called with how many pairs are done, and with how many there are."""


def silent(done: int, total: int) -> None:
    """A progress callback that does nothing."""


def has_caches() -> bool:
    """Whether the device works fastest on few numbers that stay in a cache, as a CPU
    does; others want as many at once as their memory holds."""
    return jax.default_backend() == "cpu"


def spread(
    data: PyTree, run: Program, split: Split, chunk: int, report: Progress = silent
) -> PyTree:
    """run(data) of everything on the leading axis, slab by slab, as NumPy arrays;
    `chunk` divides a slab.

    The last slab is filled up with empty pairs (zeros, mask False). `report` is called
    from the calling thread. If `split.slab` is given, the arrays are writable. Raises
    ValueError for a chunk or number of threads below one.
    """
    if chunk < 1 or (split.threads is not None and split.threads < 1):
        raise ValueError(
            f"threads and chunk must be positive (or None), got {split.threads} and "
            f"{chunk}"
        )
    leaves = jax.tree.leaves(data)
    total, points = leaves[0].shape[0], math.prod(leaves[0].shape[1:])
    # several GPUs take turns; a CPU is one, whose cores are the threads
    devices = jax.local_devices()
    cores = _count_workers()
    if split.slab is not None:
        size = -(-split.slab // chunk) * chunk
    elif total <= chunk:
        size = min(1 << max(total - 1, 0).bit_length(), chunk)
    else:
        most = max(1, SLAB_POINTS // (chunk * max(points, 1)))
        calls = max(split.calls * cores, -(-total // (most * chunk)), 1)
        # so that no core waits for the last call
        calls = -(-calls // cores) * cores if calls > 1 else 1
        size = chunk * min(most, _round_up(-(-total // (calls * chunk))))
    begins = range(0, total, size)

    def part(begin: int) -> PyTree:
        slab = _fill_up(jax.tree.map(lambda a: a[begin : begin + size], data), size)
        if len(devices) == 1:
            return run(slab)
        with jax.default_device(devices[begin // size % len(devices)]):
            return run(slab)

    if (
        split.slab is None and total <= size
    ):  # nothing to put together: the program's own arrays, read-only
        out = jax.tree.map(lambda a: np.asarray(a)[:total], part(0))
        report(total, total)
        return out
    shape = (size, points, leaves[0].dtype)
    first = None
    if (
        shape not in run.outputs
    ):  # one call alone compiles; the threads then find the program ready
        first = part(0)
        run.outputs[shape] = jax.tree.map(
            lambda a: jax.ShapeDtypeStruct(a.shape, a.dtype), first
        )
    out = _allocate(
        jax.tree.map(
            lambda a: jax.ShapeDtypeStruct((total, *a.shape[1:]), a.dtype),
            run.outputs[shape],
        )
    )

    def work(begin: int) -> int:
        result = part(begin) if first is None or begin else first
        end = min(begin + size, total)
        for target, source in zip(
            jax.tree.leaves(out), jax.tree.leaves(result), strict=True
        ):
            target[begin:end] = np.asarray(source)[: end - begin]
        return end - begin

    _share_out(
        work,
        begins,
        min(split.threads or cores, len(begins)) - 1,
        lambda done: report(done, total),
    )
    report(total, total)
    return out


def _share_out(
    work: Callable[[int], int],
    begins: Iterable[int],
    helpers: int,
    notify: Callable[[int], None],
) -> None:
    """work(begin) of every slab by the calling thread and `helpers` others, each taking
    the next when it is free; `notify` is called in the calling thread with the number
    of pairs that are done. After an error or an interrupt nobody begins another."""
    left, done = deque(begins), []

    def take() -> int | None:
        try:
            return left.popleft()
        except IndexError:  # asked first, another thread could be quicker
            return None

    def go(notify: Callable[[int], None]) -> None:
        try:
            while (begin := take()) is not None:
                done.append(work(begin))
                if left:
                    notify(sum(done))
        finally:
            left.clear()

    others = [_pool().submit(go, lambda done: None) for _ in range(helpers)]
    try:
        go(notify)
    finally:
        # who has not begun by now has nothing to do
        others = [other for other in others if not other.cancel()]
        wait(others)
    for other in others:
        other.result()


@lru_cache(maxsize=1)
def _pool() -> ThreadPoolExecutor:
    """Threads that help; they wait for the next call, since to begin one takes as long
    as a hundred pairs."""
    return ThreadPoolExecutor(_count_workers(), "jaxro")


def _count_workers() -> int:
    """Threads that keep every core and every device busy."""
    return max(count_cores(), 2 * jax.local_device_count())


def map_chunks(one: Callable, data: PyTree, chunk: int) -> PyTree:
    """`one` of everything on the leading axis, `chunk` at a time, which is a working
    set that stays in the cache and, where `one` is a loop, how many wait for the last
    of them."""
    count = jax.tree.leaves(data)[0].shape[0]
    if count == 1:  # without batching, which traces every loop several times
        return jax.tree.map(
            lambda a: jnp.asarray(a)[None], one(jax.tree.map(lambda a: a[0], data))
        )
    if count <= chunk:
        return jax.vmap(one)(data)
    if chunk == 1:
        return jax.lax.map(one, data)
    split = jax.tree.map(lambda a: a.reshape(-1, chunk, *a.shape[1:]), data)
    return jax.tree.map(
        lambda a: a.reshape(-1, *a.shape[2:]), jax.lax.map(jax.vmap(one), split)
    )


def count_cores() -> int:
    """The cores that this process may use; all of the machine where the system does not
    tell."""
    return (
        len(os.sched_getaffinity(0))
        if hasattr(os, "sched_getaffinity")
        else os.cpu_count() or 1
    )


def _fill_up(slab: PyTree, size: int) -> PyTree:
    """The slab with zeros (mask False: empty pairs) up to `size` rows."""
    rows = jax.tree.leaves(slab)[0].shape[0]
    if rows == size:
        return slab
    filled = _allocate(
        jax.tree.map(
            lambda a: jax.ShapeDtypeStruct((size, *a.shape[1:]), a.dtype), slab
        )
    )
    for target, source in zip(
        jax.tree.leaves(filled), jax.tree.leaves(slab), strict=True
    ):
        target[:rows], target[rows:] = source, 0
    return filled


def _round_up(chunks: int) -> int:
    """Rounded up to four to seven times a power of two: few sizes, since each is
    another program."""
    step = 1 << max(chunks.bit_length() - 3, 0)
    return -(-chunks // step) * step


def _allocate(shapes: PyTree) -> PyTree:
    """Memory for a slab or a result, aligned as JAX wants it, all in one piece, for
    which the system gives large pages: each is zeroed at its first use, and the small
    ones of many pieces cost a fifth of a large result."""
    leaves, structure = jax.tree.flatten(shapes)
    sizes = [
        -(-math.prod(leaf.shape) * leaf.dtype.itemsize // ALIGNMENT) * ALIGNMENT
        for leaf in leaves
    ]
    room = RESULT_MEMORY.room(sum(sizes) + ALIGNMENT)
    ends = np.cumsum(sizes) + -room.ctypes.data % ALIGNMENT
    parts = [
        room[end - size :][: math.prod(leaf.shape) * leaf.dtype.itemsize]
        .view(leaf.dtype)
        .reshape(leaf.shape)
        for leaf, size, end in zip(leaves, sizes, ends, strict=True)
    ]
    return jax.tree.unflatten(structure, parts)


LARGE = 1 << 16
"""Bytes from which on memory is kept; the allocator itself uses smaller pieces
again."""

PIECES = 64
"""Pieces kept at most, so that a search through them takes microseconds."""


class Memory:
    """Memory for large arrays that is kept, up to `limit` bytes in `PIECES`, from the
    end of one result to the beginning of the next.

    The system clears memory before it gives it out, which takes about as long as
    writing a result into it.
    """

    def __init__(self, limit: int):
        self.limit = limit
        self.kept: list[np.ndarray] = []
        # reentrant: the garbage collector may give back while `room` looks for a piece
        self._lock = threading.RLock()

    def room(self, size: int) -> np.ndarray:
        """So many bytes, not cleared; they are given back when no view of the array is
        left."""
        if size < LARGE:
            return np.empty(size, np.uint8)
        with self._lock:
            fitting = [piece for piece in self.kept if size <= piece.nbytes <= 2 * size]
            piece = min(fitting, key=lambda piece: piece.nbytes, default=None)
            self.kept = [other for other in self.kept if other is not piece]
        if piece is None:
            piece = np.empty(size, np.uint8)
        # through a memoryview, past which NumPy does not look for the base of a view:
        # views hold `lent`, not `piece`
        lent = np.asarray(piece.data[:size])
        weakref.finalize(lent, self._take_back, piece).atexit = False
        return lent

    def _take_back(self, piece: np.ndarray) -> None:
        with self._lock:
            self.kept.append(piece)
            while (
                len(self.kept) > PIECES
                or sum(piece.nbytes for piece in self.kept) > self.limit
            ):
                del self.kept[0]


RESULT_MEMORY = Memory(1 << 29)
"""For the results of batches, and for slabs that are filled up."""
