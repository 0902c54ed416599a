"""Compiled programs: what is an argument of them and what is not; and that they run in
the thread that calls them, as users have them: not kept on disk, as those of the other
tests are."""

import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxro
from jaxro import adjust
from jaxro.adjustment import Term
from jaxro.adjustment.losses import Tukey
from jaxro.geometry import mock_pairs
from jaxro.rejection import DataSnooping, Recommended, Reweighting
from jaxro.xla import programs
from jaxro.xla.programs import compiled, jit_in_this_thread
from jaxro.xla.settings import COMPILE_FAST, RUN_FAST


class Loss(eqx.Module):
    """Options as procedures and losses have them."""

    scale: float = 2.0
    rounds: int = 3


SHIFT = np.array([1.0, 2.0])
FACTOR = 2.0
range = 2.0  # a name of Python's own, with another meaning here


class Settings:
    """A class that a caller uses as a place for numbers."""

    factor = 2.0


this_module = sys.modules[__name__]


def scaled(x, *, loss, also=None):
    traced.append(True)
    x = x * loss.scale**loss.rounds
    return x if also is None else also(x)


traced = []
run = compiled(scaled)


def retraced(call):
    """The result of a call, and whether it made another program."""
    traced.clear()
    return call(), bool(traced)


def test_real_numbers_are_arguments_and_whole_numbers_choose_the_program():
    x = np.arange(2.0)
    run(x, loss=Loss())
    found, again = retraced(lambda: run(x, loss=Loss(scale=3.0)))
    assert not again
    np.testing.assert_allclose(found, 27 * x)
    found, again = retraced(lambda: run(x, loss=Loss(rounds=2)))
    assert again
    np.testing.assert_allclose(found, 4 * x)


def functions_of(shift):
    """The same function written in several ways, as a caller may write it anew for each
    call."""
    return {
        "closure": lambda x: x + shift,
        "default": lambda x, shift=shift: x + shift,
        "partial": partial(lambda shift, x: x + shift, shift),
        "within": lambda x: (lambda y: y + shift)(x),
        "method": Adder(shift).add,
    }


class Adder(eqx.Module):
    shift: jax.Array

    def add(self, x):
        return x + self.shift


@pytest.mark.parametrize("way", ["closure", "default", "partial", "within", "method"])
def test_functions_are_compared_by_their_code(way):
    """Arrays that they close over are arguments, with derivatives."""
    x = np.zeros(2)
    of = lambda shift: run(x, loss=Loss(), also=functions_of(shift)[way])
    np.testing.assert_array_equal(of(jnp.ones(2)), [1.0, 1.0])
    found, again = retraced(lambda: of(jnp.array([2.0, 3.0])))
    assert not again
    np.testing.assert_array_equal(found, [2.0, 3.0])
    by = jax.grad(lambda shift: jnp.sum(of(shift)))(jnp.ones(2))
    np.testing.assert_array_equal(by, [1.0, 1.0])


def test_what_a_function_refers_to_is_never_the_one_of_an_earlier_call(monkeypatch):
    x, here = np.ones(2), sys.modules[__name__]
    of_globals = lambda x: x * FACTOR + SHIFT
    of_builtin, of_class = lambda x: x * range, lambda x: x * Settings.factor
    of_module = lambda x: x * this_module.FACTOR
    state = type("State", (), {"factor": 2.0})()
    of_state = lambda x: x * state.factor
    in_numpy = lambda table: lambda x: x + np.sin(table)[0] + table.shape[0]
    of = lambda also: run(x, loss=Loss(rounds=0), also=also)
    np.testing.assert_allclose(of(of_globals), [3.0, 4.0])
    for also in (of_state, of_builtin, of_class, of_module):
        np.testing.assert_allclose(of(also), [2.0, 2.0])
    np.testing.assert_allclose(of(in_numpy(np.zeros(1))), [2.0, 2.0])
    monkeypatch.setattr(here, "SHIFT", np.array([5.0, 6.0]))
    monkeypatch.setattr(here, "FACTOR", 3.0)
    monkeypatch.setattr(here, "range", 3.0)
    monkeypatch.setattr(Settings, "factor", 3.0)
    state.factor = 3.0
    np.testing.assert_allclose(of(of_globals), [8.0, 9.0])
    for also in (of_state, of_builtin, of_class, of_module):
        np.testing.assert_allclose(of(also), [3.0, 3.0])
    np.testing.assert_allclose(of(in_numpy(np.array([np.pi / 2]))), [3.0, 3.0])
    np.testing.assert_allclose(of(lambda x: -x), [-1.0, -1.0])


def test_parts_of_many_programs_are_traced_once():
    x = np.arange(2.0)
    call = lambda wide, loss: jax.jit(lambda x: run(x, loss=loss) + wide)(x)
    np.testing.assert_allclose(call(1.0, Loss()), 8 * x + 1)
    found, again = retraced(lambda: call(2.0, Loss(scale=3.0)))
    assert not again
    np.testing.assert_allclose(found, 27 * x + 2)
    found, again = retraced(lambda: call(2.0, Loss(rounds=1)))
    assert again
    np.testing.assert_allclose(found, 2 * x + 2)
    np.testing.assert_allclose(jax.grad(lambda x: run(x, loss=Loss()))(1.0), 8.0)
    state = type("State", (), {"factor": 2.0})()  # may be another one at any time
    of_state = lambda: run(x, loss=Loss(rounds=0), also=lambda x: x * state.factor)
    np.testing.assert_allclose(of_state(), 2 * x)
    state.factor = 3.0
    np.testing.assert_allclose(of_state(), 3 * x)


@pytest.fixture(scope="module")
def compilations():
    """How many programs were compiled so far."""
    events = []
    note = lambda event, seconds, **_: events.append(event)
    jax.monitoring.register_event_duration_secs_listener(note)
    return lambda: events.count("/jax/core/compile/backend_compile_duration")


def adjust_line(shift, sigma):
    """A straight line through points, with a condition that is written anew."""
    x = jnp.arange(5.0)
    y = jnp.array([1.0, 2.1, 2.9, 4.2, 5.0])

    def line(parameters, point):
        a, b = parameters
        return a * point[0] + b - point[1] - shift

    start = (jnp.zeros(()), jnp.zeros(()))
    return adjust(Term(line, (x, y), (None, sigma**2)), start)


def test_an_adjustment_is_one_program_for_all_numbers(compilations):
    adjust_line(jnp.asarray(0.5), 0.1)  # compiles small programs of the test, too
    before = compilations()
    found = adjust_line(jnp.asarray(1.5), 0.2)
    assert compilations() == before
    slope, constant = np.polyfit(np.arange(5.0), [1.0, 2.1, 2.9, 4.2, 5.0], 1)
    np.testing.assert_allclose(found.parameters, [slope, constant + 1.5], rtol=1e-12)


def test_known_numbers_are_computed_while_a_program_is_traced():
    outside = adjust_line(jnp.asarray(0.5), 0.1).parameters
    within = jax.jit(lambda: adjust_line(jnp.asarray(0.5), 0.1).parameters)()
    np.testing.assert_allclose(within, outside, rtol=1e-12)


def test_a_first_call_is_few_programs(compilations):
    """Constants within a program are no programs of their own."""
    exact = mock_pairs.mock_pair(mock_pairs.standard_layout(16))
    jax.block_until_ready(jaxro.orient(exact))
    programs.forget()
    jax.clear_caches()
    before = compilations()
    jaxro.orient(exact)
    assert compilations() - before <= 3


@pytest.mark.parametrize(
    "procedure",
    [
        lambda level, sigma: DataSnooping(level=level, sigma=sigma),
        pytest.param(
            lambda level, sigma: Recommended(level=level, sigma=sigma),
            marks=pytest.mark.slow,
        ),
        pytest.param(
            lambda level, sigma: Reweighting(Tukey(scale=40 * level), sigma=sigma),
            marks=pytest.mark.slow,
        ),
    ],
    ids=["data-snooping", "recommended", "tukey"],
)
def test_procedures_are_one_program_for_all_tolerances(procedure, compilations):
    errors = jnp.asarray(0.003 * np.sin(7.0 * np.arange(16.0) ** 2)).at[11].add(0.8)
    exact = mock_pairs.mock_pair(mock_pairs.standard_layout(16))
    pair = mock_pairs.plant(exact, y_right=errors)
    first = procedure(0.1, 0.002)(pair)
    before = compilations()
    found = procedure(0.11, 0.003)(pair), procedure(0.12, None)(pair.with_sigma(0.003))
    assert compilations() == before
    for one in found:
        np.testing.assert_array_equal(np.flatnonzero(~one.mask), [11])
        ratio = first.orientation.sigma0 / one.orientation.sigma0
        np.testing.assert_allclose(ratio, 1.5, rtol=1e-6)


def test_old_programs_are_given_back(monkeypatch):
    monkeypatch.setattr(programs._programs, "_most", 3)
    twice = compiled(lambda x: 2 * x)
    for size in np.arange(8):
        twice(np.zeros(size))
    assert len(programs._programs._kept) <= 3


def long(x):
    """Some hundredth of a second, and more operations than JAX runs in the calling
    thread of itself."""
    return jax.lax.fori_loop(0, 3000, lambda _, x: x * 0.999 + 0.001, x)


def test_a_program_has_run_when_its_call_returns(unkept):
    x = jnp.linspace(0.0, 1.0, 3000)
    for run in (jit_in_this_thread(long), compiled(long, settings=RUN_FAST)):
        jax.block_until_ready(run(x))
        assert run(x).is_ready()


@pytest.mark.parametrize(
    "first", [0.0, np.nan, np.inf, np.finfo(float).max, -np.finfo(float).max]
)
def test_whatever_the_first_number(unkept, first):
    x = np.array([first, 1.0, 2.0])
    np.testing.assert_array_equal(jit_in_this_thread(lambda x: (-x, x[:0]))(x)[0], -x)


@pytest.mark.parametrize(
    "data",
    [np.zeros((0, 2)), np.arange(3), np.array([True, False]), np.float32([1, 2])],
)
def test_arrays_of_any_kind(unkept, data):
    np.testing.assert_array_equal(
        jit_in_this_thread(lambda x: x[::-1])(data), data[::-1]
    )


@pytest.mark.slow
def test_batches_from_two_threads_at_once_are_those_of_kept_programs(request):
    vertical = mock_pairs.mock_pair(mock_pairs.standard_layout(16))
    pairs = jax.vmap(lambda key: mock_pairs.noisy(vertical, key, 0.01))(
        jax.random.split(jax.random.key(5), 3000)
    )
    kept = jaxro.orient_batch(pairs)
    request.getfixturevalue("unkept")
    with ThreadPoolExecutor(2) as pool:
        for one in pool.map(jaxro.orient_batch, [pairs] * 4):
            jax.tree.map(np.testing.assert_array_equal, one, kept)


def test_functions_of_a_user_may_be_compiled_sooner():
    options = jaxro.compiler_options()
    x = np.linspace(0.0, 1.0, 7)
    sooner = jax.jit(lambda x: jnp.sin(x), compiler_options=options)
    np.testing.assert_allclose(sooner(x), np.sin(x))
    assert options and set(options) <= set(COMPILE_FAST)


def test_where_jax_keeps_programs_it_keeps_these(tmp_path):
    code = f"""
import jax
jax.config.update("jax_compilation_cache_dir", {str(tmp_path)!r})
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)
import jaxro
jaxro.orient(jaxro.pair(*4 * [[1.0, -2.0, 5.0, -6.0, 3.0, 8.0]], focal=100.0))
"""
    unkept = os.environ | {"JAXRO_CACHE": ""}
    subprocess.run([sys.executable, "-c", code], check=True, env=unkept)
    assert any("orient_near" in file.name for file in tmp_path.iterdir())
