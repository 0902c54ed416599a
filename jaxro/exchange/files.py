"""Files of other programs as input of `jaxro orient`, `jaxro clean` and `jaxro block`,
told by their kind."""

from pathlib import Path

from .bundler import read_bundler
from .colmap_model import FILES
from .colmap_text import read_colmap_text
from .h5 import read_h5
from .matches import Matches

READERS = {".h5": read_h5, ".hdf5": read_h5, ".out": read_bundler}
"""By the ending of the file; a folder is a model of COLMAP."""


def is_of_other_program(path: Path) -> bool:
    """Whether a file or folder is read here, and not as a table."""
    if path.suffix.lower() in READERS:
        return True
    return path.is_dir() and any(
        (path / f"{FILES[0]}.{ending}").is_file() for ending in ("txt", "bin")
    )


def read(path: str | Path, *, sigma: float | None = None) -> Matches:
    """The pairs of a file of another program. `sigma`: the standard deviation of a
    pixel coordinate. Raises TableError."""
    path = Path(path)
    reader = READERS.get(path.suffix.lower(), read_colmap_text)
    return reader(path, sigma=sigma)
