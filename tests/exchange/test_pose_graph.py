"""Pose graphs: what GTSAM and a plain solution in NumPy make of the files, and whether
the sums of squares are what the degrees of freedom say."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxro
from jaxro import block, exchange
from jaxro.exchange import tangents
from jaxro.exchange.pose_graph import UNKNOWN, g2o_text, pose_graph, write_g2o

FOCAL, HALF, SIGMA, HEIGHT = 153.0, 115.0, 0.005, 1530.0
ROWS, COLUMNS, POINTS = 4, 5, 16
LENGTH_SIGMA = 0.3
SIGNS = np.array([1.0, -1.0, -1.0])
EDGES = [
    (i, j)
    for i in range(ROWS * COLUMNS)
    for j in range(i + 1, ROWS * COLUMNS)
    if max(abs(i // COLUMNS - j // COLUMNS), abs(i % COLUMNS - j % COLUMNS)) == 1
]
NAMES = [f"photo {k:02d}" for k in range(ROWS * COLUMNS)]


class Flown(NamedTuple):
    """True rotations (object to camera) and centres; of every edge the measured places
    on both photos (y down) and the measured length of the base."""

    rotations: np.ndarray
    centres: np.ndarray
    one: np.ndarray
    other: np.ndarray
    lengths: np.ndarray


def fly(seed):
    """A block of 20 photos with 60 % and 40 % overlap. Every pair has its own points and
    its own errors, so that all edges are independent."""
    from scipy.spatial.transform import Rotation

    rng = np.random.default_rng(seed)
    side = 2 * HALF * HEIGHT / FOCAL
    k = np.arange(ROWS * COLUMNS)
    plan = np.column_stack(
        [k % COLUMNS * 0.4 * side, k // COLUMNS * 0.6 * side, np.full(len(k), HEIGHT)]
    )
    centres = plan + rng.normal(0, 15.0, plan.shape)
    turns = Rotation.from_rotvec(rng.normal(0, 0.02, (len(k), 3))).as_matrix()
    rotations = SIGNS[:, None] * turns
    one, other = np.zeros((2, len(EDGES), POINTS, 2))
    for e, (i, j) in enumerate(EDGES):
        middle = (centres[i] + centres[j])[:2] / 2
        at = middle + rng.uniform(-0.5, 0.5, (2000, 2)) * side
        points = np.column_stack([at, rng.uniform(-100, 100, len(at))])
        seen = []
        for photo in (i, j):
            inside = (points - centres[photo]) @ rotations[photo].T
            seen.append(FOCAL * inside[:, :2] / inside[:, 2:])
        there = np.all(np.abs(np.concatenate(seen, axis=1)) < HALF, axis=1)
        rows = np.flatnonzero(there)[:POINTS]
        noise = rng.normal(0, SIGMA, (2, POINTS, 2))
        one[e], other[e] = seen[0][rows] + noise[0], seen[1][rows] + noise[1]
    ends = np.array(EDGES)
    true = np.linalg.norm(centres[ends[:, 1]] - centres[ends[:, 0]], axis=1)
    lengths = true + rng.normal(0, LENGTH_SIGMA, len(true))
    return Flown(rotations, centres, one, other, lengths)


def oriented_of(flights):
    """All pairs of all flights, oriented at once; the orientation of each flight."""
    one = np.concatenate([f.one for f in flights])
    other = np.concatenate([f.other for f in flights])
    shape = one.shape[:2]
    pairs = jaxro.pair(
        *(jnp.array(a) for a in (one[..., 0], -one[..., 1])),
        *(jnp.array(a) for a in (other[..., 0], -other[..., 1])),
        focal=FOCAL,
        sigma=SIGMA,
    )
    # what the plan of the flight tells is a start
    ends = np.array(EDGES * len(flights)).T
    along = (ends[1] % COLUMNS - ends[0] % COLUMNS) * 0.4
    across = (ends[1] // COLUMNS - ends[0] // COLUMNS) * 0.6
    base = np.stack([along, across]) / np.hypot(along, across)
    one, zero = jnp.ones(shape[0]), jnp.zeros(shape[0])
    plan = jaxro.RelativePose(
        one, zero, zero, zero, jnp.array(base[0]), jnp.array(base[1]), zero
    )
    orient = lambda pair, start: jaxro.orient(pair, start=start)
    found = jax.jit(jax.vmap(orient))(pairs, plan)
    found = jax.tree.map(np.asarray, found)
    own = lambda k: slice(k * len(EDGES), (k + 1) * len(EDGES))
    return [jax.tree.map(lambda a, k=k: a[own(k)], found) for k in range(len(flights))]


def graph_of(flown, oriented, tangent=tangents.g2o, **rest):
    left, right = ([NAMES[k] for k in side] for side in zip(*EDGES, strict=True))
    lengths = {"lengths": flown.lengths, "length_deviations": LENGTH_SIGMA} | rest
    return pose_graph(left, right, oriented, sigma0=1.0, tangent=tangent, **lengths)


def freedom(graph):
    return 6 * (len(graph.left) - len(graph.photos) + 1)


def by_gtsam(folder, graph, information=None):
    """Sum of squares and poses that GTSAM finds, reading the file itself;
    `information`: of all edges in place of what the file says."""
    gtsam = pytest.importorskip("gtsam")
    write_g2o(folder / "graph.g2o", graph)
    factors, start = gtsam.readG2o(str(folder / "graph.g2o"), True)
    assert factors.size() == len(graph.left) and start.size() == len(graph.photos)
    if information is not None:
        model = gtsam.noiseModel.Gaussian.Information(information)
        of_file, factors = factors, gtsam.NonlinearFactorGraph()
        for k in range(of_file.size()):
            f = of_file.at(k)
            ends = f.keys()
            factors.add(gtsam.BetweenFactorPose3(ends[0], ends[1], f.measured(), model))
    fixed = gtsam.NonlinearFactorGraph(factors)
    fixed.add(gtsam.NonlinearEqualityPose3(0, start.atPose3(0)))
    solver = gtsam.LevenbergMarquardtOptimizer(
        fixed, start, gtsam.LevenbergMarquardtParams()
    )
    found = solver.optimize()
    poses = [found.atPose3(k).matrix() for k in range(len(graph.photos))]
    return 2 * factors.error(found), np.array(poses)


def by_scipy(text):
    """The same of the text of a graph in the words of g2o, in plain NumPy: parsed,
    minimised from its vertices, errors as g2o defines them."""
    from scipy.optimize import least_squares
    from scipy.spatial.transform import Rotation

    vertices, edges, fixed = {}, [], []
    for line in text.splitlines():
        word, *rest = line.split()
        if word == "VERTEX_SE3:QUAT":
            vertices[int(rest[0])] = np.array(rest[1:], float)
        elif word == "EDGE_SE3:QUAT":
            edges.append((int(rest[0]), int(rest[1]), np.array(rest[2:], float)))
        elif word == "FIX":
            fixed.append(int(rest[0]))
    one, other = (np.array([e[k] for e in edges]) for k in range(2))
    measured = np.array([e[2][:7] for e in edges])
    upper = np.triu_indices(6)
    roots = []
    for _, _, numbers in edges:
        full = np.zeros((6, 6))
        full[upper] = numbers[7:]
        full = full + full.T - np.diag(np.diagonal(full))
        values, vectors = np.linalg.eigh(full)
        assert values[0] > -1e-9 * values[-1]
        roots.append((vectors * np.sqrt(np.maximum(values, 0))).T)
    roots, z = np.array(roots), Rotation.from_quat(measured[:, 3:])
    free = np.array([k for k in sorted(vertices) if k not in fixed])
    start = np.array([vertices[k] for k in sorted(vertices)])

    def residuals(x):
        steps = np.zeros((len(start), 6))
        steps[free] = x.reshape(-1, 6) * np.array([1.0] * 3 + [1e-3] * 3)
        turns = Rotation.from_quat(start[:, 3:]) * Rotation.from_rotvec(steps[:, 3:])
        places = start[:, :3] + steps[:, :3]
        inverse = turns[one].inv()
        between = inverse.apply(places[other] - places[one])
        turn = (z.inv() * inverse * turns[other]).as_quat(canonical=True)[:, :3]
        error = np.column_stack([z.inv().apply(between - measured[:, :3]), turn])
        return np.einsum("eij,ej->ei", roots, error).ravel()

    found = least_squares(residuals, np.zeros(6 * len(free)), method="trf")
    return 2 * found.cost


def errors(flown, poses):
    """Root mean square errors of places and angles, the first photo where it is."""
    from scipy.spatial.transform import Rotation

    turn = flown.rotations[0].T @ poses[0, :3, :3].T
    places = (poses[:, :3, 3] - poses[0, :3, 3]) @ turn.T + flown.centres[0]
    turns = flown.rotations @ (turn @ poses[:, :3, :3])
    angles = Rotation.from_matrix(turns[1:]).as_rotvec()
    off = places[1:] - flown.centres[1:]
    return np.sqrt(np.mean(off**2)), np.sqrt(np.mean(angles**2))


def mean_weights(graph):
    """One information for all edges: the identity, in units of the mean variance of
    rotations and of translations; in the order of GTSAM."""
    covariances = np.linalg.inv(graph.information)
    variances = np.mean(np.diagonal(covariances, axis1=1, axis2=2), axis=0)
    translation, rotation = np.mean(variances[:3]), np.mean(variances[3:])
    return np.diag([1 / rotation] * 3 + [1 / translation] * 3)


def optimised(folder, seeds):
    """Of many graphs, with their own information, the identity, and the mean weights:
    sums of squares, and errors of places and angles."""
    flights = [fly(seed) for seed in seeds]
    rows = []
    for flown, oriented in zip(flights, oriented_of(flights), strict=True):
        graph = graph_of(flown, oriented, tangents.g2o_angles)
        assert np.all(oriented.usable) and freedom(graph) == 216
        for information in (None, np.eye(6), mean_weights(graph)):
            chi, poses = by_gtsam(folder, graph, information)
            rows.append([chi, *errors(flown, poses)])
    return np.array(rows).reshape(len(flights), 3, 3)


def check(found, least):
    """What must hold of the graphs. Weights of one size for all edges are no measure of
    misfit, and cost accuracy."""
    from scipy.stats import chi2, norm

    graphs, degrees = len(found), 216
    p = chi2.cdf(found[:, 0, 0], degrees)
    inside = np.mean((p > 0.025) & (p < 0.975))
    assert inside > least
    z = (np.sum(found[:, 0, 0]) / graphs - degrees) / np.sqrt(2 * degrees / graphs)
    assert abs(z) < norm.ppf(0.9995)
    # the identity in metres and radians: the sum says nothing
    assert np.all(found[:, 1, 0] < 0.1 * degrees)
    own, plain, mean = (np.sqrt(np.mean(found[:, k] ** 2, axis=0)) for k in range(3))
    assert plain[1] > 20 * own[1] and plain[2] > 20 * own[2]
    assert 1.5 < mean[1] / own[1] < 5 and 1.5 < mean[2] / own[2] < 5
    p = chi2.cdf(found[:, 2, 0], degrees)
    assert np.mean((p > 0.025) & (p < 0.975)) < 0.8
    return inside, z, own, plain, mean


@pytest.mark.slow
def test_sums_of_squares_of_some_graphs(tmp_path):
    check(optimised(tmp_path, range(12)), 0.7)


@pytest.mark.slow
def test_sums_of_squares_of_200_graphs(tmp_path):
    """95 % of 200 graphs are within their interval of 95 %, to 1.5 % each way."""
    from scipy.stats import binom

    least = binom.ppf(0.001, 200, 0.95) / 200
    check(optimised(tmp_path, range(1000, 1200)), least)


def test_the_file_is_what_g2o_defines(tmp_path):
    """A plain solution of the text in g2o's words has the sum of squares that GTSAM has
    of the file for its reader; GTSAM takes g2o's own file for something else."""
    flown = fly(77)
    (oriented,) = oriented_of([flown])
    graph = graph_of(flown, oriented)
    text = g2o_text(graph)
    plain = by_scipy(text)
    degrees = freedom(graph)
    assert abs(plain - degrees) < 4 * np.sqrt(2 * degrees)
    own, _ = by_gtsam(tmp_path, graph_of(flown, oriented, tangents.g2o_angles))
    assert plain == pytest.approx(own, rel=1e-3)
    wrong, _ = by_gtsam(tmp_path, graph)
    assert wrong > 1.5 * own
    names = [line.split(" ", 2)[2] for line in text.splitlines() if line[0] == "#"]
    assert names == NAMES


@pytest.mark.slow
def test_lengths_that_nothing_tells():
    """Without lengths the information is zero along each base: the sum of squares is
    that of rotations and directions, whatever lengths are written."""
    flown = fly(3)
    (oriented,) = oriented_of([flown])
    expected = 5 * len(EDGES) - 6 * (len(NAMES) - 1) + 1
    sums = []
    for scale in (1.0, 1.02):
        unknown = {"lengths": scale * flown.lengths, "length_deviations": np.inf}
        graph = graph_of(flown, oriented, **unknown)
        values = np.linalg.eigvalsh(graph.information)
        assert np.all(np.abs(values[:, 0]) < 1e-4) and np.all(values[:, 1] > 1)
        sums.append(by_scipy(g2o_text(graph)))
    assert abs(sums[0] - expected) < 4 * np.sqrt(2 * expected)
    assert sums[1] == pytest.approx(sums[0], rel=0.05)


def test_wide_lengths_are_as_good_as_none(tmp_path):
    """GTSAM finds with lengths of a wide deviation what the plain solution finds without
    any; of matrices that lack rank it makes something else."""
    flown = fly(3)
    (oriented,) = oriented_of([flown])
    some = np.arange(len(EDGES)) % 9 == 0
    with_unknown = lambda unknown, tangent: graph_of(
        flown,
        oriented,
        tangent,
        length_deviations=np.where(some, LENGTH_SIGMA, unknown),
    )
    expected = by_scipy(g2o_text(with_unknown(np.inf, tangents.g2o)))
    wide = with_unknown(UNKNOWN * flown.lengths, tangents.g2o_angles)
    assert by_gtsam(tmp_path, wide)[0] == pytest.approx(expected, rel=1e-3)
    lacking = with_unknown(np.inf, tangents.g2o_angles)
    assert by_gtsam(tmp_path, lacking)[0] > 1.5 * expected


def test_parts_failures_and_bad_graphs():
    """Two parts without a common photo have a fixed photo each; pairs that are not
    usable have no edge; names stay with their photos."""
    flown = fly(5)
    (oriented,) = oriented_of([flown])
    three = jax.tree.map(lambda a: a[:3], oriented)
    failed = np.asarray(jaxro.RESULTS.diverged._value)
    results = np.where([False, False, True], failed, three.result._value)
    three = eqx.tree_at(lambda o: o.result._value, three, results)
    left, right = ["b", "z", "m"], ["a", "y", "n"]
    graph = pose_graph(left, right, three, 100.0, 1.0, sigma0=1.0)
    assert graph.photos == ("a", "b", "y", "z")
    assert [graph.photos[k] for k in graph.left] == ["b", "z"]
    assert [graph.photos[k] for k in graph.right] == ["a", "y"]
    assert [graph.photos[k] for k in graph.fixed] == ["a", "y"]
    # the vertices are where the edges say
    for k, (i, j) in enumerate(zip(graph.left, graph.right, strict=True)):
        one, other = graph.poses[i], graph.poses[j]
        between = one[:, :3].T @ other
        between[:, 3] -= one[:, :3].T @ one[:, 3]
        np.testing.assert_allclose(between, graph.measured[k], atol=1e-9)
        assert np.linalg.norm(graph.measured[k, :, 3]) == pytest.approx(100.0)
    with pytest.raises(ValueError, match="no pair is usable"):
        pose_graph(["a"] * 3, ["a"] * 3, three, 100.0, 1.0, sigma0=1.0)


@pytest.mark.slow
def test_lengths_by_common_points():
    """Their errors are what their deviations say; pairs that share no point with others
    have no length."""
    left, right, pairs, points, found, rms = lengths_of(0)
    assert 0.6 < rms < 1.5
    own = [f"{k}" for k in range(len(points))]
    alone = exchange.base_lengths(left, right, pairs, own, found, sigma0=1.0)
    assert np.all(np.isinf(alone.deviation)) and np.all(alone.length == 1)


@pytest.mark.slow
def test_lengths_of_many_blocks():
    rms = np.array([lengths_of(seed)[-1] for seed in range(10, 20)])
    assert 0.85 < np.sqrt(np.mean(rms**2)) < 1.15


def lengths_of(seed):
    """The pairs of a block, their orientations, and by how many standard deviations
    (root mean square) the lengths of their bases are wrong."""
    mock = block.mock_block(seed, block.Flight(strips=3, models=4))
    left, right, pairs, points = block.pairs_of(mock.block, seed)
    oriented = jaxro.orient_ragged(pairs)
    found = exchange.base_lengths(left, right, pairs, points, oriented, sigma0=1.0)
    number = {name: k for k, name in enumerate(mock.block.photos)}
    ends = np.array([[number[n] for n in side] for side in (left, right)])
    bases = mock.photos.centres[ends[1]] - mock.photos.centres[ends[0]]
    off = np.log(found.length / np.linalg.norm(bases, axis=1))
    off -= np.mean(off)
    rms = np.sqrt(np.mean((off / (found.deviation / found.length)) ** 2))
    return left, right, pairs, points, oriented, rms
