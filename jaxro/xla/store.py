"""Compiled programs on disk, so that the next process compiles nothing.

Off unless a caller names a folder (`use`): the command line does, a library call writes
nothing. A program is found again by everything it depends on: the source of this
package, the versions of those it stands on, the processor, the compiler settings, the
static options and the shapes. The files hold machine code, which may do anything when
it runs, as the pickles around it may when they are read: a folder that others may write
to, or that belongs to somebody else, is not used, links are not followed, and a file
counts only if it is the user's own and whole.
"""

import hashlib
import io
import os
import pickle
import platform
import tempfile
from collections.abc import Callable
from contextlib import suppress
from functools import lru_cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jax
from jaxtyping import PyTree

MAX_PROGRAMS = 40
"""Programs kept, of about 1 MB each; the oldest go."""

DIGEST = hashlib.sha256().digest_size

_folder: Path | None = None


def use(folder: Path | None) -> None:
    """Keep compiled programs in this folder from now on (None: nowhere), unless
    somebody else could write to it."""
    global _folder
    _folder = folder if folder is not None and _is_ours(folder) else None


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
    return _folder is not None


def load_or_compile(
    function: Callable, settings: dict[str, Any] | None, data: PyTree, key: PyTree
) -> Callable:
    """jit(function) for data of these shapes, from the folder if it is there, else
    compiled and stored.

    `key`: what else `function` depends on, of values that can be pickled.
    """
    leaves, structure = jax.tree.flatten(data)
    shapes = [(a.shape, str(a.dtype)) for a in map(jax.typeof, leaves)]
    try:
        content = _pickle_in_full(
            (_list_surroundings(), settings, shapes, str(structure), key)
        )
    except (
        pickle.PicklingError,
        AttributeError,
        TypeError,
    ):  # a lambda among the options has no name to be found by
        program = jax.jit(function, compiler_options=settings)
        return program
    path = (_folder or Path()) / f"{hashlib.sha256(content).hexdigest()}.program"
    stored = _read(path)
    if stored is None:
        shapes_out: list[Any] = []

        def flat(*leaves):
            out, shape = jax.tree.flatten(
                function(*jax.tree.unflatten(structure, leaves))
            )
            shapes_out.append(shape)
            return out

        from jax.experimental import serialize_executable

        program = jax.jit(flat, compiler_options=settings).lower(*leaves).compile()
        # the structure itself cannot be pickled, but an object of that structure can
        like = jax.tree.unflatten(shapes_out[0], [0] * shapes_out[0].num_leaves)
        with suppress(
            Exception
            # a program that calls back into Python, such as a stock solver's, cannot be
            # kept
        ):
            _write(path, pickle.dumps((*serialize_executable.serialize(program), like)))
    else:
        program, like = stored
    out_structure = jax.tree.structure(like)
    return lambda *data: jax.tree.unflatten(
        out_structure, program(*jax.tree.leaves(data))
    )


def _pickle_in_full(value: Any) -> bytes:
    """The pickle of a value without references to objects that occur in it before, so
    that equal values have equal ones whichever objects they are made of."""
    file = io.BytesIO()
    pickler = pickle.Pickler(file)
    pickler.fast = True
    pickler.dump(value)
    return file.getvalue()


def _read(path: Path) -> tuple[Callable, PyTree] | None:
    content = _read_own(path)
    if content is None:
        return None
    try:
        *executable, like = pickle.loads(content)
        from jax.experimental import serialize_executable

        return serialize_executable.deserialize_and_load(*executable), like
    except (
        Exception
    ):  # whatever is wrong with the file: compiling again writes a good one
        return None


def _read_own(path: Path) -> bytes | None:
    """What `_write` wrote; None for a link, for a file that another user owns or may
    write to, and for one that is not as it was written."""
    try:
        handle = os.open(path, os.O_RDONLY | getattr(os, "O_NOFOLLOW", 0))
        with os.fdopen(handle, "rb") as file:
            there = os.fstat(handle)
            if hasattr(os, "getuid") and (
                there.st_uid != os.getuid() or there.st_mode & 0o022
            ):
                return None
            digest, content = file.read(DIGEST), file.read()
    except OSError:
        return None
    return content if hashlib.sha256(content).digest() == digest else None


def _write(path: Path, content: bytes) -> None:
    """The whole file or none; a folder that cannot be written to costs only time."""
    try:
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        if not _is_ours(path.parent):
            return
        handle, temporary = tempfile.mkstemp(dir=path.parent)
        try:
            with os.fdopen(handle, "wb") as file:
                file.write(hashlib.sha256(content).digest() + content)
            os.replace(temporary, path)
        except OSError:
            os.unlink(temporary)  # no drafts are left
            raise
        newest_first = sorted(
            path.parent.glob("*.program"),
            key=lambda file: file.stat().st_mtime,
            reverse=True,
        )
        for old in newest_first[MAX_PROGRAMS:]:
            old.unlink(missing_ok=True)
    except OSError:
        return


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
    packages = ("jax", "jaxlib", "equinox", "optimistix", "lineax")
    versions = (*map(version, packages), platform.python_version())
    flags = (
        os.environ.get("XLA_FLAGS"),
        jax.dtypes.canonicalize_dtype(float).name,
        os.cpu_count(),
    )
    return source.hexdigest(), platform.machine(), processor, versions, flags
