"""Compiled programs on disk, so that the next process compiles nothing.

A program is found again by everything it depends on: the source of this package, the
versions of those it stands on, the processor, the compiler settings, the structure of
its arguments and their shapes. What a caller wrote himself, a loss or a condition, is
known by the program that it is lowered to.

The files hold machine code, which may do anything when it runs, as the pickles around
it may when they are read: a folder that others may write to, or that belongs to
somebody else, is not used, links and pipes are not opened, and a file counts only if it
is the user's own, whole, and the one that was written for this program.
"""

import hashlib
import io
import marshal
import os
import pickle
import platform
import stat
import tempfile
import threading
import types
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import lru_cache, wraps
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jax
from jaxtyping import PyTree

from .closures import KNOWN, Module, package_of

MAX_BYTES = 1 << 29
"""Of all programs that are kept, of about 1 MB each; those not used for longest go."""

DIGEST = hashlib.sha256().digest_size


class _Place:
    """Where programs are kept: the default folder until a caller names one."""

    folder: Path | None = None
    chosen = False


def keep_programs(folder: str | Path | None = None) -> None:
    """Keep compiled programs in this folder from now on; None: the default folder.

    That is the folder that the environment variable JAXRO_CACHE names, or else
    ~/.cache/jaxro. Programs are kept there without this call, too, so that only the
    first process on a machine waits for the compiler. JAXRO_CACHE="" keeps none. A
    folder that other users may write to is not used.
    """
    use(default_folder() if folder is None else Path(folder))


def use(folder: Path | None) -> None:
    """Keep compiled programs in this folder from now on (None: nowhere), unless
    somebody else could write to it."""
    _Place.folder = folder if folder is not None and _is_ours(folder) else None
    _Place.chosen = True


def _folder() -> Path | None:
    if not _Place.chosen:
        use(default_folder())
    return _Place.folder


def _is_ours(folder: Path) -> bool:
    try:
        there = folder.stat()
    except FileNotFoundError:
        return True  # it will be made
    except OSError:
        return False
    return not hasattr(os, "getuid") or (
        there.st_uid == os.getuid() and not there.st_mode & 0o022
    )


def default_folder() -> Path | None:
    """The user's cache folder for this program; none where the environment variable
    JAXRO_CACHE is empty."""
    if "JAXRO_CACHE" in os.environ:
        return Path(os.environ["JAXRO_CACHE"]) if os.environ["JAXRO_CACHE"] else None
    root = os.environ.get("XDG_CACHE_HOME") or os.environ.get("LOCALAPPDATA")
    if not root:
        try:
            root = Path.home() / ".cache"
        except RuntimeError:  # a user without a home
            return None
    return Path(root) / "jaxro"


def active() -> bool:
    """Whether programs are kept."""
    return _folder() is not None


def load_or_compile(
    function: Callable,
    settings: dict[str, Any] | None,
    numbers: Sequence[Any],
    key: PyTree,
) -> Callable:
    """jit(function) for numbers of these shapes, from the folder if it is there, else
    compiled and stored.

    `key`: what else `function` depends on.
    """
    folder = _folder()
    assert folder is not None
    shapes = [(a.shape, str(a.dtype), a.weak_type) for a in map(jax.typeof, numbers)]
    source, structure = _with_flat_results(function)
    lower = lambda: jax.jit(source, compiler_options=settings).lower(*numbers)
    lowered = None
    try:
        content = _pickle_in_full((_list_surroundings(), settings, shapes, key))
    except _NAMELESS:  # a caller's own: the whole program says what it is
        lowered = lower()
        text = lowered.as_text(), str(structure())
        content = _pickle_in_full((_list_surroundings(), settings, text))
    digest = hashlib.sha256(content).digest()
    path = folder / f"{digest.hex()}.program"

    def make() -> Callable:
        program = _compile(lowered or lower(), structure, path, digest)
        return _with_structure(program, structure())

    stored = _read(path, digest)
    if stored is None:
        return make()
    program, like = stored
    return _checked(_with_structure(program, jax.tree.structure(like)), make)


_NAMELESS = (pickle.PicklingError, AttributeError, TypeError, ValueError)


def _with_flat_results(function: Callable) -> tuple[Callable, Callable]:
    """The function with a list of results, and what gives their structure after it was
    lowered: the structure of a program itself cannot be pickled."""
    structures: list[Any] = []

    @wraps(function)
    def flat(*numbers):
        results, structure = jax.tree.flatten(function(*numbers))
        structures.append(structure)
        return results

    return flat, lambda: structures[-1]


def _with_structure(program: Callable, structure: Any) -> Callable:
    return lambda *numbers: structure.unflatten(program(*numbers))


def _compile(
    lowered: jax.stages.Lowered, structure: Callable, path: Path, digest: bytes
) -> Callable:
    """The compiled program, which is also written to the folder."""
    from jax.experimental import serialize_executable

    _hits.number = 0
    program = lowered.compile()
    # what JAX found in a cache of its own has lost the object code that is to be written
    if not _hits.number:
        like = structure().unflatten([0] * structure().num_leaves)
        # a program that calls back into Python, such as a stock solver's, and a result
        # of a class that was made in a function, cannot be kept
        with suppress(Exception):
            content = pickle.dumps((serialize_executable.serialize(program), like))
            _write(path, digest, content)
    return program


class _Hits(threading.local):
    """How many programs JAX has found in its own cache, in this thread."""

    number = 0


_hits = _Hits()


def _count_hits(event: str, **_: Any) -> None:
    if event == "/jax/compilation_cache/cache_hits":
        _hits.number += 1


jax.monitoring.register_event_listener(_count_hits)


def _checked(stored: Callable, make: Callable[[], Callable]) -> Callable:
    """A program from the folder, which counts as a miss if its first call fails."""
    program: list[Callable] = []

    def first(*numbers: Any) -> Any:
        try:
            found = jax.block_until_ready(stored(*numbers))
            program.append(stored)
        except jax.errors.JaxRuntimeError as error:
            if "RESOURCE_EXHAUSTED" in str(error):
                raise
            program.append(make())
            found = program[0](*numbers)
        return found

    return lambda *numbers: (program[0] if program else first)(*numbers)


def _is_known(thing: Callable | type) -> bool:
    """Whether the name of a function or class says all of it."""
    return package_of(thing) in KNOWN and "<" not in thing.__qualname__


class _Pickler(pickle.Pickler):
    """Functions and classes by their names, which say all where versions are known."""

    def persistent_id(self, obj: Any) -> Any:
        if isinstance(obj, types.FunctionType | type):
            if not _is_known(obj):
                raise pickle.PicklingError(f"{obj} is a caller's own")
            return obj.__module__, obj.__qualname__
        if isinstance(obj, types.ModuleType):
            if package_of(obj) not in KNOWN:
                raise pickle.PicklingError(f"{obj} is a caller's own")
            return obj.__name__
        if isinstance(obj, types.CodeType):
            return marshal.dumps(obj)
        return obj.name if isinstance(obj, Module) else None


def _pickle_in_full(value: Any) -> bytes:
    """The pickle of a value without references to objects that occur in it before, so
    that equal values have equal ones whichever objects they are made of."""
    file = io.BytesIO()
    pickler = _Pickler(file)
    pickler.fast = True
    pickler.dump(value)
    return file.getvalue()


def _read(path: Path, digest: bytes) -> tuple[Callable, PyTree] | None:
    """The program of a file, and a tree of the structure of its results."""
    content = _read_own(path, digest)
    if content is None:
        return None
    from jax.experimental import serialize_executable

    try:
        executable, like = pickle.loads(content)
        program = serialize_executable.deserialize_and_load(*executable)
    except Exception:
        return None  # whatever is wrong with it: compiling again writes a good one
    with suppress(OSError):
        os.utime(path)  # used now
    return program, like


def _read_own(path: Path, digest: bytes) -> bytes | None:
    """What `_write` wrote for the program of this digest; None for a link, a pipe, a
    file that another user owns or may write to, and one that is not as it was
    written."""
    careful = getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0)
    try:
        handle = os.open(path, os.O_RDONLY | careful | getattr(os, "O_BINARY", 0))
        with os.fdopen(handle, "rb") as file:
            there = os.fstat(handle)
            if not stat.S_ISREG(there.st_mode) or (
                hasattr(os, "getuid")
                and (there.st_uid != os.getuid() or there.st_mode & 0o022)
            ):
                return None
            sealed, content = file.read(DIGEST), file.read()
    except OSError:
        return None
    return content if _seal(digest, content) == sealed else None


def _seal(digest: bytes, content: bytes) -> bytes:
    """What binds a content to the program that it was written for."""
    return hashlib.sha256(digest + content).digest()


def _write(path: Path, digest: bytes, content: bytes) -> None:
    """The whole file or none; a folder that cannot be written to costs only time."""
    try:
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        if not _is_ours(path.parent):
            return
        handle, temporary = tempfile.mkstemp(dir=path.parent)
        try:
            with os.fdopen(handle, "wb") as file:
                file.write(_seal(digest, content) + content)
            os.replace(temporary, path)
        except OSError:
            os.unlink(temporary)  # no drafts are left
            raise
        _make_room(path.parent)
    except OSError:
        return


def _make_room(folder: Path) -> None:
    """Remove what was not used for longest, until MAX_BYTES are left."""
    there = [(file, file.stat()) for file in folder.glob("*.program")]
    there.sort(key=lambda entry: entry[1].st_mtime, reverse=True)
    total = 0
    for file, status in there:
        total += status.st_size
        if total > MAX_BYTES:
            file.unlink(missing_ok=True)


@lru_cache
def _list_surroundings() -> tuple:
    """What every program depends on."""
    source = hashlib.sha256()
    for file in sorted(Path(__file__).parents[1].rglob("*.py")):
        source.update(file.read_bytes())
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        processor = next(
            line for line in lines if line.startswith(("flags", "Features"))
        )
    except (OSError, StopIteration):
        processor = platform.processor()
    packages = (
        "jax",
        "jaxlib",
        "jaxtyping",
        "equinox",
        "optimistix",
        "lineax",
        "numpy",
    )
    versions = (*map(version, packages), platform.python_version())
    flags = (
        os.environ.get("XLA_FLAGS"),
        jax.dtypes.canonicalize_dtype(float).name,
        os.cpu_count(),
    )
    return source.hexdigest(), platform.machine(), processor, versions, flags
