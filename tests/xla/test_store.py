"""Programs on disk: found again, and never read from where somebody else could have put
them."""

import os
import pickle
import subprocess
import sys

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxro.xla import programs, store
from jaxro.xla.programs import compiled


@compiled
def double(x):
    return 2 * x


@pytest.fixture
def folder(tmp_path, unkept):
    """A folder of kept programs, in which one is."""
    kept = tmp_path / "programs"
    store.use(kept)
    run()
    return kept


def run() -> None:
    """Calls the program as a new process would."""
    programs.forget()
    np.testing.assert_array_equal(double(jnp.arange(3.0)), [0.0, 2.0, 4.0])


class Trap:
    """A pickle that does something when it is read."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return os.mkdir, (str(self.path),)


def program_in(folder):
    (path,) = folder.glob("*.program")
    return path


def test_it_is_found_again(folder, monkeypatch):
    assert folder.stat().st_mode & 0o777 == 0o700
    monkeypatch.setattr(store, "_write", lambda *_: pytest.fail("compiled again"))
    run()


def test_a_pickle_without_its_digest_is_not_read(folder, tmp_path):
    program_in(folder).write_bytes(pickle.dumps(Trap(tmp_path / "sprung")))
    run()
    assert not (tmp_path / "sprung").exists()


@pytest.mark.parametrize("kind", ["link", "writable", "pipe"])
def test_a_file_of_others_is_not_read(folder, tmp_path, kind):
    path, trap = program_in(folder), pickle.dumps(Trap(tmp_path / "sprung"))
    sealed = store._seal(bytes.fromhex(path.stem), trap) + trap
    if kind == "writable":
        path.write_bytes(sealed)
        path.chmod(0o666)
    else:
        path.unlink()
    if kind == "link":
        (tmp_path / "planted").write_bytes(sealed)
        path.symlink_to(tmp_path / "planted")
    if kind == "pipe":
        os.mkfifo(path)
    run()
    assert not (tmp_path / "sprung").exists()


def test_a_file_under_the_name_of_another_program_is_not_read(folder):
    """Two programs change places: each is compiled anew."""
    path = program_in(folder)
    content = path.read_bytes()
    compiled(lambda x: -x)(jnp.arange(3.0))
    (other,) = set(folder.glob("*.program")) - {path}
    path.write_bytes(other.read_bytes())
    other.write_bytes(content)
    run()


def test_what_a_caller_wrote_is_known_by_its_program(folder, monkeypatch):
    """A class of the same name with another method is not taken for the old one."""

    def call(factor):
        source = f"def __call__(self, x):\n    return {factor} * x\n"
        body: dict = {}
        exec(source, body)
        own = type("Own", (eqx.Module,), {"__call__": body["__call__"]})
        programs.forget()
        return compiled(lambda x, *, own: own(x))(jnp.arange(3.0), own=own())

    np.testing.assert_array_equal(call(2.0), [0.0, 2.0, 4.0])
    np.testing.assert_array_equal(call(3.0), [0.0, 3.0, 6.0])
    monkeypatch.setattr(store, "_write", lambda *_: pytest.fail("compiled again"))
    np.testing.assert_array_equal(call(3.0), [0.0, 3.0, 6.0])


def test_what_was_not_used_for_longest_goes(folder, monkeypatch):
    first = program_in(folder)
    os.utime(first, (1.0, 1.0))
    monkeypatch.setattr(store, "MAX_BYTES", 2 * first.stat().st_size)
    for size in (4, 5, 6):
        double(jnp.zeros(size))
    assert not first.exists()
    assert 1 <= len(list(folder.glob("*.program"))) <= 2


@pytest.mark.parametrize(
    "emptied", ["ours", pytest.param("of JAX", marks=pytest.mark.slow)]
)
def test_it_works_beside_the_folder_of_jax(tmp_path, emptied):
    """Both keep programs; one of the folders is emptied; every call gives the same."""
    code = """
import jax
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)
import jaxro
from jaxro.xla.programs import compiled
print(compiled(lambda x: 2 * x)(1.5))
"""
    ours, of_jax = tmp_path / "ours", tmp_path / "jax"
    folders = {"JAXRO_CACHE": str(ours), "JAX_COMPILATION_CACHE_DIR": str(of_jax)}
    for call in range(3):
        done = subprocess.run(
            [sys.executable, "-c", code],
            env=os.environ | folders,
            capture_output=True,
            text=True,
        )
        assert done.stdout.strip() == "3.0", done.stderr
        if call == 0:
            for file in (ours if emptied == "ours" else of_jax).iterdir():
                file.unlink()


def test_a_stored_program_that_does_not_run_is_compiled_anew(folder, monkeypatch):
    def broken(*_):
        raise jax.errors.JaxRuntimeError("NOT_FOUND: function of the program")

    monkeypatch.setattr(store, "_read", lambda *_: (broken, [0]))
    run()


@pytest.mark.parametrize("mode", [0o775, 0o777, 0o2777])
def test_a_folder_that_others_may_write_to_is_not_used(tmp_path, unkept, mode):
    shared = tmp_path / "shared"
    shared.mkdir()
    shared.chmod(mode)
    store.use(shared)
    assert not store.active()


def test_flipped_bytes_are_compiled_anew(folder):
    path = program_in(folder)
    whole = path.read_bytes()
    for place in np.random.default_rng(0).integers(0, len(whole), 20):
        broken = bytearray(whole)
        broken[place] ^= 0x5A
        path.write_bytes(bytes(broken))
        run()


def test_a_folder_that_cannot_be_written_to_costs_only_time(tmp_path, unkept):
    blocked = tmp_path / "file"
    blocked.write_text("no folder")
    store.use(blocked / "programs")
    run()
