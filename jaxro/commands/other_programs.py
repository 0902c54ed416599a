"""Files of other programs in place of a table: `jaxro orient`, `jaxro clean` and `jaxro
block` take what `exchange.files` reads."""

from dataclasses import replace

from ..exchange import files
from ..tables.cameras import Cameras, text_of
from ..tables.fields import TableError
from ..tables.measured import Table
from .request import Options


def is_asked(options: Options) -> bool:
    """Whether the file is one of another program."""
    return options.file is not None and files.is_of_other_program(options.file)


def read(options: Options) -> tuple[Options, Table, Cameras]:
    """The pairs and the cameras of the file, and the options with its unit, the pixel.
    The standard deviations of the table are relative: --sigma multiplies them. Raises
    TableError for options that say again what the file says."""
    assert options.file is not None
    beside = {
        "--camera": options.camera is not None,
        "--focal": options.focal is not None,
        "--principal-point": options.principal_point is not None,
        "--pixel-size": options.pixel_size is not None,
        "--y-down": options.y_down,
    }
    for name, given in beside.items():
        if given:
            raise TableError(
                name,
                found=f"it beside {options.file}",
                expected="it with a table only; this file has its cameras with it",
            )
    unit = "px" if options.unit == Options.unit else options.unit
    found = files.read(options.file)
    return replace(options, unit=unit), found.table, found.cameras


def read_for_block(options: Options) -> tuple[Options, Table, Cameras]:
    """The same for a block, in which a place has one standard deviation: the mean of
    each point, with a warning. Raises TableError, too, for pairs that nothing joins."""
    options, table, cameras = read(options)
    photos = [name for side in table.photos or () for name in side]
    if len(photos) == len(set(photos)) > 2:
        raise TableError(
            table.file,
            found=f"{len(table.names)} pairs with photos and points of their own, as "
            "HDF5 files have them",
            expected="one pair; or a file that says which photos and points of two pairs "
            "are one: a table with left, right and point, or a model of COLMAP",
        )
    return options, table.with_one_sigma(), cameras


def cameras_text(options: Options, cameras: Cameras) -> dict[str, str]:
    """cameras.toml by its name, with which `jaxro orient` reads again what was cleaned;
    nothing where the user has the cameras of a table."""
    if not is_asked(options):
        return {}
    focals = {name: camera.focal for name, camera in cameras.photos.items()}
    return {"cameras.toml": text_of(focals)}
