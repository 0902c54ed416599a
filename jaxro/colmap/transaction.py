"""Geometries are written all or none: in one transaction on the database itself, or to
a draft of a copy that takes its name when it is finished. A run that is killed leaves
the database as it was."""

import os
import sqlite3
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from pathlib import Path
from urllib.parse import quote

from ..tables.fields import TableError
from ..tables.whole import Inputs, check_file, claim
from .database import Database

WAIT = 1.0
"""Seconds to wait for a database that something else writes to."""


@contextmanager
def open_database(file: Path, out: Path | None, force: bool) -> Iterator[Database]:
    """The database, or a copy of it at `out`, in a transaction that takes effect when
    the block ends without an error; after one nothing is changed. Raises TableError."""
    if not file.is_file():
        expected = "a COLMAP database; check the path"
        raise TableError(file, found="no such file", expected=expected)
    if out is not None and out.absolute() == file.absolute():
        out = None
    if out is None:
        with (
            _explain_errors(file),
            closing(_connect(file)) as connection,
            _transaction(connection, file, force) as database,
        ):
            yield database
        return
    with claim(out, check_file, force), _copy(file, out) as database:
        yield database


@contextmanager
def _copy(file: Path, out: Path) -> Iterator[Database]:
    """A copy of the database, which takes its name when the block ends without an
    error. Raises TableError."""
    draft = out.absolute().with_name(f".{out.name}.{os.getpid()}.partial")
    inputs = Inputs(file)
    try:
        with _explain_errors(file, out), closing(_connect(draft)) as connection:
            # a draft that is not finished is thrown away: it needs no journal, and
            # the disk waits until it is
            connection.execute("PRAGMA journal_mode = MEMORY")
            connection.execute("PRAGMA synchronous = OFF")
            with _explain_errors(file), closing(_connect_to_read(file)) as source:
                # waits for a lock for a while, a backup would wait for ever
                source.execute("SELECT count(*) FROM sqlite_master")
                source.backup(connection)
            inputs.check()
            # whatever geometries there are, the original keeps them
            with _transaction(connection, file, force=True) as database:
                yield database
        with _explain_errors(out):
            with draft.open("r+b") as finished:
                os.fsync(finished.fileno())
            os.replace(draft, out)
    finally:
        for end in ("", "-wal", "-shm", "-journal"):
            with suppress(OSError):
                draft.with_name(draft.name + end).unlink(missing_ok=True)


def _connect(path: Path) -> sqlite3.Connection:
    connection = sqlite3.connect(path, timeout=WAIT, isolation_level=None)
    connection.text_factory = _text
    return connection


def _connect_to_read(path: Path) -> sqlite3.Connection:
    """A connection by which nothing is written, no file beside the database either."""
    with path.open("rb") as file:
        has_log = file.read(20)[18:] == b"\2\2"
    # to read a database with a log SQLite makes two files beside it, unless another
    # process has made them, or nothing is said to change meanwhile
    alone = has_log and not path.with_name(f"{path.name}-wal").exists()
    unchanging = "&immutable=1" if alone else ""
    where = f"file:{quote(str(path.absolute()))}?mode=ro{unchanging}"
    return sqlite3.connect(where, timeout=WAIT, isolation_level=None, uri=True)


def _text(name: bytes) -> str:
    """A name, in whatever encoding it was written."""
    return name.decode(errors="replace")


@contextmanager
def _transaction(
    connection: sqlite3.Connection, file: Path, force: bool
) -> Iterator[Database]:
    """One transaction on a database, which errors call `file`."""
    connection.execute("BEGIN IMMEDIATE")
    try:
        database = Database(file, connection)
        _check_empty(database, force)
        yield database
        connection.execute("COMMIT")
    finally:
        if connection.in_transaction:
            connection.execute("ROLLBACK")


@contextmanager
def _explain_errors(file: Path, written: Path | None = None) -> Iterator[None]:
    """Raise TableError, which says what to do, for the errors of SQLite and of the disk;
    `written`: the copy, if there is one."""
    try:
        yield
    except sqlite3.OperationalError as error:
        expected = (
            "a database that nothing else writes to, in a folder that can be written; "
            "or --out for a copy"
        )
        raise TableError(written or file, found=str(error), expected=expected) from None
    except sqlite3.DatabaseError as error:
        expected = "a sound SQLite database made by COLMAP"
        raise TableError(file, found=str(error), expected=expected) from None
    except OSError as error:
        found = error.strerror or str(error)
        expected = "a file that can be written"
        raise TableError(written or file, found=found, expected=expected) from None


def _check_empty(database: Database, force: bool) -> None:
    """Raises TableError if geometries would be replaced without `force`."""
    count = database.geometries()
    if count and not force:
        found = f"{count} two-view geometries"
        expected = "none, or --force to replace them"
        raise database.error("two_view_geometries", None, None, found, expected)
