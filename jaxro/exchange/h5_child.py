"""What pairs an HDF5 file holds, read by a process of its own: damaged bytes can stop the
library for ever, fill the memory, or end the process that reads them, and no exception
tells it. `h5` runs this file; it imports nothing of jaxro, to begin soon.

On standard output it writes an .npz: the names of the groups, and the values of every
entry by its place, NUMBER/x1 or NUMBER/camera1/params. What is refused it tells on
standard error as JSON: place, found, expected; with the exit code REFUSED.
"""

import io
import json
import math
import os
import sys
from collections.abc import Callable
from contextlib import suppress
from typing import Any

PAIR = "x1", "x2", "camera1", "camera2"
SCORES = "scores", "matching_scores0"
CAMERA = "model", "width", "height", "params"
"""The entries that are read, of a pair, of its matches where there are any, and of its
cameras."""

REFUSED = 3
"""Exit code of what is refused."""

ALWAYS = 8 << 20
"""Bytes that a file may hold, however small it is."""

INFLATED = 20
"""How many bytes one byte of the file may hold, compressed: coordinates reach six."""

LIBRARY = 256 << 20
"""Bytes that the library may need beside the values."""

SECONDS, SPEED = 4, 10_000_000
"""Seconds of a processor that reading may take, and bytes in each more of them."""

LINKS = 8
"""Links within the file that may lead from one to the other."""

ELSEWHERE = "everything in one file"


class Refused(Exception):
    """What cannot be read: where, what was found, and what was expected."""


class Reader:
    """The entries of a file; each is asked for its size and place before it is read."""

    def __init__(self, path: str):
        import h5py

        self.h5py, self.place = h5py, ""
        self.left = ALWAYS + INFLATED * os.path.getsize(path)
        _set_limits(self.left, SECONDS + os.path.getsize(path) // SPEED)
        self.file = h5py.File(path, "r")
        self.holds: dict[str, list[str]] = {}
        self.values: dict[str, Any] = {}

    def read(self) -> None:
        """Reads what is wanted of all groups."""
        for number, name in enumerate(self._names(self.file, "")):
            self.place = name
            entry = self._find(self.file, name)
            self._keep(
                str(number),
                entry,
                lambda key: (*PAIR, *SCORES) if "/" not in key else CAMERA,
            )

    def _keep(self, key: str, entry: Any, wanted: Callable[[str], Any]) -> None:
        """Keeps the values of an entry, or what is wanted of a group."""
        if not hasattr(entry, "keys"):
            self.values[key] = self._values(entry)
            return
        place, names = self.place, self._names(entry, key)
        for name in wanted(key):
            self.place = f"{place}/{name}"
            if name in names:
                below = self._find(entry, name)
                is_deep = key.count("/") > 0 and hasattr(below, "keys")
                self._keep(
                    f"{key}/{name}", below, (lambda _: ()) if is_deep else wanted
                )
            elif "/" in key and name in entry.attrs:
                self._ask(entry.attrs.get_id(name))
                self.values[f"{key}/{name}"] = self._plain(entry.attrs[name])
        self.place = place

    def _names(self, group: Any, key: str) -> list[str]:
        """What a group holds."""
        names = list(group)
        for name in names:
            if not isinstance(name, str):
                raise Refused(self.place, f"the name {name!r}", "names as UTF-8 text")
        self.holds[key] = names
        return names

    def _find(self, group: Any, name: str, depth: int = 0) -> Any:
        """An entry of a group. Links are followed within the file only."""
        link = group.get(name, getlink=True) if name in group else None
        if isinstance(link, self.h5py.HardLink):
            return group[name]
        if link is None:
            raise Refused(
                self.place, f"a link to {name!r}, which is not there", "an entry"
            )
        if not isinstance(link, self.h5py.SoftLink):
            raise Refused(self.place, "a link out of this file", ELSEWHERE)
        if depth == LINKS:
            raise Refused(self.place, "links that lead to each other", "an entry")
        found = self.file if link.path.startswith("/") else group
        for part in link.path.split("/"):
            if part not in ("", "."):
                found = self._find(found, part, depth + 1)
        return found

    def _values(self, entry: Any) -> Any:
        """The values of a dataset."""
        if getattr(entry, "shape", None) is None:
            raise Refused(self.place, "no values", "numbers or a name")
        if entry.external or entry.is_virtual:
            raise Refused(self.place, "values that lie in another file", ELSEWHERE)
        self._ask(entry)
        return self._plain(entry[()])

    def _ask(self, entry: Any) -> None:
        """Counts the bytes of an entry, which the file has to be large enough for."""
        shape, parts = entry.shape or (), getattr(entry, "chunks", None) or ()
        size = entry.dtype.itemsize * max(math.prod(shape), math.prod(parts))
        if size > self.left:
            found = f"shape {shape}" + f" in parts of {parts}" * bool(parts)
            expected = "values that the bytes of the file can hold"
            raise Refused(self.place, f"{found} of type {entry.dtype}", expected)
        self.left -= size

    def _plain(self, value: Any) -> Any:
        """Numbers, or text: what an .npz holds."""
        import numpy as np

        values = np.asarray(value)
        if values.dtype.kind in "OSU":
            texts = np.ravel(values).tolist()
            if not all(isinstance(text, str | bytes) for text in texts):
                raise Refused(
                    self.place, f"values of type {values.dtype}", "numbers or text"
                )
            decode = lambda t: t if isinstance(t, str) else t.decode(errors="replace")
            return np.array([decode(text) for text in texts], "U")
        if values.dtype.kind not in "biufc":
            raise Refused(
                self.place, f"values of type {values.dtype}", "numbers or text"
            )
        return values


def _set_limits(values: int, seconds: int) -> None:
    """No more time, and no more memory than the values and the library need, where
    systems have limits. A busy computer takes none of the time of a processor."""
    with suppress(ImportError, OSError, ValueError):
        import resource

        resource.setrlimit(resource.RLIMIT_CPU, (seconds, seconds + 1))
        with open("/proc/self/statm", encoding="ascii") as told:
            there = int(told.read().split()[0]) * resource.getpagesize()
        most = there + 2 * values + LIBRARY
        resource.setrlimit(resource.RLIMIT_AS, (most, most))


def main(path: str) -> int:
    """Reads the file and writes what it holds; the exit code."""
    import numpy as np

    place = None
    try:
        reader = Reader(path)
        try:
            reader.read()
        except BaseException:
            place = reader.place or None
            raise
    except Refused as refused:
        told = refused.args
    except Exception as error:
        first = (str(error).splitlines() or [type(error).__name__])[0]
        what = "no HDF5 file that can be read" if place is None else "damaged bytes"
        told = place, f"{what} ({first})", "a file with a group for each pair"
    else:
        written = io.BytesIO()
        np.savez(written, holds=np.array(json.dumps(reader.holds)), **reader.values)
        sys.stdout.buffer.write(written.getvalue())
        return 0
    sys.stderr.write(json.dumps(told))
    return REFUSED


if __name__ == "__main__":
    sys.exit(main(sys.argv[1]))
