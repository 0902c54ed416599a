"""Whole files or none: where a result may be written, by one process at a time, and
writing it there; and whether what was read is still what it was."""

import os
import re
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from .fields import TableError


def is_parquet(file: Path) -> bool:
    """Whether the name of a file says that it is a Parquet table."""
    return file.suffix.lower() in (".parquet", ".pq")


class Inputs:
    """Files that are read, as they were when the reading began."""

    def __init__(self, *files: Path | None):
        self._before = {file: _state(file) for file in files if file is not None}

    def check(self) -> None:
        """Raises TableError where one of them is not what it was."""
        for file, before in self._before.items():
            if _state(file) != before:
                raise TableError(
                    file,
                    found="another content than at the beginning",
                    expected="a file that nothing else writes to meanwhile; begin anew",
                )


def _state(file: Path) -> tuple[int, ...]:
    """What changes with the content of a file; nothing of a file that is not there."""
    try:
        now = file.stat()
    except OSError:
        return ()
    return now.st_dev, now.st_ino, now.st_size, now.st_mtime_ns


@contextmanager
def claim(
    target: Path | None, check: Callable[[Path, bool], None], force: bool
) -> Iterator[None]:
    """Within the block no other process writes to `target`, a folder or a file, nothing
    where it is None.

    `check`: one of the functions below, which says whether a result may be written
    there. Raises TableError where it may not, or where another process writes to it.
    What a process that was killed had not finished is removed.
    """
    if target is None:
        yield
        return
    check(target, force)
    path = target.resolve()
    made = _make_parents(path, target)
    try:
        lock = _lock(path, target)
        try:
            check(target, force)  # what another process may have finished meanwhile
            _remove_drafts(path)
            yield
        finally:
            # as long as it is held: who waits for it then sees that it is gone
            with suppress(OSError):
                os.unlink(lock.lock_file)
            lock.release()
    finally:
        for folder in made:
            with suppress(OSError):
                folder.rmdir()  # where nothing was written


def _lock(path: Path, target: Path) -> Any:
    """A lock beside `path` that this process holds. Raises TableError, which names
    `target`, where another one does."""
    from filelock import FileLock, Timeout

    lock = FileLock(path.with_name(f".{path.name}.lock"), timeout=0)
    with telling(target, "a place that can be written"):
        try:
            lock.acquire()
        except Timeout:
            raise TableError(
                target,
                found="another process that writes there",
                expected="another --out, or to wait until it has finished",
            ) from None
    return lock


def _make_parents(path: Path, target: Path) -> list[Path]:
    """Make the folders above a path; those that were not there, the innermost first.
    Raises TableError, which names `target`."""
    missing = [folder for folder in path.parents if not folder.exists()]
    with telling(target, "a place that can be written"):
        path.parent.mkdir(parents=True, exist_ok=True)
    return missing


def _remove_drafts(path: Path) -> None:
    """Remove what was begun by processes that do not live any more."""
    draft = re.compile(rf"\.{re.escape(path.name)}\.\d+\.partial(-\w+)?")
    for entry in list(path.parent.iterdir()):
        if draft.fullmatch(entry.name):
            shutil.rmtree(entry) if entry.is_dir() else entry.unlink(missing_ok=True)


def check_target(directory: Path, force: bool) -> None:
    """Raises TableError unless a result may be written there."""
    check_name(directory, "a name for the folder of results")
    if directory.exists() and not directory.is_dir():
        raise TableError(
            directory, found="a file", expected="the name of a folder for the results"
        )
    if not force and directory.exists() and any(directory.iterdir()):
        raise TableError(
            directory,
            found="a folder that is not empty",
            expected="a new folder, or --force to overwrite",
        )


def check_file(path: Path, force: bool) -> None:
    """Raises TableError unless a single result may be written there."""
    check_name(path, "a name for the file of the result")
    if path.is_dir():
        raise TableError(
            path, found="a folder", expected="the name of a file for the result"
        )
    if not force and path.exists():
        raise TableError(
            path,
            found="a file that exists",
            expected="a new name, or --force to overwrite",
        )


def check_name(path: Path, expected: str) -> None:
    """Raises TableError where the disk knows no such name, or none for a draft beside
    it."""
    whole = path.resolve()
    if not whole.name:
        raise TableError(path, found="the root of all folders", expected=expected)
    with telling(path, expected), suppress(FileNotFoundError):
        whole.with_name(f".{whole.name}.{os.getpid()}.unfinished.old").lstat()


@contextmanager
def telling(path: Path, expected: str) -> Iterator[None]:
    """What the disk refuses is told as a TableError."""
    try:
        yield
    except OSError as error:
        found = error.strerror or str(error)
        raise TableError(path, found=found, expected=expected) from None


@contextmanager
def draft_of(path: Path, draft: Path | None = None) -> Iterator[Path]:
    """A file to write, beside `path` if not given, which takes the place of `path` when
    all of it is on the disk. Of an error nothing is left."""
    draft = draft or path.with_suffix(".partial")
    draft.unlink(missing_ok=True)
    try:
        yield draft
        with draft.open("r+b") as written:
            os.fsync(written.fileno())
        os.replace(draft, path)
    finally:
        with suppress(OSError):
            draft.unlink(missing_ok=True)


def write(
    directory: Path, texts: Mapping[str, str | bytes], read: Sequence[Path | None] = ()
) -> None:
    """All files by name, first complete in a folder beside `directory`, then renamed
    into place.

    Raises TableError, with nothing written, where the disk refuses, or one would take
    the place of a file that was `read`.
    """
    targets = [(directory / name).resolve() for name in texts]
    for file in read:
        if file is not None and file.resolve() in targets:
            raise TableError(
                file,
                found="a table to be read where a result is to be written",
                expected="another --out",
            )
    draft = _hidden(directory)
    try:
        with telling(directory, "a folder that can be written"):
            draft.mkdir(parents=True)
            for name, text in texts.items():
                content = text if isinstance(text, bytes) else text.encode()
                (draft / name).write_bytes(content)
            if directory.exists():
                for name in texts:
                    os.replace(draft / name, directory / name)
            else:
                os.replace(draft, directory)
    finally:
        shutil.rmtree(draft, ignore_errors=True)


def write_file(path: Path, content: str | bytes) -> None:
    """The whole file or none. Raises TableError."""
    with telling(path, "a file that can be written"):
        path.absolute().parent.mkdir(parents=True, exist_ok=True)
        with draft_of(path, _hidden(path)) as draft:
            draft.write_bytes(
                content if isinstance(content, bytes) else content.encode()
            )


def _hidden(path: Path) -> Path:
    """Where the draft of a file or a folder of the user is written."""
    whole = path.absolute()
    return whole.with_name(f".{whole.name}.{os.getpid()}.partial")
