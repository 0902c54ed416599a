"""One call of `jaxro block` from its options to its report and files."""

from rich.console import Console

from ..adjustment import RESULTS
from ..block.bars import NoBar
from ..block.chain import Unjoined
from ..block.datum_of_points import refer_to_points
from ..block.orient_block import OrientedBlock, orient_block
from ..block.place import TooLittleControl
from ..reports import block as report, block_comparisons as comparisons, block_plots
from ..reports.block_files import contents, summary
from ..reports.block_model import PHOTOS, POINTS, Done
from ..reports.html.block import page_of_block
from ..reports.terminal import consoles, say_what, warn
from ..tables import whole
from ..tables.fields import TableError
from . import block_other_ways as other_ways
from .block_request import Options, Task, inner_of, prepare, some_of
from .cameras_out import opencv_of_block
from .documents import settings, show_json
from .plots import MISSING, pictures_of_block, to_files


def run(options: Options) -> bool:
    """Read, orient, show, write. True if the numbers may be used. Raises TableError,
    with nothing written."""
    console, errors = consoles()
    out = options.measured.out
    inputs = whole.Inputs(*options.read)
    written, why = [], ""
    documents = options.measured.documents
    place, force = (out, whole.check_target), options.measured.force
    with documents.claimed(place, force=force, read=options.read):
        task, made = prepare(options)
        for warning in task.warnings:
            warn(errors, warning)
        done = calculate(task, options)
        if out is not None:
            picture, why = _picture(done)
            files = contents(done, options.parquet) | made | picture
            files |= opencv_of_block(done, task.cameras)
            inputs.check()
            whole.write(out, files, options.read)
            written = list(files)
        told = write_documents(done, options)
    if documents.json:
        show_json(summary(done))
        return done.usable
    report.show(console, done)
    compare(console, done, task, options)
    if why:
        errors.print(f"Warning: no picture: {why}", style="yellow", markup=False)
    if written:
        console.print(f"Written to {out}: {', '.join(written)}", markup=False)
    console.print(told, end="", markup=False)
    if options.measured.file is None:
        console.print(
            "This was a simulated block. Your own: jaxro block PAIRS.csv --control "
            "GROUND.csv --focal F",
            markup=False,
        )
    return done.usable


def write_documents(done: Done, options: Options) -> str:
    """Make the report and the pictures that are asked for; a line for each."""
    documents = options.measured.documents
    if not documents:
        return ""
    told = settings(options, options.read)
    return documents.write(
        page=lambda: page_of_block(done, told),
        pictures=lambda: pictures_of_block(done),
        read=options.read,
    )


def _picture(done: Done) -> tuple[dict[str, bytes], str]:
    """The picture of the block, or why there is none."""
    if not done.usable:
        return {}, ""
    try:
        return to_files({"block": block_plots.draw(done)}), ""
    except ModuleNotFoundError:
        return {}, MISSING


def compare(console: Console, done: Done, task: Task, options: Options) -> None:
    """The block by conditions, and by classical models, where they are asked for."""
    if not done.usable:
        return
    if options.conditions:
        with say_what("Adjusting by conditions ..."):
            found = other_ways.by_conditions(done)
        comparisons.show_conditions(console, done, found)
    if options.classical:
        with say_what("Adjusting models ..."):
            number = task.pairs.lengths
            rows = other_ways.classically(done, task.left, task.right, number)
        comparisons.show_classical(console, rows, done.unit)


# -------------------------------------------------------------------------------------
# the calculation


def calculate(task: Task, options: Options) -> Done:
    """Orient the block. Raises TableError where no scale joins it, or the control does
    not place it."""
    try:
        with say_what("Orienting the block ..."):
            oriented = orient_block(
                task.left,
                task.right,
                task.pairs,
                task.points,
                task.ground,
                more=task.more,
                inner=inner_of(options.inner),
                bars=task.bars,
                level=options.level,
                components=options.components,
                sigma_known=task.sigma_known,
            )
    except Unjoined as error:
        raise TableError(
            task.title,
            found=f"no scale that joins the photos {some_of(error.photos)} to the others",
            expected=error.advice,
        ) from None
    except TooLittleControl as error:
        raise TableError(
            "--control" if options.control is None else options.control,
            found="control that does not place the block",
            expected=f"more of it. {error}",
        ) from None
    except NoBar as error:
        raise TableError(
            options.bars or "--bars",
            found="no bar with both of its points on two photos or more",
            expected=f"names of {task.title}: {some_of(sorted(set(task.points)))}",
        ) from error
    oriented = _refer(oriented, options.datum)
    network = task.ground is None and task.bars is None
    return Done(
        title=task.title,
        unit="units" if network else options.unit,
        photo_unit=task.photo_unit,
        sigma=task.sigma,
        pairs=task.names,
        oriented=oriented,
        ground=task.ground,
        bars=task.bars,
        approximate=task.approximate,
        datum=options.datum or PHOTOS,
    )


def _refer(oriented: OrientedBlock, datum: str | None) -> OrientedBlock:
    """The block on the datum that is asked for. Raises TableError."""
    adjusted = oriented.adjusted
    if datum in (None, PHOTOS) or adjusted.result != RESULTS.successful:
        return oriented
    names = None if datum == POINTS else [name.strip() for name in datum.split(",")]
    try:
        return oriented._replace(adjusted=refer_to_points(adjusted, names))
    except ValueError as error:
        raise TableError(
            "--datum",
            found=str(error).removeprefix("refer_to_points: "),
            expected="photos, points, or names of points",
        ) from None
