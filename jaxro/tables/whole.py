"""Whole files or none: where a result may be written, by one process at a time, and
writing it there; and whether what was read is still what it was.

Everything is written as a draft beside its place first, under a name of its own
(`draft_name`, `hidden`). A complete folder takes the place of an earlier one in two
steps, because no system does it in one:

    DIR -> .DIR.123.partial/.replaced       the earlier one into the draft
    .DIR.123.partial -> DIR                 the draft takes its name

A process that is killed at any moment leaves the earlier folder or the new one, and
`settle` ends what was begun: a draft that holds an earlier folder is complete.
"""

import os
import re
import shutil
from collections.abc import Callable, Container, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

from .fields import TableError

REPLACED = ".replaced"
"""The folder whose place a folder takes, inside of that one until it is removed."""

ENDINGS = (".csv", ".json", ".parquet", ".png", ".toml")
"""Of the files of results: no other file in their folder has such a name."""

Check = Callable[[Path, bool], None]
"""Raises TableError unless a result may be written to a path, by force or not."""


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
def claim(target: Path | None, check: Check, force: bool) -> Iterator[None]:
    """Within the block no other process writes to `target`, a folder or a file, nothing
    where it is None.

    `check`: one of the functions below, which says whether a result may be written
    there. Raises TableError where it may not, or where another process writes to it.
    What a process that was killed had not finished is settled.
    """
    if target is None:
        yield
        return
    check_name(target, "a name for the result")
    path = target.resolve()
    made = _make_parents(path, target)
    try:
        lock = _lock(path, target)
        try:
            settle(path)
            check(target, force)
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


@contextmanager
def claim_all(
    targets: Sequence[tuple[Path | None, Check]],
    force: bool,
    read: Sequence[Path | None] = (),
) -> Iterator[None]:
    """`claim` of all places that a call writes to, each with its check; what lies in a
    folder among them is claimed with it. Raises TableError where one of them is a file
    that is `read`, or another one's."""
    there = [(path, check) for path, check in targets if path is not None]
    there.sort(key=lambda target: len(target[0].resolve().parts))
    inputs = {file.resolve(): file for file in read if file is not None}
    claimed: list[Path] = []
    with ExitStack() as stack:
        for target, check in there:
            path = target.resolve()
            if path in inputs:
                raise TableError(
                    inputs[path],
                    found="a table to be read where a result is to be written",
                    expected="another name for the result",
                )
            if any(own == path or own in path.parents for own in claimed):
                if check is check_file:
                    _check_apart(target, path, claimed)
                settle(path)
                check(target, force)
            else:
                stack.enter_context(claim(target, check, force))
                claimed.append(path)
        yield


def _check_apart(target: Path, path: Path, claimed: list[Path]) -> None:
    """Raises TableError for a file that another result has the name of, or may have."""
    if path in claimed or (path.parent in claimed and path.suffix.lower() in ENDINGS):
        raise TableError(
            target,
            found="a name that another result of this call may have",
            expected="another name",
        )


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


def settle(path: Path) -> None:
    """End what was begun at `path` by processes that do not live any more: what was
    complete takes its place, drafts are removed."""
    draft = re.compile(rf"\.{re.escape(path.name)}\.\d+\.partial(-\w+)?")
    entries = list(path.parent.iterdir()) if path.parent.is_dir() else []
    for entry in entries:
        if not draft.fullmatch(entry.name):
            continue
        if not entry.is_dir():
            entry.unlink(missing_ok=True)
        elif not (entry / REPLACED).exists():
            shutil.rmtree(entry)
        elif not path.exists():
            os.replace(entry, path)
    _remove(path / REPLACED)


def swap(draft: Path, path: Path) -> None:
    """A complete folder takes the name `path`, and the place of the folder there."""
    there = path.exists()
    if there:
        _remove(draft / REPLACED)
        shutil.copymode(path, draft)
        os.replace(path, draft / REPLACED)
    try:
        os.replace(draft, path)
    except OSError:
        if there:
            os.replace(draft / REPLACED, path)
        raise
    _remove(path / REPLACED)


def _remove(folder: Path) -> None:
    """Remove a folder, if it is there."""
    if folder.is_dir():
        shutil.rmtree(folder)


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
        hidden(whole.with_name(f"{whole.name}.unfinished")).lstat()


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
    draft = draft or path.with_name(draft_name(path.name))
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
    into place: the whole folder where `directory` holds nothing but files of these
    names, else one file after the other.

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
    place = directory.resolve()
    draft = hidden(place)
    try:
        with telling(directory, "a folder that can be written"):
            draft.mkdir(parents=True)
            for name, text in texts.items():
                _write_through(draft / name, text)
            if _may_go(place, texts):
                swap(draft, place)
            else:
                for name in texts:
                    os.replace(draft / name, place / name)
    finally:
        if not (draft / REPLACED).exists():
            shutil.rmtree(draft, ignore_errors=True)


def _may_go(folder: Path, names: Container[str]) -> bool:
    """Whether another folder with files of these names may take the place of this one:
    nobody works in it, and nothing else is in it."""
    if not folder.exists():
        return True
    busy = os.path.ismount(folder) or folder in (Path.cwd(), *Path.cwd().parents)
    return not busy and all(entry.name in names for entry in folder.iterdir())


def _write_through(path: Path, content: str | bytes) -> None:
    """A file, all of which is on the disk."""
    with path.open("wb") as file:
        file.write(content if isinstance(content, bytes) else content.encode())
        file.flush()
        os.fsync(file.fileno())


def write_file(path: Path, content: str | bytes) -> None:
    """The whole file or none. Raises TableError."""
    with telling(path, "a file that can be written"):
        path.absolute().parent.mkdir(parents=True, exist_ok=True)
        with draft_of(path, hidden(path)) as draft:
            _write_through(draft, content)


def draft_name(name: str) -> str:
    """The name of the draft of a file, in the folder of a run."""
    return Path(name).with_suffix(".partial").name


def hidden(path: Path) -> Path:
    """Where the draft of a file or a folder of the user is written."""
    whole = path.absolute()
    return whole.with_name(f".{whole.name}.{os.getpid()}.partial")
