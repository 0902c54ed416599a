"""Strict settings for every test, shapes checked at run time, and the folder of
measured data."""

import gc
import os
import resource
from functools import wraps
from importlib.metadata import version
from pathlib import Path

import pytest
from jaxtyping import install_import_hook

# has to come before the first import of the package, in this process and for its
# submodules
install_import_hook("jaxro", "beartype.beartype")

os.environ["JAXRO_QUIET"] = "1"
# most of the time goes into compiling programs that run once
cheap = ["backend_optimization_level=0", "cpu_parallel_codegen_split_count=1"]
# later compilers have no older code generator, and end the process at a name that they
# do not know
if tuple(map(int, version("jaxlib").split(".")[:3])) <= (0, 11, 0):
    cheap.append("cpu_use_fusion_emitters=false")
os.environ["XLA_FLAGS"] = " ".join(
    [os.environ.get("XLA_FLAGS", ""), *(f"--xla_{flag}" for flag in cheap)]
).strip()
# what several tests, or processes they start, compile is compiled once, and kept for the
# next run; given a size, JAX locks the folder to write, and gives back what is old
caches = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
kept = os.environ.get("JAX_COMPILATION_CACHE_DIR") or str(caches / "jaxro-tests")
os.environ["JAX_COMPILATION_CACHE_DIR"] = kept
# whole programs, which nobody has to trace again, are kept beside them until a line of
# the package changes
os.environ["JAXRO_CACHE"] = str(Path(kept) / "programs")
if "PYTEST_XDIST_WORKER" not in os.environ:
    # a run that was killed may have left a program without the time of its use, which
    # JAX never reads again, and warns of
    for program in Path(kept).glob("*-cache"):
        used = program.with_name(program.name.removesuffix("cache") + "atime")
        if not used.exists():
            program.unlink()
os.environ["JAX_COMPILATION_CACHE_MAX_SIZE"] = str(1 << 32)
os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0.2"

import jax  # noqa: E402
import numpy as np  # noqa: E402
from examples import example  # noqa: E402, F401 (a fixture of all tests)
from jax.experimental.compilation_cache import compilation_cache  # noqa: E402
from program_budget import Budget  # noqa: E402

from jaxro.batches import padding  # noqa: E402
from jaxro.geometry import pairs  # noqa: E402
from jaxro.xla import programs, settings, store  # noqa: E402

# what JAX keeps of the programs would be looked through at every collection: a
# sixteenth of the time
gc.disable()
settings.COMPILE_FAST.update(settings.COMPILE_FASTEST)
# pairs are padded to fewer sizes, as each is another program: 16, 64, 256, ...
pairs.ROOMS = pairs.ROOMS[::2]


def few(steps):
    """In place of all steps of a table, the sizes of single pairs."""

    @wraps(steps)
    def rooms(longest):
        return np.array(pairs.ROOMS[: pairs.ROOMS.index(pairs.room_for(longest)) + 1])

    return rooms


padding.steps = few(padding.steps)
jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_numpy_dtype_promotion", "strict")


MEMORY = 5 << 30
"""Bytes above which a process gives back its programs at the end of a file."""

MAPS = 30_000
"""Pieces of memory above which it does, too: a system allows some 65,000."""


def has_room() -> bool:
    """Whether this process may keep its programs for the next file; not where the
    system does not tell."""
    own = Path("/proc/self")
    if not own.exists():
        return False
    pages = int((own / "statm").read_text().split()[1])
    pieces = (own / "maps").read_bytes().count(b"\n")
    return pages * resource.getpagesize() < MEMORY and pieces < MAPS


@pytest.fixture(scope="module", autouse=True)
def memory():
    """Gives back the programs of a file at its end where there are too many of them."""
    yield
    if not has_room():
        jax.clear_caches()
        programs.forget()
        gc.collect()


@pytest.fixture
def unkept():
    """Every program is compiled: none is left in memory, on disk or in JAX's own
    cache."""
    folder = jax.config.jax_compilation_cache_dir

    def use(folder: str | None, programs_in: Path | None) -> None:
        jax.config.update("jax_compilation_cache_dir", folder)
        compilation_cache.reset_cache()
        store.use(programs_in)
        programs.forget()

    use(None, None)
    yield
    use(folder, store.default_folder())


def pytest_configure(config: pytest.Config) -> None:
    config.pluginmanager.register(Budget(), "program budget")


@pytest.fixture(scope="session")
def data() -> Path:
    """The folder of measured pairs; tests that need it say so when it is not there."""
    beside = Path(__file__).resolve().parents[2] / "shared" / "data"
    folder = Path(os.environ.get("JAXRO_DATA", beside))
    if not folder.is_dir():
        pytest.skip(
            f"no measured data at {folder}: set JAXRO_DATA to the folder that holds it"
        )
    return folder
