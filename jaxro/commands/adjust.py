"""One call of `jaxro adjust` from its options to its report and files."""

import math
from dataclasses import dataclass
from pathlib import Path

from ..reports import network as report
from ..reports.network_files import Done, Simulated, contents, summary
from ..reports.terminal import consoles, say_what
from ..surveys.geodetic import adjust_network
from ..tables import whole
from ..tables.fields import TableError
from ..tables.network import Measurement
from .documents import show_json
from .network_input import ANGLES, XML, assemble, read

WRONG, SIZE = 1, 6.0
"""How many measurements are wrong in a simulated job, and by how many standard
deviations."""


@dataclass(frozen=True)
class Options:
    """What the user asked for; None where nothing was said."""

    file: Path | None = None
    points: Path | None = None
    covariances: Path | None = None
    sigma: float | None = None
    sigma0_unknown: bool = False
    level: float = 0.05
    angles: str = "degrees"
    unit: str = "m"
    out: Path | None = None
    force: bool = False
    json: bool = False
    promise: int | None = None
    wrong: int | None = None
    size: float | None = None


def run(options: Options) -> bool:
    """Read, adjust, show, write. True if the numbers may be used. Raises TableError, with
    nothing written."""
    console, _ = consoles()
    read_files = options.file, options.points, options.covariances
    inputs, texts = whole.Inputs(*read_files), {}
    with whole.claim(options.out, whole.check_target, options.force):
        done = calculate(options)
        if options.out is not None:
            texts = contents(done)
            inputs.check()
            whole.write(options.out, texts, read_files)
    if options.json:
        show_json(summary(done))
        return done.usable
    report.show(console, done)
    if texts:
        console.print(f"Written to {options.out}: {', '.join(texts)}", markup=False)
    if options.file is None:
        console.print(
            "This was a simulated example. Your own network: jaxro adjust NETWORK.csv "
            "--points POINTS.csv",
            markup=False,
        )
    return done.usable


def calculate(options: Options) -> Done:
    """Read everything, and adjust it. Raises TableError."""
    _check(options)
    given = read(
        options.file,
        options.points,
        covariances=options.covariances,
        sigma=options.sigma,
        angles=options.angles,
        unit=options.unit,
    )
    names = list(dict.fromkeys(name for line in given.lines for name in line.points))
    network, lines = assemble(given, names)
    simulated = _simulated(options, lines)
    with say_what("Adjusting the network ..."):
        solution = adjust_network(network)
    return Done(
        title=given.title,
        unit=given.unit,
        angle=(ANGLES[given.angles], given.angles),
        names=names,
        lines=lines,
        ground=given.ground,
        solution=solution,
        sigma_known=given.sigma_known and not options.sigma0_unknown,
        level=options.level,
        simulated=simulated,
        warnings=given.warnings,
    )


def _check(options: Options) -> None:
    """Raises TableError for options that are no numbers of their kind."""
    if options.sigma is not None and not (
        math.isfinite(options.sigma) and options.sigma > 0
    ):
        raise TableError("--sigma", found=repr(options.sigma), expected="a number > 0")
    if not 0 < options.level < 1:
        raise TableError(
            "--level", found=repr(options.level), expected="a number between 0 and 1"
        )
    if options.angles not in ANGLES:
        raise TableError(
            "--angles", found=repr(options.angles), expected=", ".join(ANGLES)
        )
    tables = {"--points": options.points, "--covariances": options.covariances}
    for option, table in tables.items():
        if options.file is None and table is not None:
            raise TableError(
                option,
                found="it without NETWORK.csv",
                expected="the network that they belong to",
            )
    if options.file is not None and options.file.suffix.lower() in XML:
        said = {
            "--points": options.points is not None,
            "--covariances": options.covariances is not None,
            "--sigma": options.sigma is not None,
            "--angles": options.angles != "degrees",
        }
        for option in (name for name, there in said.items() if there):
            raise TableError(
                option,
                found=f"it beside {options.file}",
                expected="no such option: an XML file of GNU Gama says it itself",
            )


def _simulated(options: Options, lines: list[Measurement]) -> Simulated | None:
    """What is to be simulated. Raises TableError for what cannot be."""
    if options.promise is None:
        for name, value in (("--wrong", options.wrong), ("--size", options.size)):
            if value is not None:
                raise TableError(
                    name,
                    found="it without --promise",
                    expected="--promise TRIALS with it",
                )
        return None
    wrong = WRONG if options.wrong is None else options.wrong
    size = SIZE if options.size is None else options.size
    several = [line for line in lines if len(line.values) > 1]
    if several:
        raise TableError(
            "--promise",
            found=f"it with several numbers together: {several[0].kind}, line "
            f"{several[0].line}",
            expected="a network whose measurements are single numbers",
        )
    if not 0 <= wrong < len(lines):
        raise TableError(
            "--wrong",
            found=str(wrong),
            expected=f"0, or less than the {len(lines)} measurements",
        )
    if not math.isfinite(size):
        raise TableError("--size", found=repr(size), expected="a number")
    return Simulated(options.promise, wrong, size)
