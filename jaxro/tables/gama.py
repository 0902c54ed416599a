"""Networks of GNU Gama: the XML input of gama-local in, `Gama` out, or one clear error
that names line and element.

Read are points, sets of directions, distances, angles, azimuths, slope distances, zenith
angles, height differences, vectors and observed coordinates, with heights of instrument
and targets. Angles are gons, or degrees as 57-32-28.4; deviations are mm and cc (of
degrees seconds). Measurements of one kind with covariances between them are one of
several numbers. What has another meaning than here is an error: covariances between
kinds, points that are neither fixed nor adjusted. What says only how gama-local
computes and writes (`gama_elements.OF_GAMA`) has no effect.
"""

import re
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from ..surveys.geodetic import KINDS
from . import fields
from .gama_elements import Element, read_elements
from .gama_numbers import MM, SECOND, angle, covariance_matrix, root_of
from .ground import GroundPoints
from .network import Measurement

MOST = 50_000_000
"""Bytes of a file."""

MOST_TOGETHER = 3000
"""Numbers with one covariance matrix."""

STATUS = re.compile(r"(xy|XY)?(z|Z)?")

MEASURED = {
    "direction": ("direction", "direction-stdev"),
    "distance": ("distance", "distance-stdev"),
    "s-distance": ("slope", "distance-stdev"),
    "angle": ("angle", "angle-stdev"),
    "z-angle": ("zenith", "zenith-angle-stdev"),
    "azimuth": ("azimuth", "azimuth-stdev"),
}
"""Elements of a set, the kinds that they are, and where their deviations may stand."""

NORTH = {"n": 0, "e": 1, "s": 2, "w": 3}
"""Quarter turns clockwise from the north."""


class Gama(NamedTuple):
    """A network as GNU Gama describes it: measurements with angles in gons, whatever
    they were in the file; its points, whose fixed coordinates have the deviation 0;
    whether their datum are some of them alone; whether sigma0 is known; whether the
    user thinks in degrees; the points that nothing measures."""

    lines: list[Measurement]
    ground: GroundPoints
    constrained: Bool[np.ndarray, "point 3"]
    sigma_known: bool
    in_degrees: bool
    unmeasured: list[str]


def read(path: Path) -> Gama:
    """The network of a file. Raises TableError."""
    return parse(fields.read_text(path, MOST), str(path))


def parse(text: str, file: str) -> Gama:
    """The network of an XML text. Raises TableError."""
    return _Reader(file).network(read_elements(text, file))


class _Status(NamedTuple):
    """What a point is: its line, coordinates, and which of them are fixed, adjusted, and
    of the datum."""

    line: int
    at: Float[np.ndarray, "3"]
    fixed: Bool[np.ndarray, "3"]
    adjusted: Bool[np.ndarray, "3"]
    constrained: Bool[np.ndarray, "3"]


class _Found(NamedTuple):
    """A measurement before its deviations are known; `scales`: its units of deviations
    in those of its values."""

    kind: str
    points: tuple[str, ...]
    values: list[float]
    scales: list[float]
    above: tuple[float, ...] = ()
    default: str = ""


class _Reader:
    """Reads the elements of a file one after the other."""

    def __init__(self, file: str):
        self.file = file
        self.sigma_apr, self.sigma_known = 10.0, False
        self.turn, self.north = 1.0, 0.0
        self.in_degrees = False
        self.defaults: dict[str, str] = {}
        self.points: dict[str, _Status] = {}
        self.lines: list[Measurement] = []
        self.clusters = 0

    def network(self, document: Element) -> Gama:
        """What the document says."""
        if len(document.children) != 1:
            raise document.error("no single <network>", "one <network>")
        (network,) = document.children
        self._axes(network)
        for name, read_part in (
            ("parameters", self._parameters),
            ("points-observations", self._read_points),
            ("points-observations", self._read_measurements),
        ):
            for part in network.children:
                if part.name == name:
                    read_part(part)
        if not self.lines:
            raise document.error("no measurements", "<obs> and the like")
        names, status = list(self.points), list(self.points.values())
        fixed = np.array([one.fixed for one in status])
        held = np.any(fixed, axis=1)
        ground = GroundPoints(
            file=self.file,
            names=names,
            coordinates=np.array([one.at for one in status]),
            deviations=np.where(fixed, 0.0, np.nan),
            roles=["control" if one else "approximate" for one in held],
            lines=np.array([one.line for one in status]),
        )
        used = {name for line in self.lines for name in line.points}
        return Gama(
            lines=self.lines,
            ground=ground,
            constrained=np.array([one.constrained for one in status]),
            sigma_known=self.sigma_known,
            in_degrees=self.in_degrees,
            unmeasured=[name for name in names if name not in used],
        )

    # ---------------------------------------------------------------------------------
    # the frame

    def _axes(self, network: Element) -> None:
        """Angles here grow from the axis of x to that of y."""
        axes = network.attributes.get("axes-xy", "ne").strip()
        if len(axes) != 2 or not set(axes) <= set(NORTH):
            raise network.error(f"axes-xy={axes!r}", "ne, en, sw and the like")
        x, y = (NORTH[letter] for letter in axes)
        clockwise = (y - x) % 4 == 1
        if not clockwise and (y - x) % 4 != 3:
            raise network.error(f"axes-xy={axes!r}", "two axes at right angles")
        sense = network.attributes.get("angles", "left-handed").strip()
        if sense not in ("left-handed", "right-handed"):
            raise network.error(f"angles={sense!r}", "left-handed, right-handed")
        self.turn = 1.0 if clockwise == (sense == "left-handed") else -1.0
        self.north = -100.0 * x if clockwise else 100.0 * x

    def _parameters(self, element: Element) -> None:
        if "sigma-apr" in element.attributes:
            self.sigma_apr = element.positive("sigma-apr")
        act = element.attributes.get("sigma-act", "aposteriori").strip()
        if act not in ("apriori", "aposteriori"):
            raise element.error(f"sigma-act={act!r}", "apriori or aposteriori")
        self.sigma_known = act == "apriori"
        self.in_degrees |= element.attributes.get("angles", "400").strip() == "360"

    # ---------------------------------------------------------------------------------
    # points

    def _read_points(self, part: Element) -> None:
        for element in part.children:
            if element.name != "point":
                continue
            name = element.point("id")
            if name in self.points:
                first = self.points[name].line
                raise element.error(
                    f"the point {name!r} a second time (first on line {first})",
                    "each point once",
                )
            at = np.array([element.number(key, np.nan) for key in "xyz"])
            fixed, _ = self._status(element, "fix")
            adjusted, constrained = self._status(element, "adj")
            if np.any(fixed & adjusted):
                raise element.error("a coordinate in fix and adj", "one of them")
            if np.any(fixed & np.isnan(at)):
                missing = "xyz"[int(np.argmax(fixed & np.isnan(at)))]
                raise element.error(
                    f"a fixed point {name!r} without {missing}", "its value"
                )
            self.points[name] = _Status(
                element.line, at, fixed, adjusted, constrained & adjusted
            )

    def _status(
        self, element: Element, key: str
    ) -> tuple[Bool[np.ndarray, "3"], Bool[np.ndarray, "3"]]:
        """Which coordinates the attribute names, and which in capitals."""
        given = element.attributes.get(key, "").strip()
        if not STATUS.fullmatch(given):
            raise element.error(f"{key}={given!r}", "xy, z, xyz, XY, Z, XYZ")
        named = np.array([axis in given.lower() for axis in "xyz"])
        return named, np.array([axis in given for axis in "XYZ"])

    # ---------------------------------------------------------------------------------
    # measurements

    def _read_measurements(self, part: Element) -> None:
        self.defaults = part.attributes
        of_cluster: dict[str, Callable[[Element, Element], list[_Found]]] = {
            "obs": self._sight,
            "height-differences": self._rise,
            "vectors": self._vector,
            "coordinates": self._coordinates,
        }
        for element in part.children:
            if element.name in of_cluster:
                self._read_cluster(element, of_cluster[element.name])

    def _read_cluster(self, cluster: Element, one: Callable) -> None:
        """The measurements of a cluster with their covariance matrix, if it has one."""
        self.clusters += 1
        members, matrices = [], []
        for element in cluster.children:
            if element.name == "cov-mat":
                matrices.append(element)
            else:
                members += [(element, found) for found in one(cluster, element)]
        if len(matrices) > 1:
            raise matrices[1].error("a second <cov-mat>", "one for all")
        scales = np.array([scale for _, found in members for scale in found.scales])
        if matrices and len(scales) > MOST_TOGETHER:
            raise matrices[0].error(
                f"a <cov-mat> of {len(scales)} numbers", f"at most {MOST_TOGETHER}"
            )
        matrix = None
        if matrices:
            matrix = covariance_matrix(matrices[0], len(scales)) * np.outer(
                scales, scales
            )
        for element, found in members:
            self._check_points(element, found)
        begin = 0
        for element, found in self._together(members, matrix, matrices):
            own = slice(begin, begin := begin + len(found.values))
            if matrix is None:
                root = np.array([[self._deviation(element, found)]])
            else:
                root = root_of(matrices[0], matrix[own, own])
            self.lines.append(
                Measurement(
                    found.kind,
                    found.points,
                    np.array(found.values),
                    root,
                    f"<obs> {self.clusters}",
                    element.line,
                    above=found.above,
                )
            )

    def _together(
        self,
        members: list[tuple[Element, _Found]],
        matrix: Float[np.ndarray, "n n"] | None,
        matrices: list[Element],
    ) -> list[tuple[Element, _Found]]:
        """The members as they are, or as one measurement where their covariance matrix
        is not that of each."""
        ends = np.cumsum([len(found.values) for _, found in members])
        member = np.searchsorted(ends, np.arange(ends[-1] if members else 0), "right")
        if matrix is None or not np.any(matrix[member[:, None] != member[None, :]]):
            return members
        kinds = {found.kind for _, found in members}
        if len(kinds) > 1:
            raise matrices[0].error(
                f"covariances between measurements of {', '.join(sorted(kinds))}",
                "covariances within one kind",
            )
        found = [one for _, one in members]
        return [
            (
                members[0][0],
                _Found(
                    found[0].kind,
                    tuple(name for one in found for name in one.points),
                    [value for one in found for value in one.values],
                    [scale for one in found for scale in one.scales],
                    tuple(
                        height
                        for one in found
                        for height in one.above or (0.0,) * len(one.points)
                    ),
                ),
            )
        ]

    def _sight(self, cluster: Element, element: Element) -> list[_Found]:
        kind, default = MEASURED[element.name]
        ends = ("bs", "fs") if kind == "angle" else ("to",)
        own = element if "from" in element.attributes else cluster
        points = (own.point("from"), *(element.point(e) for e in ends))
        here = points[0] == cluster.attributes.get("from", "").strip()
        above = cluster.number("from_dh", 0.0) if here else 0.0
        heights = [element.number("from_dh", above)]
        heights += [element.number(f"{end}_dh", 0.0) for end in ends]
        if KINDS[kind].is_angle:
            value, scale = angle(element)
            self.in_degrees |= scale == SECOND
            if kind == "zenith" and not 0 < value < 200:
                raise element.error(
                    f"val={element.attributes['val']!r} of <z-angle>",
                    "an angle from the vertical, between 0 and 200 gon",
                )
            if kind != "zenith":
                value *= self.turn
            if kind == "azimuth":
                value += self.north
        else:
            value, scale = element.positive("val"), MM
        return [_Found(kind, points, [value], [scale], tuple(heights), default)]

    def _rise(self, cluster: Element, element: Element) -> list[_Found]:
        points = element.point("from"), element.point("to")
        return [_Found("height", points, [element.number("val")], [MM])]

    def _vector(self, cluster: Element, element: Element) -> list[_Found]:
        points = element.point("from"), element.point("to")
        values = [element.number(key) for key in ("dx", "dy", "dz")]
        above = tuple(element.number(key, 0.0) for key in ("from_dh", "to_dh"))
        return [_Found("vector", points, values, [MM] * 3, above)]

    def _coordinates(self, cluster: Element, element: Element) -> list[_Found]:
        name = element.point("id")
        if {"fix", "adj"} & set(element.attributes):
            raise element.error(
                "fix or adj in <coordinates>", "it in <points-observations>"
            )
        axes = [key for key in "xyz" if key in element.attributes]
        kinds = {"xyz": "position", "xy": "plan", "z": "Z", "x": "X", "y": "Y"}
        if "".join(axes) not in kinds:
            raise element.error(f"the coordinates {axes}", "x, y, z; x, y; or z")
        values = [element.number(key) for key in axes]
        if name in self.points:
            at = self.points[name].at
            for key, value in zip(axes, values, strict=True):
                if np.isnan(at["xyz".index(key)]):
                    at["xyz".index(key)] = value
        return [_Found(kinds["".join(axes)], (name,), values, [MM] * len(axes))]

    def _deviation(self, element: Element, found: _Found) -> float:
        """Of a single number without covariance matrix."""
        scale = found.scales[0]
        if "stdev" in element.attributes:
            return element.positive("stdev") * scale
        if "dist" in element.attributes:
            return self.sigma_apr * np.sqrt(element.positive("dist")) * scale
        if found.default in self.defaults:
            return self._default(element, found) * scale
        raise element.error(
            f"<{element.name}> without a standard deviation",
            "stdev, a <cov-mat>, or a deviation in <points-observations>",
        )

    def _default(self, element: Element, found: _Found) -> float:
        """The deviation of all of a kind; of distances a + b D^c, D in kilometres."""
        given = self.defaults[found.default]
        most = 3 if found.default == "distance-stdev" else 1
        try:
            numbers = [float(entry) for entry in given.split()]
        except ValueError:
            numbers = []
        if 1 <= len(numbers) <= most:
            a, b, c = numbers + [0.0, 1.0][len(numbers) - 1 :]
            deviation = a + b * abs(found.values[0] / 1000) ** c
            if np.isfinite(deviation) and deviation > 0:
                return deviation
        raise element.error(
            f"{found.default}={given!r}", f"at most {most} numbers, above 0"
        )

    def _check_points(self, element: Element, found: _Found) -> None:
        """Raises TableError for a point that takes no part in what it is measured for."""
        touches = np.array(KINDS[found.kind].touches)
        for name in found.points:
            if name not in self.points:
                raise element.error(
                    f"the point {name!r} without <point>", "a <point> of it"
                )
            one = self.points[name]
            if np.any(touches & ~(one.fixed | one.adjusted)):
                axis = "xyz"[int(np.argmax(touches & ~(one.fixed | one.adjusted)))]
                raise element.error(
                    f"the point {name!r}, whose {axis} is neither fixed nor adjusted",
                    f"it in fix or adj of its <point> on line {one.line}, or no "
                    "measurement of it",
                )
