"""Programs on disk: found again, and never read from where somebody else could have put
them."""

import os
import pickle

import jax.numpy as jnp
import numpy as np
import pytest

from jaxro.xla import programs, store
from jaxro.xla.programs import Program


def double(x):
    return 2 * x


@pytest.fixture
def folder(tmp_path):
    """A folder of kept programs, in which one is."""
    kept = tmp_path / "programs"
    store.use(kept)
    run()
    yield kept
    store.use(None)
    programs._remembered.cache_clear()


def run() -> None:
    """Calls the program as a new process would."""
    programs._remembered.cache_clear()
    result = Program(double, {})(jnp.arange(3.0))
    np.testing.assert_array_equal(result, [0.0, 2.0, 4.0])


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


@pytest.mark.parametrize("kind", ["link", "writable"])
def test_a_file_of_others_is_not_read(folder, tmp_path, kind):
    path, trap = program_in(folder), pickle.dumps(Trap(tmp_path / "sprung"))
    digest = store.hashlib.sha256(trap).digest()
    if kind == "link":
        path.unlink()
        (tmp_path / "planted").write_bytes(digest + trap)
        path.symlink_to(tmp_path / "planted")
    else:
        path.write_bytes(digest + trap)
        path.chmod(0o666)
    run()
    assert not (tmp_path / "sprung").exists()


@pytest.mark.parametrize("mode", [0o775, 0o777, 0o2777])
def test_a_folder_that_others_may_write_to_is_not_used(tmp_path, mode):
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


def test_a_folder_that_cannot_be_written_to_costs_only_time(tmp_path):
    blocked = tmp_path / "file"
    blocked.write_text("no folder")
    store.use(blocked / "programs")
    try:
        run()
    finally:
        store.use(None)
