"""One call of `jaxro adjust` from its options to its report and files."""

import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ..reports import network as report
from ..reports.network_files import AXES, Done, contents, summary
from ..reports.terminal import consoles, say_what
from ..surveys.geodetic import KINDS, Measured, Network, adjust_network
from ..tables import ground as ground_tables, network as tables, whole
from ..tables.examples import network as example
from ..tables.fields import TableError
from ..tables.ground import GroundPoints
from ..tables.network import Measurement
from .documents import show_json

ANGLES = {"degrees": math.pi / 180, "gon": math.pi / 200, "radians": 1.0}
"""Radians of a unit of angles."""

LINEAR = ("height", "vector", "position", *AXES)
"""Kinds that need no approximate coordinates."""


@dataclass(frozen=True)
class Options:
    """What the user asked for; None where nothing was said."""

    file: Path | None = None
    points: Path | None = None
    sigma: float | None = None
    sigma0_unknown: bool = False
    level: float = 0.05
    angles: str = "degrees"
    unit: str = "m"
    out: Path | None = None
    force: bool = False
    json: bool = False


def run(options: Options) -> bool:
    """Read, adjust, show, write. True if the numbers may be used. Raises TableError, with
    nothing written."""
    console, _ = consoles()
    read = options.file, options.points
    inputs, texts = whole.Inputs(*read), {}
    with whole.claim(options.out, whole.check_target, options.force):
        done = calculate(options)
        if options.out is not None:
            texts = contents(done)
            inputs.check()
            whole.write(options.out, texts, read)
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
    if options.file is None:
        lines = tables.parse(example.NETWORK, example.NAME, options.sigma)
        ground = ground_tables.parse(example.POINTS, example.NAME)
        title, unit, angles = example.NAME, "m", "gon"
    else:
        lines = tables.read(options.file, options.sigma)
        ground = None if options.points is None else ground_tables.read(options.points)
        title, unit, angles = str(options.file), options.unit, options.angles
    lines = [_in_radians(line, ANGLES[angles]) for line in lines]
    lines += _known_with_deviations(ground)
    names = list(dict.fromkeys(name for line in lines for name in line.points))
    network, lines = assemble(lines, names, ground, title)
    with say_what("Adjusting the network ..."):
        solution = adjust_network(network)
    relative = any(line.is_relative for line in lines)
    return Done(
        title=title,
        unit=unit,
        angle=(ANGLES[angles], angles),
        names=names,
        lines=lines,
        ground=ground,
        solution=solution,
        sigma_known=not (relative or options.sigma0_unknown),
        level=options.level,
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
    if options.file is None and options.points is not None:
        raise TableError(
            "--points",
            found="it without NETWORK.csv",
            expected="the network that they belong to",
        )


def _in_radians(line: Measurement, unit: float) -> Measurement:
    if not KINDS[line.kind].is_angle:
        return line
    return replace(line, values=line.values * unit, root=line.root * unit)


def _known_with_deviations(ground: GroundPoints | None) -> list[Measurement]:
    """Control coordinates with standard deviations, as measurements."""
    if ground is None or ground.deviations is None:
        return []
    found = []
    for k in np.flatnonzero(ground.is_a("control")):
        for axis, value, sigma in zip(
            AXES, ground.coordinates[k], ground.deviations[k], strict=True
        ):
            if np.isfinite(value) and sigma > 0:
                root = np.array([[sigma]])
                line = int(ground.lines[k])
                found.append(
                    Measurement(
                        axis, (ground.names[k],), np.array([value]), root, "", line
                    )
                )
    return found


def assemble(
    lines: list[Measurement],
    names: list[str],
    ground: GroundPoints | None,
    title: str,
) -> tuple[Network, list[Measurement]]:
    """The network, and its measurements in the order of its terms. Raises TableError
    where approximate coordinates are missing."""
    numbers = {name: k for k, name in enumerate(names)}
    sets = {
        name: k
        for k, name in enumerate(
            dict.fromkeys(line.set for line in lines if KINDS[line.kind].has_set)
        )
    }
    measured, ordered = [], []
    for kind in KINDS:
        own = [line for line in lines if line.kind == kind]
        if not own:
            continue
        ordered += own
        measured.append(
            Measured(
                kind,
                np.array([[numbers[name] for name in line.points] for line in own]),
                np.array([line.values for line in own]),
                np.array([line.root for line in own]),
                np.array([sets[line.set] for line in own])
                if KINDS[kind].has_set
                else None,
                np.array([line.above or (0.0,) * len(line.points) for line in own]),
            )
        )
    at, held = _start(names, ground)
    network = Network(np.nan_to_num(at), held, tuple(measured))
    for part in measured:
        if part.kind in LINEAR:
            continue
        need = np.array(KINDS[part.kind].touches)
        missing = np.any(np.isnan(at[part.at]) & need, axis=2)
        if np.any(missing):
            point = names[int(part.at[missing][0])]
            raise TableError(
                title if ground is None else ground.file,
                column="point",
                found=f"no approximate coordinates of point {point!r}",
                expected=f"some of every point of a {part.kind}: --points POINTS.csv "
                "with point,X,Y,Z,role, role approximate",
            )
    return network, ordered


def _start(
    names: list[str], ground: GroundPoints | None
) -> tuple[np.ndarray, np.ndarray]:
    """Approximate coordinates of the points, NaN where there are none, and which of them
    are held: those of control points without a standard deviation."""
    at, held = np.full((len(names), 3), np.nan), np.zeros((len(names), 3), bool)
    if ground is None:
        return at, held
    places = {name: k for k, name in enumerate(names)}
    for k, name in enumerate(ground.names):
        if name not in places or ground.roles[k] == "check":
            continue
        at[places[name]] = ground.coordinates[k]
        if ground.roles[k] == "control":
            exact = ground.deviations is None or ground.deviations[k] == 0
            held[places[name]] = ground.known[k] & exact
    return at, held
