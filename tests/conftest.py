"""Strict settings for every test, shapes checked at run time, and the folder of
measured data."""

import atexit
import gc
import os
import shutil
import tempfile
from importlib.metadata import version
from pathlib import Path

import pytest
from jaxtyping import install_import_hook

# has to come before the first import of the package, in this process and for its
# submodules
install_import_hook("jaxro", "beartype.beartype")

os.environ["JAXRO_CACHE"] = ""  # no test finds what another one left
# most of the time goes into compiling programs that run once
cheap = ["backend_optimization_level=0", "cpu_parallel_codegen_split_count=1"]
# later compilers have no older code generator, and end the process at a name that they
# do not know
if tuple(map(int, version("jaxlib").split(".")[:3])) <= (0, 11, 0):
    cheap.append("cpu_use_fusion_emitters=false")
os.environ["XLA_FLAGS"] = " ".join(
    [os.environ.get("XLA_FLAGS", ""), *(f"--xla_{flag}" for flag in cheap)]
).strip()
# what several tests, or processes they start, compile is compiled once; given a size,
# JAX locks the folder to write. A folder given by the caller outlives the run.
if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
    os.environ["JAX_COMPILATION_CACHE_DIR"] = tempfile.mkdtemp(prefix="jaxro-tests-")
    atexit.register(
        shutil.rmtree, os.environ["JAX_COMPILATION_CACHE_DIR"], ignore_errors=True
    )
os.environ["JAX_COMPILATION_CACHE_MAX_SIZE"] = str(1 << 34)
os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0.2"

import jax  # noqa: E402

from jaxro.xla import settings  # noqa: E402

# what JAX keeps of the programs would be looked through at every collection: a
# sixteenth of the time
gc.disable()
settings.COMPILE_FAST.update(settings.COMPILE_FASTEST)
jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_numpy_dtype_promotion", "strict")


@pytest.fixture(scope="module", autouse=True)
def memory():
    """Gives back the programs of a file at its end: of all files together they take
    more than 20 GB."""
    yield
    jax.clear_caches()
    gc.collect()


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
