"""What is read of a network, and the network that is made of it."""

import itertools
import math
import re
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool

from ..reports.network_files import AXES
from ..surveys.approximate import complete
from ..surveys.geodetic import KINDS, Measured, Network
from ..tables import gama, ground as ground_tables, network as tables
from ..tables.covariances import Covariance, read as read_covariances
from ..tables.examples import network as example
from ..tables.fields import TableError
from ..tables.ground import GroundPoints
from ..tables.network import Measurement

ANGLES = {"degrees": math.pi / 180, "gon": math.pi / 200, "radians": 1.0}
"""Radians of a unit of angles."""

LINEAR = ("height", "vector", "position", "plan", *AXES)
"""Kinds that need no approximate coordinates."""

OF_AXES = {
    (True, False, False): "X",
    (False, True, False): "Y",
    (False, False, True): "Z",
    (True, True, False): "plan",
    (True, True, True): "position",
}
"""Kinds by the coordinates that are known."""

XML = (".xml", ".gkf")
"""Ends of the names of files of GNU Gama."""


@dataclass(frozen=True)
class Given:
    """What was read: measurements with angles in radians, points, the unit of angles that
    the user thinks in, whether sigma0 is known, and what is to be told. `constrained`:
    which coordinates of `ground` a free network lies at; all, if None."""

    title: str
    unit: str
    angles: str
    lines: list[Measurement]
    ground: GroundPoints | None
    sigma_known: bool
    constrained: Bool[np.ndarray, "point 3"] | None = None
    warnings: list[str] = field(default_factory=list)


def is_network(file: Path | None) -> bool:
    """Whether a file is a network by its name or its columns; one that cannot be read
    is none."""
    if file is None or file.suffix.lower() in XML:
        return file is not None
    try:
        with file.open(encoding="utf-8-sig") as opened:
            header = opened.readline(10_000).lower()
    except (OSError, UnicodeDecodeError):
        return False
    return {"from", "to"} <= {name.strip() for name in re.split("[,;\t]", header)}


def read(
    file: Path | None,
    points: Path | None,
    *,
    covariances: Path | None = None,
    sigma: float | None,
    angles: str,
    unit: str,
) -> Given:
    """The network of a file, or the example. Raises TableError."""
    if file is not None and file.suffix.lower() in XML:
        return _read_gama(file)
    if file is None:
        lines = tables.parse(example.NETWORK, example.NAME, sigma)
        ground = ground_tables.parse(example.POINTS, example.NAME)
        title, unit, angles = example.NAME, "m", "gon"
    else:
        lines = tables.read(file, sigma)
        ground = None if points is None else ground_tables.read(points)
        title = str(file)
    lines = [_in_radians(line, ANGLES[angles]) for line in lines]
    entries = [] if covariances is None else read_covariances(covariances)
    lines += _known_with_deviations(ground, entries)
    relative = any(line.is_relative for line in lines)
    return Given(title, unit, angles, lines, ground, not relative)


def _read_gama(file: Path) -> Given:
    found = gama.read(file)
    warnings = []
    if found.unmeasured:
        names = ", ".join(found.unmeasured[:10])
        warnings.append(f"points that no measurement touches: {names}")
    return Given(
        title=str(file),
        unit="m",
        angles="degrees" if found.in_degrees else "gon",
        lines=[_in_radians(line, ANGLES["gon"]) for line in found.lines],
        ground=found.ground,
        sigma_known=found.sigma_known,
        constrained=found.constrained if np.any(found.constrained) else None,
        warnings=warnings,
    )


def _in_radians(line: Measurement, unit: float) -> Measurement:
    if not KINDS[line.kind].is_angle:
        return line
    return replace(line, values=line.values * unit, root=line.root * unit)


def _known_with_deviations(
    ground: GroundPoints | None, entries: list[Covariance]
) -> list[Measurement]:
    """Control coordinates with standard deviations, as measurements: those of a point
    one by one, all of the points that have covariances together."""
    if ground is None or ground.deviations is None:
        if entries:
            raise entries[0].row.error(
                "point",
                found="covariances of points without deviations",
                expected="a table --points with sX,sY,sZ or sigma",
            )
        return []
    known = ground.is_a("control")[:, None] & ground.known & (ground.deviations > 0)
    together = {name for entry in entries for name, _ in (entry.one, entry.other)}
    found = []
    for k, axis in np.argwhere(known):
        if ground.names[k] not in together:
            value, sigma = ground.coordinates[k, axis], ground.deviations[k, axis]
            found.append(
                Measurement(
                    kind=AXES[axis],
                    points=(ground.names[k],),
                    values=np.array([value]),
                    root=np.array([[sigma]]),
                    set="",
                    line=int(ground.lines[k]),
                )
            )
    if entries:
        found.append(_known_together(ground, known, entries, together))
    return found


def _known_together(
    ground: GroundPoints,
    known: Bool[np.ndarray, "point 3"],
    entries: list[Covariance],
    together: set[str],
) -> Measurement:
    """The coordinates of several points with one covariance matrix. Raises
    TableError."""
    assert ground.deviations is not None
    points = [k for k, name in enumerate(ground.names) if name in together]
    places = {
        (ground.names[k], int(axis)): place
        for place, (k, axis) in enumerate(
            (k, axis) for k in points for axis in np.flatnonzero(known[k])
        )
    }
    for entry in entries:
        for column, coordinate in zip(
            ("point", "other"), (entry.one, entry.other), strict=True
        ):
            if coordinate not in places:
                name, axis = coordinate
                raise entry.row.error(
                    column,
                    found=f"{name!r}, whose {AXES[axis]} is not known with a deviation",
                    expected="control points of --points with coordinates and deviations",
                )
    kind = OF_AXES.get(tuple(known[points[0]].tolist()))
    if kind is None or np.any(known[points] != known[points[0]]):
        raise entries[0].row.error(
            "point",
            found="points that are known in different coordinates",
            expected="X,Y,Z of all of them, X,Y of all, or one coordinate of all",
        )
    own = known[points]
    matrix = np.diag(ground.deviations[points][own] ** 2)
    for entry in entries:
        i, j = places[entry.one], places[entry.other]
        matrix[i, j] = matrix[j, i] = entry.value
    try:
        root = np.linalg.cholesky(matrix)
    except np.linalg.LinAlgError:
        raise entries[0].row.error(
            "point",
            found="a covariance matrix that is not positive",
            expected="covariances smaller than the products of the standard deviations",
        ) from None
    return Measurement(
        kind=kind,
        points=tuple(ground.names[k] for k in points),
        values=ground.coordinates[points][own],
        root=root,
        set="",
        line=int(ground.lines[points[0]]),
    )


def assemble(given: Given, names: list[str]) -> tuple[Network, list[Measurement]]:
    """The network, and its measurements in the order of its terms. Raises TableError
    where approximate coordinates are missing."""
    lines, ground = given.lines, given.ground
    numbers = {name: k for k, name in enumerate(names)}
    sets = {
        name: k
        for k, name in enumerate(
            dict.fromkeys(line.set for line in lines if KINDS[line.kind].has_set)
        )
    }
    measured, ordered = [], []
    # those with one covariance matrix are of a part of their own, by their size
    sizes = sorted({len(line.points) for line in lines})
    for kind, size in itertools.product(KINDS, sizes):
        own = [line for line in lines if (line.kind, len(line.points)) == (kind, size)]
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
    at = complete(at, measured)
    datum = None
    if given.constrained is not None and ground is not None:
        of_name = dict(zip(ground.names, given.constrained, strict=True))
        datum = np.array([of_name[name] for name in names])
    network = Network(np.nan_to_num(at), held, tuple(measured), datum)
    for part in measured:
        if part.kind in LINEAR:
            continue
        need = np.array(KINDS[part.kind].touches)
        missing = np.any(np.isnan(at[part.at]) & need, axis=2)
        if np.any(missing):
            point = names[int(part.at[missing][0])]
            raise TableError(
                given.title if ground is None else ground.file,
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
