"""Geodetic networks: height differences, distances, directions, angles and vectors
between points, adjusted together.

    height       Z_b - Z_a
    slope        |b - a|
    distance     |b - a| in plan
    direction    t(a, b) - o, o the orientation of its set
    angle        t(a, c) - t(a, b)
    azimuth      t(a, b)
    zenith       the angle between the vertical and b - a
    vector       b - a, with a covariance matrix
    position     a itself: coordinates that are known with a covariance matrix
    plan         the same of X and Y
    X, Y, Z      one coordinate of a

t(a, b) = arctan2(Y_b - Y_a, X_b - X_a), from the axis of X through that of Y: clockwise
where X is north and Y is east. Angles are radians. A coordinate that no measurement
touches is not part of the network; one that is held is known. An instrument or target
stands above its point by a known height. Where the measurements
leave the position of the network open, all points together, or chosen ones, are its
datum: of all solutions the one next to their approximate coordinates (inner
constraints, Meissl 1962).
"""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..adjustment import JointAdjustment, Term, adjust
from ..statistics.rows import SMALL, rows

Point = Float[Array, "3"]


STILL = 1e-6
"""Part of an open way below which a point does not move along it."""


class Measured(NamedTuple):
    """Measurements of one kind: the numbers of the points of each (`at`; as many as the
    kind has, or several times as many: several measurements with one covariance
    matrix), what was measured, and the lower triangle of the Cholesky factor
    of its covariance matrix (a standard deviation, of one number). `set`: of a
    direction the number of its set. `above`: the heights of instrument and targets above
    the points; zero, if None."""

    kind: str
    at: Int[np.ndarray, "measurement ends"]
    values: Float[np.ndarray, "measurement m"]
    roots: Float[np.ndarray, "measurement m m"]
    set: Int[np.ndarray, " measurement"] | None = None
    above: Float[np.ndarray, "measurement ends"] | None = None


class Kind(NamedTuple):
    """A kind of measurement: how many points it joins, how many numbers it has, which
    coordinates it touches, its function of the points (and of the orientation of its
    set), and whether it is an angle."""

    ends: int
    numbers: int
    touches: tuple[bool, bool, bool]
    function: Callable
    is_angle: bool = False
    has_set: bool = False


def azimuth(a: Point, b: Point) -> Float[Array, ""]:
    """t(a, b), from the axis of X through that of Y."""
    return jnp.arctan2(b[1] - a[1], b[0] - a[0])


def zenith(a: Point, b: Point) -> Float[Array, ""]:
    """The angle between the vertical at a and the line to b."""
    x, y, z = b - a
    return jnp.arctan2(jnp.sqrt(x**2 + y**2), z)


PLAN, HEIGHT, SPACE = (True, True, False), (False, False, True), (True, True, True)

KINDS = {
    "height": Kind(2, 1, HEIGHT, lambda a, b: (b - a)[2:]),
    "slope": Kind(2, 1, SPACE, lambda a, b: jnp.sqrt(jnp.sum((b - a) ** 2))[None]),
    "distance": Kind(
        2, 1, PLAN, lambda a, b: jnp.sqrt(jnp.sum((b - a)[:2] ** 2))[None]
    ),
    "direction": Kind(
        2,
        1,
        PLAN,
        lambda a, b, o: (azimuth(a, b) - o[0])[None],
        is_angle=True,
        has_set=True,
    ),
    "angle": Kind(
        3,
        1,
        PLAN,
        lambda a, b, c: (azimuth(a, c) - azimuth(a, b))[None],
        is_angle=True,
    ),
    "azimuth": Kind(2, 1, PLAN, lambda a, b: azimuth(a, b)[None], is_angle=True),
    "zenith": Kind(2, 1, SPACE, lambda a, b: zenith(a, b)[None], is_angle=True),
    "vector": Kind(2, 3, SPACE, lambda a, b: b - a),
    "position": Kind(1, 3, SPACE, lambda a: a),
    "plan": Kind(1, 2, PLAN, lambda a: a[:2]),
    "X": Kind(1, 1, (True, False, False), lambda a: a[:1]),
    "Y": Kind(1, 1, (False, True, False), lambda a: a[1:2]),
    "Z": Kind(1, 1, HEIGHT, lambda a: a[2:]),
}
"""All kinds by name."""


class Network(NamedTuple):
    """A network: approximate `coordinates` of its points, which of these are `held`,
    and what is measured. `datum`: those that a free network lies at, all, if None."""

    coordinates: Float[np.ndarray, "point 3"]
    held: Bool[np.ndarray, "point 3"]
    measured: tuple[Measured, ...]
    datum: Bool[np.ndarray, "point 3"] | None = None

    @property
    def touched(self) -> Bool[np.ndarray, "point 3"]:
        """The coordinates that a measurement touches."""
        found = np.zeros(self.held.shape, bool)
        for part in self.measured:
            found[part.at.ravel()] |= KINDS[part.kind].touches
        return found

    @property
    def known(self) -> Bool[np.ndarray, "point 3"]:
        """The coordinates that are held or known with a deviation."""
        found = self.held.copy()
        for part in self.measured:
            if KINDS[part.kind].ends == 1:
                found[part.at.ravel()] |= KINDS[part.kind].touches
        return found & self.touched

    @property
    def sets(self) -> int:
        """How many sets of directions there are."""
        numbers = [p.set for p in self.measured if p.set is not None and len(p.set)]
        return 1 + max((int(np.max(number)) for number in numbers), default=-1)


class Solution(NamedTuple):
    """An adjusted network, with its `terms` and what was held; `ways`: displacements
    that the measurements left open, of position, rotation and scale; `loose`: the points
    that these move although others are known in the same coordinates, and which
    therefore are not determined."""

    network: Network
    adjusted: JointAdjustment
    terms: tuple[Term, ...]
    held: dict[str, Bool[np.ndarray, "_ _"]]
    ways: Float[np.ndarray, "way p"]
    loose: Bool[np.ndarray, " point"]

    @property
    def datum(self) -> int:
        """How many numbers of position, rotation and scale the measurements left
        open."""
        return len(self.ways)

    @property
    def coordinates(self) -> Float[np.ndarray, "point 3"]:
        return np.asarray(self.adjusted.parameters["point"])


def adjust_network(network: Network) -> Solution:
    """The network adjusted by least squares; the standard deviations are true ones if
    sigma0 is 1."""
    terms = tuple(_term(part) for part in network.measured)
    start = {"point": jnp.asarray(network.coordinates)}
    held = {"point": network.held | ~network.touched}
    if network.sets:
        start["orientation"] = jnp.asarray(_orientations(network))[:, None]
        held["orientation"] = np.zeros((network.sets, 1), bool)
    open_ways = _open_ways(terms, start, held)
    constraints = None
    if len(open_ways):
        of_points = jnp.asarray(_of_datum(network, open_ways))
        constraints = _InnerConstraints(of_points, start["point"])
    adjusted = adjust(terms, start, held=held, constraints=constraints)
    moved = np.max(np.abs(open_ways[:, : network.held.size]), axis=0, initial=0.0)
    is_moved = moved.reshape(network.held.shape) > STILL
    loose = np.any(is_moved & np.any(network.known, axis=0), axis=1)
    return Solution(network, adjusted, terms, held, open_ways, loose)


def displacements(
    solution: Solution,
) -> tuple[Bool[np.ndarray, "point 3"], Float[np.ndarray, "coordinate p"]]:
    """The coordinates that are adjusted, and their displacements as linear functions of
    all parameters: in a free network, against its datum (Baarda's S-transformation)."""
    network = solution.network
    free = network.touched & ~network.held
    size = network.held.size + network.sets
    found = np.eye(size)[np.flatnonzero(free)]
    if solution.datum:
        of_datum = _of_datum(network, solution.ways)
        ways = solution.ways[:, : network.held.size]
        shift = np.linalg.solve(of_datum @ ways.T, of_datum)
        back = solution.ways.T[np.flatnonzero(free)] @ shift
        found[:, : network.held.size] -= back
    # in the order of the families of the solution, which is that of its rows
    of_points, of_sets = np.split(found, [network.held.size], axis=1)
    parts = {"point": of_points, "orientation": of_sets}
    return free, np.hstack([parts[name] for name in solution.adjusted.parameters])


def _of_datum(
    network: Network, ways: Float[np.ndarray, "way p"]
) -> Float[np.ndarray, "way own"]:
    """The part of open ways that the points of the datum may not go."""
    of_points = ways[:, : network.held.size]
    return of_points if network.datum is None else of_points * network.datum.ravel()


class _Condition(eqx.Module):
    """function(points) - (l + L v) = 0 of one kind, v white."""

    kind: str = eqx.field(static=True)

    def __call__(self, *given: Array | tuple[Array, ...]) -> Float[Array, " m"]:
        *blocks, (white, values, root, above) = given
        kind = KINDS[self.kind]
        count = len(blocks) - kind.has_set
        up = jnp.array([0.0, 0.0, 1.0])
        ends = [a + h * up for a, h in zip(blocks[:count], above, strict=True)]
        found = [
            kind.function(*ends[begin : begin + kind.ends], *blocks[count:])
            for begin in range(0, count, kind.ends)
        ]
        off = jnp.concatenate(found) - values
        if kind.is_angle:
            # the nearest of all full turns, which no derivative sees
            off = off - 2 * jnp.pi * jnp.round(off / (2 * jnp.pi))
        return off - root @ white


def _term(part: Measured) -> Term:
    touches = [("point", part.at[:, end]) for end in range(part.at.shape[1])]
    if part.set is not None:
        touches.append(("orientation", part.set))
    white = np.zeros(part.values.shape)
    above = np.zeros(part.at.shape) if part.above is None else part.above
    return Term(
        _Condition(part.kind),
        (white, part.values, part.roots, above),
        (1.0, None, None, None),
        touches=touches,
    )


def _orientations(network: Network) -> Float[np.ndarray, " set"]:
    """Approximate orientations of all sets, the mean directions of t - l."""
    turns = np.zeros(network.sets, complex)
    for part in network.measured:
        if part.set is None:
            continue
        away = network.coordinates[part.at[:, 1]] - network.coordinates[part.at[:, 0]]
        off = np.arctan2(away[:, 1], away[:, 0]) - part.values[:, 0]
        np.add.at(turns, part.set, np.exp(1j * off))
    return np.angle(turns)


def _open_ways(
    terms: tuple[Term, ...], start: dict[str, Array], held: dict[str, np.ndarray]
) -> Float[np.ndarray, "way p"]:
    """Displacements of all free parameters that change no measurement, orthonormal."""
    design = rows(terms, start, held=held).design
    free = ~np.concatenate([held[name].ravel() for name in start])
    length = np.linalg.norm(design, axis=0)
    scale = np.where(length > 0, length, 1.0)
    _, size, ways = np.linalg.svd((design / scale)[:, free])
    rank = int(np.sum(size > SMALL * np.max(size, initial=0.0)))
    found = np.zeros((np.sum(free) - rank, len(free)))
    found[:, free] = ways[rank:]
    left, *_ = np.linalg.svd((found / scale).T, full_matrices=False)
    return left.T


class _InnerConstraints(eqx.Module):
    """No displacement of the points along the ways that are open."""

    ways: Float[Array, "way own"]
    at: Float[Array, "point 3"]

    def __call__(self, parameters: dict[str, Array]) -> Float[Array, " way"]:
        return self.ways @ (parameters["point"] - self.at).ravel()
