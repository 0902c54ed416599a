"""Memory for large results and what is filled up, used again when nobody holds it any
more.

The system clears memory before it gives it out, which takes about as long as writing a
result into it; a tenth of the time of `orient_batch` where every result is wanted.
"""

import threading
import weakref

import numpy as np

LARGE = 1 << 16
"""Bytes from which on memory is kept; smaller pieces are used again by the allocator
itself."""

PIECES = 64
"""Kept at most, so that a search through them takes microseconds."""


class Memory:
    """Memory that is kept, up to `limit` bytes in `PIECES`, from the end of one result
    to the beginning of the next."""

    def __init__(self, limit: int):
        self.limit = limit
        self.kept: list[np.ndarray] = []
        self._lock = (
            threading.RLock()
        )  # the garbage collector may give back while `room` looks for something

    def room(self, size: int) -> np.ndarray:
        """So many bytes, not cleared; they are given back when no view of the array is
        left."""
        if size < LARGE:
            return np.empty(size, np.uint8)
        with self._lock:
            fitting = [piece for piece in self.kept if size <= piece.nbytes <= 2 * size]
            piece = min(fitting, key=lambda piece: piece.nbytes, default=None)
            self.kept = [other for other in self.kept if other is not piece]
        if piece is None:
            piece = np.empty(size, np.uint8)
        # through a memoryview, past which NumPy does not look for the base of a view:
        # views hold `lent`, not `piece`
        lent = np.asarray(piece.data[:size])
        weakref.finalize(lent, self._back, piece).atexit = False
        return lent

    def _back(self, piece: np.ndarray) -> None:
        with self._lock:
            self.kept.append(piece)
            while (
                len(self.kept) > PIECES
                or sum(piece.nbytes for piece in self.kept) > self.limit
            ):
                del self.kept[0]


RESULTS = Memory(1 << 29)
"""Of `orient_batch` and its like, and of what they fill up."""
