"""What stands in an HDF5 file, asked for its size and place before it is read, with one
error for whatever the library meets in a damaged file."""

from collections.abc import Iterator
from contextlib import contextmanager
from math import prod
from pathlib import Path
from typing import Any

import numpy as np

from ..tables.fields import TableError

ALWAYS = 8 << 20
"""Bytes that a file may hold, however small it is."""

INFLATED = 20
"""How many bytes one byte of the file may hold, compressed: coordinates reach six."""

LINKS = 8
"""Links within the file that may lead from one to the other."""


class Entries:
    """The entries of an HDF5 file; a context that opens and closes it. Every method
    raises TableError where the file is damaged or reaches out of itself."""

    def __init__(self, path: str | Path):
        self.path = path
        self._file: Any = None
        self._left = 0

    def __enter__(self) -> "Entries":
        h5py = _h5py()
        with self._told(None):
            self._file = h5py.File(self.path, "r")
            self._left = ALWAYS + INFLATED * Path(self.path).stat().st_size
        return self

    def __exit__(self, *_: object) -> None:
        with self._told(None):
            self._file.close()

    @property
    def root(self) -> Any:
        """The group of the file."""
        return self._file

    def names(self, group: Any, place: str | None) -> list[str]:
        """What a group holds."""
        with self._told(place):
            names = list(group)
        for name in names:
            if not isinstance(name, str):
                raise self.error(place, f"the name {name!r}", "names as UTF-8 text")
        return names

    def find(self, group: Any, name: str, place: str, depth: int = 0) -> Any:
        """An entry of a group; None where there is none. Links are followed within the
        file only."""
        h5py = _h5py()
        with self._told(place):
            link = group.get(name, getlink=True) if name in group else None
            if link is None:
                return None
            if isinstance(link, h5py.HardLink):
                return group[name]
            if not isinstance(link, h5py.SoftLink):
                found = "a link out of this file"
                raise self.error(place, found, "everything in one file")
            if depth == LINKS:
                raise self.error(place, "links that lead to each other", "an entry")
            found = self._file if link.path.startswith("/") else group
            for part in link.path.split("/"):
                if part not in ("", "."):
                    found = self.find(found, part, place, depth + 1)
                if found is None:
                    raise self.error(
                        place,
                        f"a link to {link.path!r}, which is not there",
                        "an entry",
                    )
            return found

    def attribute(self, group: Any, name: str, place: str) -> Any:
        """The value of an attribute; None where there is none."""
        with self._told(place):
            if name not in group.attrs:
                return None
            self._ask(group.attrs.get_id(name), place)
            return group.attrs[name]

    def numbers(self, entry: Any, place: str) -> np.ndarray:
        """The real numbers of a dataset."""
        values = self.values(entry, place)
        if values.dtype.kind not in "fiu":
            raise self.error(place, f"values of type {values.dtype}", "numbers")
        return np.asarray(values, float)

    def values(self, entry: Any, place: str) -> np.ndarray:
        """The values of a dataset."""
        if getattr(entry, "shape", None) is None:
            raise self.error(place, "no values", "numbers or a name")
        with self._told(place):
            if entry.external or entry.is_virtual:
                raise self.error(
                    place, "values that lie in another file", "everything in one file"
                )
            self._ask(entry, place)
            return np.asarray(entry[()])

    def _ask(self, entry: Any, place: str) -> None:
        """Counts the bytes of an entry. Raises TableError where the file is too small
        for so many."""
        chunk = getattr(entry, "chunks", None) or ()
        size = entry.dtype.itemsize * max(prod(entry.shape), prod(chunk))
        if size > self._left:
            shape = f"shape {entry.shape}" + f" in parts of {chunk}" * bool(chunk)
            expected = "values that the bytes of the file can hold"
            raise self.error(place, f"{shape} of type {entry.dtype}", expected)
        self._left -= size

    def error(self, place: str | None, found: str, expected: str) -> TableError:
        """The error at a place of the file."""
        return TableError(self.path, column=place, found=found, expected=expected)

    @contextmanager
    def _told(self, place: str | None) -> Iterator[None]:
        """Around the calls of the library, which raise whatever a damaged file makes
        them."""
        try:
            yield
        except TableError:
            raise
        except Exception as error:
            first = (str(error).splitlines() or [type(error).__name__])[0]
            what = "no HDF5 file that can be read" if place is None else "damaged bytes"
            expected = "a file with a group for each pair"
            raise self.error(place, f"{what} ({first})", expected) from None


def _h5py() -> Any:
    """The module. Raises SystemExit with the way to install it."""
    try:
        import h5py
    except ModuleNotFoundError:
        raise SystemExit("HDF5 files need h5py: pip install 'jaxro[h5]'") from None
    return h5py
