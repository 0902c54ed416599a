"""The pairs of a block as they are read: a table or a file of another program, with the
cameras of the photos."""

from ..batches.ragged import Ragged
from ..reports.terminal import say_what
from ..tables.cameras import Cameras
from ..tables.fields import TableError
from ..tables.measured import Table, to_ragged
from . import other_programs, request, sigma as deviation


def read_pairs(options: request.Options) -> tuple[request.Options, Table, Cameras]:
    """The options with the unit of the file, its pairs with one standard deviation for a
    place, and the cameras. Raises TableError."""
    if other_programs.is_asked(options):
        return other_programs.read_for_block(options)
    with say_what(f"Reading {options.file} ..."):
        table = request.read_table(options).with_one_sigma()
    return options, table, _cameras(options, table)


def _cameras(options: request.Options, table: Table) -> Cameras:
    """The cameras. Raises TableError where left and right photos have one each: in a
    block a photo is the left one of a pair and the right one of the next."""
    request.check_numbers(
        options, table.has_sigma, table.file, request.SYSTEMS["relative"]
    )
    cameras = request.read_cameras(options, request.MEASURED)
    if not cameras.photos and cameras.left != cameras.right:
        raise TableError(
            cameras.file,
            found="cameras of left and of right photos",
            expected="[camera] for all photos, or [photo.NAME] for each of them: a photo "
            "is the left one of a pair, and the right one of another",
        )
    return cameras


def is_sigma_given(options: request.Options, table: Table) -> bool:
    """Whether the standard deviation of the places was given, and not told by their
    residuals."""
    return table.has_sigma or options.sigma not in (None, deviation.AUTO)


def measure(
    options: request.Options, table: Table, cameras: Cameras
) -> tuple[Ragged, str]:
    """The pairs in photo coordinates, and what their standard deviation is. Raises
    TableError."""
    given = is_sigma_given(options, table)
    both = cameras.of_all(
        table.names,
        table.file,
        photos=table.photos,
        one_sigma=given,
        place=table.first_line,
    )
    if given:
        sigma = deviation.parse(options.sigma)
        return to_ragged(table, both, sigma), "to the given standard deviations"
    pairs = to_ragged(table, both, 1.0)
    with say_what("Finding the standard deviation of the photo coordinates ..."):
        noise = deviation.from_residuals(pairs)
    photo = noise.applied(pairs)
    unit = options.unit if _plain(both) else "in the unit of the table"
    return photo, deviation.sentence(noise, unit)


def _plain(cameras: object) -> bool:
    """Whether the table has the unit of the photos."""
    each = [cameras] if isinstance(cameras, tuple) else cameras
    return all(camera.pixel_size == 1 for both in each for camera in both)  # pyright: ignore
