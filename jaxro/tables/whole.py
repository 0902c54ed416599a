"""Whole files or none: where a result may be written, and writing it there."""

import os
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

from .fields import TableError


def is_parquet(file: Path) -> bool:
    """Whether the name of a file says that it is a Parquet table."""
    return file.suffix.lower() in (".parquet", ".pq")


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
    it is complete. Of an error nothing is left."""
    draft = draft or path.with_suffix(".partial")
    draft.unlink(missing_ok=True)
    try:
        yield draft
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


def write_file(path: Path, text: str) -> None:
    """The whole file or none. Raises TableError."""
    with telling(path, "a file that can be written"):
        path.absolute().parent.mkdir(parents=True, exist_ok=True)
        with draft_of(path, _hidden(path)) as draft:
            draft.write_text(text, encoding="utf-8", newline="")


def _hidden(path: Path) -> Path:
    """Where the draft of a file or a folder of the user is written."""
    whole = path.absolute()
    return whole.with_name(f".{whole.name}.{os.getpid()}.partial")
