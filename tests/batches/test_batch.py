"""Batches: the same results as one by one, from any thread, without LAPACK."""

import os
import re
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from functools import cache

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import problems
import pytest
from mock_photos import FOCAL, block, photographed
from tiers import seldom

import jaxro
from jaxro import DependentElements
from jaxro.batches import batch
from jaxro.geometry import mock_pairs
from jaxro.geometry.elements import vertical
from jaxro.orientation.problem import Problem
from jaxro.xla import slabs, store
from jaxro.xla.kernels import one_kernel, one_kernel_fusing_points
from jaxro.xla.passes import pointwise
from jaxro.xla.programs import Program, compiled
from jaxro.xla.settings import NO_LIBRARY_SUMS, RUN_FAST, UNSPLIT_LOOPS, known_settings
from jaxro.xla.slabs import LARGE, PIECES, Memory

COUNT, POINTS = 150, 9


@problems.jit
def mixed():
    """COUNT pairs in any position among near-vertical ones, ragged."""
    anywhere, _ = mock_pairs.random_pairs(jax.random.key(1), COUNT, POINTS, focal=100.0)
    key = jax.random.split(jax.random.key(2), COUNT)
    layout = mock_pairs.standard_layout(POINTS)
    elements = jaxro.IndependentElements(
        *(jnp.asarray(a) for a in (0.01, -0.02, 0.015, 0.02, 0.01))
    )
    near = jax.vmap(
        lambda k: mock_pairs.noisy(
            mock_pairs.mock_pair(layout, elements, focal=100.0), k, 0.01
        )
    )(key)
    pick = jnp.arange(COUNT) % 3 == 0
    choose = lambda a, b: jnp.where(pick.reshape(-1, *[1] * (a.ndim - 1)), a, b)
    pairs = jax.tree.map(choose, anywhere, near)
    return pairs.with_mask(
        jnp.arange(POINTS)[None, :] < POINTS - jnp.arange(COUNT)[:, None] % 2
    )


@pytest.fixture(scope="module")
def pairs():
    return mixed()


@pytest.fixture(scope="module")
def near(pairs):
    """Those that start from the vertical, which need one program instead of two."""
    return jax.tree.map(lambda a: np.delete(a, np.s_[::3], axis=0), pairs)


@pytest.fixture(scope="module")
def whole(pairs):
    """Their orientations by `orient_batch`."""
    return jaxro.orient_batch(pairs)


@pytest.fixture(scope="module")
def loop(pairs):
    """The compiled loop over the pairs without `orient_batch`."""
    return problems.jit(jax.vmap(jaxro.orient)).lower(pairs).compile()


def test_batch_equals_one_by_one(pairs, whole):
    assert np.mean(whole.usable) > 0.9
    host = jax.tree.map(np.asarray, pairs)
    for i in np.flatnonzero(whole.usable):
        alone = jaxro.orient(jax.tree.map(lambda a, i=i: a[i], host))
        for one, other in zip(
            jax.tree.leaves(whole.pose), jax.tree.leaves(alone.pose), strict=True
        ):
            np.testing.assert_allclose(one[i], other, rtol=0, atol=1e-12)


@pytest.mark.slow
def test_more_points_than_a_chunk_holds():
    rng = np.random.default_rng(7)
    x, y, z = rng.uniform((0, -90, -165), (90, 90, -135), (20_000, 3)).T
    exact = jaxro.pair(*(-150 * a / z for a in (x, y, x - 90, y)), focal=150.0)
    pairs = jax.vmap(lambda k: mock_pairs.noisy(exact, k, 0.01))(
        jax.random.split(jax.random.key(7), 2)
    )
    together = jaxro.orient_batch(pairs, select=lambda o: o.pose)
    alone = jaxro.orient(jax.tree.map(lambda a: a[1], pairs)).pose
    for one, other in zip(
        jax.tree.leaves(together), jax.tree.leaves(alone), strict=True
    ):
        np.testing.assert_allclose(one[1], other, rtol=0, atol=1e-12)


OTHERS = {"threads": 1, "chunk": 16, "elements": DependentElements, "base": 1.0}


@pytest.mark.slow
@pytest.mark.parametrize("options", [{}, OTHERS])
def test_batch_equals_vmap(pairs, loop, options):
    batch = jaxro.orient_batch(pairs, **options)
    single = {k: v for k, v in options.items() if k in ("elements", "base")}
    loop = (
        problems.jit(jax.vmap(lambda pair: jaxro.orient(pair, **single)))
        if single
        else loop
    )(pairs)
    np.testing.assert_array_equal(
        np.asarray(batch.result._value), np.asarray(loop.result._value)
    )
    for one, other in (
        (batch.pose.quaternion, loop.pose.quaternion),
        (batch.pose.base, loop.pose.base),
        (batch.parallax / 100, loop.parallax / 100),
    ):
        np.testing.assert_allclose(one, other, atol=1e-9)


@pytest.mark.slow
def test_any_chunk_will_do(pairs, near, loop):
    few = lambda pairs: jax.tree.map(lambda a: a[:7], pairs)
    found = jaxro.orient_batch(few(pairs), select=_sigma0, chunk=3)
    expected = np.asarray(loop(pairs).sigma0)
    np.testing.assert_allclose(found, expected[:7], rtol=1e-9, atol=1e-12)
    found = jaxro.orient_batch(few(near), select=_sigma0, chunk=100)
    expected = np.delete(expected, np.s_[::3])[:7]
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        *(
            (wrong, "must be positive")
            for wrong in ({"chunk": 0}, {"threads": 0}, {"threads": -1})
        ),
        ({"losses": None}, "no option 'losses': orient takes elements"),
        ({"base": np.ones(3)}, "`base` holds for all pairs of a batch"),
        ({"start": vertical(jnp.ones(3))}, "`start` holds for all pairs of a batch"),
    ],
)
def test_what_cannot_be_is_refused(pairs, wrong, message):
    with pytest.raises((ValueError, TypeError), match=message):
        jaxro.orient_batch(pairs, select=_sigma0, **wrong)


def _sigma0(orientation):
    return orientation.sigma0


@pytest.mark.slow
def test_programs_of_functions_without_a_name_are_told_apart(near, tmp_path, unkept):
    """A kept program of a lambda is known by what it computes."""
    few = jax.tree.map(lambda a: a[:7], near)
    reads = lambda o: o.sigma0, lambda o: o.m_q, lambda o: o.sigma0
    store.use(tmp_path)
    first, other, again = (
        jaxro.orient_batch(few, select=read, chunk=3) for read in reads
    )
    np.testing.assert_array_equal(again, first)
    whole = jaxro.orient_batch(few, chunk=3)
    np.testing.assert_allclose(first, whole.sigma0, rtol=1e-10)
    np.testing.assert_allclose(other, whole.m_q, rtol=1e-10)


def test_only_what_is_selected_and_progress(near, whole):
    told = []
    pose = jaxro.orient_batch(
        near,
        select=lambda o: o.pose,
        chunk=8,
        threads=2,
        progress=lambda done, total: told.append((done, total)),
    )
    expected = np.delete(np.asarray(whole.pose.base), np.s_[::3], axis=0)
    np.testing.assert_allclose(pose.base, expected, atol=1e-9)
    done, totals = zip(*told, strict=True)
    assert set(totals) == {100} and list(done) == sorted(done) and done[-1] == 100


EVERYTHING = {"read": batch.Selected(lambda o: o), "problem": Problem(), "chunk": 32}
"""Options of a program that gives whole orientations."""


@cache
def with_kernel(kernel):
    """The compiled program of 96 pairs, which is an error if the compiler refuses the
    kernel."""
    run = lambda data: kernel(batch._orient_slab_near.function)(data, **EVERYTHING)
    options = known_settings(RUN_FAST | UNSPLIT_LOOPS | NO_LIBRARY_SUMS)
    few = jax.tree.map(lambda a: a[:96], mixed())
    return jax.jit(run, compiler_options=options).lower(few).compile()


@cache
def without_kernel():
    program = batch._orient_slab_near.using(RUN_FAST | UNSPLIT_LOOPS)
    few = jax.tree.map(lambda a: a[:96], mixed())
    return jax.tree.map(np.asarray, program(few, **EVERYTHING))


@pytest.mark.slow
@pytest.mark.parametrize("kernel", [one_kernel, one_kernel_fusing_points])
def test_one_kernel_gives_what_many_give(pairs, kernel):
    few = jax.tree.map(lambda a: a[:96], pairs)
    one, fits = jax.tree.map(np.asarray, with_kernel(kernel)(few))
    many, again = without_kernel()
    np.testing.assert_array_equal(fits, again)
    np.testing.assert_array_equal(one.iterations[fits], many.iterations[fits])
    for part in (
        "pose",
        "deviations",
        "parallax",
        "residuals",
        "redundancy",
        "model",
        "in_front",
        "m_q",
        "result",
    ):
        for a, b in zip(
            jax.tree.leaves(getattr(one, part)),
            jax.tree.leaves(getattr(many, part)),
            strict=True,
        ):
            np.testing.assert_allclose(
                a[fits], b[fits], rtol=1e-9, atol=1e-12, err_msg=part
            )


@pytest.mark.slow
def test_results_of_points_are_one_loop_each():
    """A reduction with the two results of the adjustment and one with the six of the
    oriented pair. If their calls were not marked any more, they would be inlined, read
    dozens of arrays, and be loops of single numbers."""
    text = with_kernel(one_kernel_fusing_points).as_text()
    results, arguments = zip(
        *re.findall(r"= \(([^)]*32,9\][^)]*)\) fusion\((.*?)\), kind", text),
        strict=True,
    )
    assert sorted(each.count("[32,9]") for each in results) == [2, 6]
    # the arrays of the points, and their numbers as one
    assert all(each.count("%") <= 9 for each in arguments)


def test_points_in_one_loop_are_points_one_by_one():
    x, use = jnp.asarray([1.0, -2.0, jnp.nan, jnp.inf, 0.0]), jnp.arange(5) < 3

    def several(x, use, scale):
        return {
            "flag": use & (x > 0),
            "moved": jnp.where(use, x * scale, 1.0),
            "twice": 2 * x,
        }

    of = lambda data: pointwise(lambda x, use: several(x, use, data[2]), *data[:2])
    slope = lambda data: jax.grad(
        lambda scale: jnp.sum(of((jnp.where(use, x, 0.0), use, scale))["moved"][:2])
    )(data[2])
    for function in (of, slope):
        one, many = (
            compiled(function, settings=RUN_FAST, kernel=kernel)(
                (x, use, jnp.asarray(3.0))
            )
            for kernel in (one_kernel_fusing_points, None)
        )
        for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(many), strict=True):
            np.testing.assert_array_equal(a, b)


def test_what_no_kernel_can_do_is_done_all_the_same(near, whole):
    ranked = jaxro.orient_batch(near, select=lambda o: jnp.sort(o.residuals))
    expected = np.delete(np.asarray(whole.residuals), np.s_[::3], axis=0)
    np.testing.assert_allclose(ranked, np.sort(expected), atol=1e-9)


@pytest.fixture(scope="module")
def derivative(pairs):
    """The compiled gradient of the sum of a pose's qx over the pairs."""
    total = lambda p: jnp.sum(jax.vmap(jaxro.orient)(p).pose.qx)
    return problems.jit(jax.grad(total, allow_int=True)).lower(pairs).compile()


PROGRAMS = seldom(["loop", "derivative"], ["loop"])


@pytest.mark.slow
def test_derivatives_of_a_batch_are_differences(pairs, loop, derivative):
    """Of pairs in any position among near-vertical ones, by the fourth point."""
    gradient = np.asarray(derivative(pairs).y_left[:, 3])
    step = 1e-4
    moved = lambda h: (
        loop(
            eqx.tree_at(lambda p: p.y_left, pairs, pairs.y_left.at[:, 3].add(h))
        ).pose.qx
    )
    difference = (moved(step) - moved(-step)) / (2 * step)
    usable = np.asarray(loop(pairs).usable)
    assert np.sum(usable[::3]) > 40 and np.sum(usable) > 120
    np.testing.assert_allclose(
        gradient[usable], difference[usable], rtol=1e-5, atol=1e-9
    )


@pytest.mark.parametrize("name", PROGRAMS)
def test_a_failing_neighbour_changes_no_bit(pairs, loop, name, request):
    """Neither of an orientation nor of a derivative."""
    bad = [
        photographed(block(POINTS), base=(0.0, 0.0, 0.0)),
        photographed(block(POINTS)).with_mask(np.arange(POINTS) < 3),
        jaxro.pair(*np.full((4, POINTS), np.nan), focal=FOCAL),
        jaxro.pair(
            *np.random.default_rng(1).uniform(-90, 90, (4, POINTS)), focal=FOCAL
        ),
    ]
    begin = COUNT - len(bad)
    among = jax.tree.map(
        lambda a, new: jnp.concatenate([a[:begin], new]), pairs, jaxro.stack(bad)
    )
    assert not np.any(loop(among).usable[begin:])
    program = request.getfixturevalue(name)
    alone, beside = program(pairs), program(among)
    for a, b in zip(jax.tree.leaves(alone), jax.tree.leaves(beside), strict=True):
        np.testing.assert_array_equal(np.asarray(a)[:begin], np.asarray(b)[:begin])


def test_a_batch_takes_little_memory(loop, pairs):
    """A pair of nine points needs 150 kB for the general start, and only few are worked
    on at a time."""
    assert loop.memory_analysis().temp_size_in_bytes < 150 * 40e3


@pytest.mark.parametrize("name", PROGRAMS)
def test_no_lapack_in_the_batch_path(name, request):
    allowed = {"loop": set(), "derivative": {"xla_ffi_python_cpu_callback"}}[name]
    text = request.getfixturevalue(name).as_text()
    assert set(re.findall(r'custom_call_target="([^"]+)"', text)) <= allowed
    assert "while" in text and not re.search(
        r"= \S+ (cholesky|triangular-solve)\(", text
    )


def test_the_general_start_runs_only_where_a_pair_needs_it(loop):
    """XLA must not move it before the loop that is to skip it (then near-vertical pairs
    take four hundred times as long)."""
    text = loop.as_text()
    always = text[text.index("\nENTRY") :]
    assert "/general/" in text
    assert not re.findall(r" (?:while|call|reduce|dot)\(.*/general/.*", always)


def test_batches_from_two_threads_at_once(pairs):
    expected = jaxro.orient_batch(pairs, threads=1).pose.base
    with ThreadPoolExecutor(2) as pool:
        results = list(
            pool.map(lambda _: jaxro.orient_batch(pairs).pose.base, range(8))
        )
    for base in results:
        np.testing.assert_array_equal(base, expected)


class Doubled(Program):
    """Stands for a compiled program; fails at what begins with `bad`."""

    outputs = None

    def __init__(self, bad=None, becomes=None):
        self.bad, self.becomes, self.outputs, self.began = bad, becomes, {}, []

    def __call__(self, data):
        self.began.append(int(data[0]))
        time.sleep(1e-4)  # lets the others have their turn, as a program does
        if data[0] == self.bad:
            raise OSError("no more")
        return 2 * data if self.becomes is None else self.becomes


def test_slabs_are_shared_and_an_end_is_one_for_all():
    """Every slab once by whoever is free; after an error in any thread, or in the
    report of progress, nobody begins another."""
    data = np.arange(1000)
    for threads in (1, 2, 5):
        run = Doubled()
        np.testing.assert_array_equal(
            slabs.spread(data, run, slabs.Split(threads, slab=1), 1), 2 * data
        )
        assert sorted(run.began) == data.tolist()
        for bad in (0, 1, 2, 10):
            run = Doubled(bad)
            with pytest.raises(OSError, match="no more"):
                slabs.spread(data, run, slabs.Split(threads, slab=1), 1)
            assert len(run.began) < 100
        run = Doubled()
        with pytest.raises(KeyboardInterrupt):
            slabs.spread(data, run, slabs.Split(threads, slab=1), 1, _interrupted)
        assert len(run.began) < 100


def test_a_slab_is_stored_before_the_next_is_calculated():
    """While it is in the cache."""
    seen = []

    class Calculating:
        shape, dtype = (1,), np.dtype(int)

        def __array__(self, dtype=None, copy=None):
            seen.append(len(run.began))
            return np.zeros(1, int)

    run = Doubled(becomes=Calculating())
    slabs.spread(np.arange(10), run, slabs.Split(1, slab=1), 1)
    assert seen == [1, 2, 3, 4, 5, 6, 7, 8, 9, 10]


def _interrupted(done, total):
    raise KeyboardInterrupt


def _model(orientation):
    return orientation.model


def test_memory_that_a_program_still_reads_is_not_used_again():
    program = jax.jit(
        lambda x: jax.lax.fori_loop(0, 200, lambda _, y: jnp.sin(y) + x, x)
    )
    rows, size = 3 << 14, 1 << 16
    expected = program(np.concatenate([np.ones(rows), np.zeros(size - rows)]))
    found = program(slabs._fill_up(np.ones(rows), size))  # goes on in another thread
    slabs._fill_up(np.full(rows, 7.0), size)
    np.testing.assert_array_equal(found, expected)


def test_memory_is_used_again_only_when_nobody_holds_it(pairs):
    store, size = Memory(4 * LARGE), 2 * LARGE
    first = store.room(size)
    address, view = first.ctypes.data, first[100:200].view(np.int32)
    del first
    second = store.room(size)
    assert not np.shares_memory(second, view)
    del view
    assert store.room(size - 1).ctypes.data == address  # given back at once
    three = [store.room(size) for _ in range(3)]
    del second, three
    assert sum(piece.nbytes for piece in store.kept) <= store.limit
    many = [store.room(LARGE) for _ in range(2 * PIECES)]
    store.limit = 4 * PIECES * LARGE
    del many
    assert len(store.kept) <= PIECES
    # a result that is held, even only a part of it, stays what it was
    near = jax.tree.map(
        lambda a: np.tile(np.asarray(a)[1::3], (800, *[1] * (a.ndim - 1))), pairs
    )
    once = jaxro.orient_batch(near, select=_model)[0]
    kept, copy = np.asarray(once), np.array(once)
    del once
    turned = jax.tree.map(lambda a: a[::-1], near)
    again = np.asarray(jaxro.orient_batch(turned, select=_model)[0])
    np.testing.assert_array_equal(kept, copy)
    assert not np.array_equal(again, copy)


def test_any_function_of_a_pair(pairs):
    """In pair order whatever the slabs, each by its own; the whole tree comes back."""
    seen: list = []
    spread = lambda pair: {
        "widest": jnp.max(pair.x_left) - jnp.min(pair.x_left),
        "used": pair.mask,
    }
    found = jaxro.map_batch(
        spread, pairs, chunk=4, progress=lambda done, total: seen.append((done, total))
    )
    np.testing.assert_array_equal(
        found["widest"], np.ptp(np.asarray(pairs.x_left), axis=1)
    )
    np.testing.assert_array_equal(found["used"], pairs.mask)
    assert seen[-1] == (len(pairs.x_left),) * 2


@pytest.mark.slow
def test_a_batch_is_read_as_each_of_its_pairs(pairs, loop):
    """Whatever is made of a pair and its orientation, those from the vertical and those
    from the general start; what is derived from a reading, in NumPy as in JAX."""
    errors = 0.01 * np.random.default_rng(3).normal(size=(4, *pairs.mask.shape))
    names = ("x_left", "y_left", "x_right", "y_right")
    noisy = mock_pairs.plant(pairs, **dict(zip(names, errors, strict=True)))
    first = lambda tree: jax.tree.map(lambda leaf: leaf[:24], tree)
    read = lambda pair, photo: jaxro.assess(pair, photo, sigma0=0.01)
    readings = jaxro.orient_batch(first(noisy), read=read)
    alone = problems.jit(jax.vmap(read))(first(noisy), first(loop(noisy)))
    on_host = jax.tree.map(np.asarray, readings)
    assert np.mean(readings.testable) > 0.4
    for name in ("w", "tau", "t", "external", "largest_m_q"):
        one, other, third = (getattr(r, name) for r in (readings, alone, on_host))
        np.testing.assert_allclose(one, other, rtol=1e-5, atol=1e-7)
        np.testing.assert_allclose(third, one, rtol=1e-12)
    for one, other, third in zip(
        readings.detectable, alone.detectable, on_host.detectable, strict=True
    ):
        np.testing.assert_allclose(one, other, rtol=1e-6)
        np.testing.assert_allclose(third, one, rtol=1e-12)


DEVICES = """
import jax, numpy, jaxro
from jaxro.xla.programs import Program

used = set()
call = Program.__call__

def noted(self, data):
    used.add(jax.config.jax_default_device)
    return call(self, data)


Program.__call__ = noted
x = numpy.arange(40000.0).reshape(2500, 16)
pairs = jaxro.pair(x, x, x, x, focal=1.0)
found = jaxro.map_batch(lambda pair: pair.x_left[0] + pair.y_right[1], pairs)
assert len(jax.devices()) == 3 and used == set(jax.devices()), used
numpy.testing.assert_array_equal(found, x[:, 0] + x[:, 1])
"""


def test_several_devices_take_turns():
    environment = os.environ | {"XLA_FLAGS": "--xla_force_host_platform_device_count=3"}
    done = subprocess.run(
        [sys.executable, "-c", DEVICES], env=environment, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr[-2000:]
