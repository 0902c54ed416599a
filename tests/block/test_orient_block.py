"""Strips and blocks: a published bundle, a dense adjustment in NumPy, simulation."""

import itertools
import sys

import numpy as np
import pytest
from oracles_block import dense_cofactor, find_rays, with_wrong_rays

from jaxro import block
from jaxro.adjustment import RESULTS
from jaxro.batches.ragged import Ragged, orient_ragged
from jaxro.block.adjust import adjust_block
from jaxro.block.adjust_chained import start_from
from jaxro.block.chain import Chained
from jaxro.block.measured_block import MeasuredBlock, add_rays
from jaxro.block.orient_block import orient_block
from jaxro.block.wrong import normalise_residuals


def read(file):
    """The rows of a text table without its comments."""
    lines = file.read_text(encoding="utf-8").splitlines()
    rows = [line.split(",") for line in lines if line.strip() and line[0] != "#"]
    return [[entry.strip() for entry in row] for row in rows]


def all_pairs(measured, fewest=8):
    """The pairs of all photos with common points."""
    at = [
        {measured.point[ray]: ray for ray in np.flatnonzero(measured.photo == k)}
        for k in range(len(measured.photos))
    ]
    left, right, rows, begins = [], [], [], [0]
    for i, j in itertools.combinations(range(len(at)), 2):
        common = [point for point in at[i] if point in at[j]]
        if len(common) >= fewest:
            rows += [(at[i][point], at[j][point]) for point in common]
            left.append(measured.photos[i])
            right.append(measured.photos[j])
            begins.append(len(rows))
    one, other = np.array(rows).T
    of_pairs = lambda focal: np.full(len(left), focal)
    pairs = Ragged(
        np.array(begins),
        measured.x[one],
        measured.y[one],
        measured.x[other],
        measured.y[other],
        measured.sigma[one],
        np.ones(len(one), bool),
        of_pairs(measured.focal[0]),
        of_pairs(measured.focal[0]),
    )
    return left, right, pairs, [measured.points[k] for k in measured.point[one]]


@pytest.fixture(scope="module")
def strasbourg(data):
    """Five aerial photos with 381 points (Börlin and Grussenmeyer, DBAT), all places in
    mm, control in metres about its middle; published stations with deviations."""
    folder = data / "strasbourg_block"
    rows = read(folder / "script_markpts.txt") + read(folder / "script_smartpts.txt")
    names, point = np.unique([row[0] for row in rows], return_inverse=True)
    pixels = np.array([row[2:4] for row in rows], float)
    measured = MeasuredBlock(
        photos=("8811", "8936", "8937", "8938", "9111"),
        points=tuple(str(name) for name in names),
        photo=np.array([int(row[1]) - 1 for row in rows]),
        point=point,
        x=pixels[:, 0] * 0.006 - 26.577,
        y=38.811 - pixels[:, 1] * 0.006,
        sigma=np.full(len(rows), 0.006),
        focal=np.full(5, 123.939),
    )
    control = read(folder / "ctrlpts-weighted.txt")
    at = np.array([row[2:5] for row in control], float)
    known = block.ground(
        [row[0] for row in control], at - at.mean(0), np.array([0.02, 0.02, 0.04])
    )
    published = np.genfromtxt(
        folder / "published_eo.csv", delimiter=",", skip_header=1
    )[:, 1:]
    return measured, known, published


@pytest.mark.slow
def test_a_published_block(strasbourg):
    """From its pairs alone, without start values. The published program has one point
    with a single ray and shifts the control by an amount that is not published."""
    measured, known, published = strasbourg
    left, right, pairs, points = all_pairs(measured)
    oriented = orient_block(left, right, pairs, points, known, more=measured)
    found = oriented.adjusted
    assert oriented.placed is not None and not np.any(oriented.placed.wrong)
    # nothing is left out in the published adjustment
    found = adjust_block(measured, found.as_start, known)
    assert found.degrees_of_freedom == 1267
    np.testing.assert_allclose(found.sigma0, 1.07447, atol=1e-5)
    shift = found.centres - published[:, :3]
    np.testing.assert_allclose(shift - shift.mean(0), 0, atol=1e-3)
    np.testing.assert_allclose(np.degrees(found.angles), published[:, 3:6], atol=1e-4)
    np.testing.assert_allclose(found.centre_deviations, published[:, 6:9], rtol=5e-3)
    np.testing.assert_allclose(
        np.degrees(found.angle_deviations), published[:, 9:12], rtol=5e-3
    )
    w = np.nanmax(np.abs(normalise_residuals(found).control), axis=1)
    first = int(np.argmax(w))
    assert known.points[first] == "410" and 4.5 < w[first] < 4.9


def test_a_strip_is_that_of_a_dense_adjustment():
    """Estimates, deviations and redundancy in NumPy, derivatives by differences."""
    mock = block.mock_block(1, block.Flight(models=3))
    measured, known = mock.block, mock.ground
    start = start_from(measured, mock.photos)
    found = adjust_block(measured, start, known)
    q = dense_cofactor(found)
    photos = len(measured.photos)
    own = np.sqrt(np.diagonal(q)[: 6 * photos].reshape(photos, 6)[:, 3:])
    np.testing.assert_allclose(found.centre_deviations, found.sigma0 * own, rtol=1e-5)
    seen = found.numbered.number >= 0
    own = np.sqrt(np.diagonal(q)[6 * photos :].reshape(-1, 3))
    np.testing.assert_allclose(found.deviations[seen], found.sigma0 * own, rtol=1e-5)
    white = found.residuals / measured.sigma[:, None]
    of_control = found.control_residuals / known.sigma
    squares = np.nansum(white**2) + np.nansum(of_control**2)
    np.testing.assert_allclose(
        found.sigma0, np.sqrt(squares / found.degrees_of_freedom), rtol=1e-9
    )
    redundancy = np.nansum(found.redundancy) + np.nansum(found.control_redundancy)
    np.testing.assert_allclose(redundancy, found.degrees_of_freedom, rtol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("flight", [(3, 8), (1, 30)])
def test_from_pairs_in_any_order_to_the_truth(flight):
    """Strip and block: stations and points within their deviations."""
    strips, models = flight
    mock = block.mock_block(2, block.Flight(strips=strips, models=models))
    left, right, pairs, points = block.pairs_of(mock.block, seed=5)
    oriented = orient_block(left, right, pairs, points, mock.ground)
    found = oriented.adjusted
    place = [mock.block.photos.index(name) for name in found.block.photos]
    z = (found.centres - mock.photos.centres[place]) / found.centre_deviations
    assert np.max(np.abs(z)) < 4.5 and np.sqrt(np.mean(z**2)) < 1.8
    assert 0.9 < found.sigma0 < 1.1
    assert np.sum(oriented.wrong.rays) <= 2


@pytest.mark.slow
@pytest.mark.parametrize("share", [0.05, 0.2])
def test_wrong_ties_are_found(share):
    """From the pairs alone."""
    mock = block.mock_block(3, block.Flight(strips=3, models=8))
    measured, bad = with_wrong_rays(mock, 3, share)
    left, right, pairs, points = block.pairs_of(measured)
    oriented = orient_block(left, right, pairs, points, mock.ground)
    found = oriented.adjusted.check()
    assert oriented.wrong.settled and 0.93 < found.sigma0 < 1.07
    left_in = find_rays(found.block, measured, bad) & found.numbered.rays
    assert np.sum(left_in) < 0.1 * np.sum(bad)
    place = [mock.block.photos.index(name) for name in found.block.photos]
    z = (found.centres - mock.photos.centres[place]) / found.centre_deviations
    assert np.max(np.abs(z)) < 4.5


def test_control_of_another_system_is_not_left_out_silently():
    """X and Y exchanged: the photos contradict all of it."""
    mock = block.mock_block(3, block.Flight(strips=2, models=4))
    at = mock.ground.coordinates[:, [1, 0, 2]]
    start = start_from(mock.block, mock.photos)
    with pytest.raises(
        block.TooLittleControl, match="known coordinates fit the photos"
    ):
        block.adjust_without_wrong(
            block.Given(mock.block, mock.ground._replace(coordinates=at)), start
        )


def test_swapped_names_of_control_are_found_before_the_adjustment():
    mock = block.mock_block(4, block.Flight(strips=2, models=10))
    names = list(mock.ground.points)
    names[1], names[6] = names[6], names[1]
    swapped = mock.ground._replace(points=tuple(names))
    placed = block.place(mock.block, mock.photos, swapped)
    assert np.flatnonzero(placed.wrong).tolist() == [1, 6]


@pytest.mark.slow
def test_parts_without_a_common_scale_are_refused():
    """Points in the middle of a strip are on two photos at most."""
    mock = block.mock_block(5, block.Flight(models=10))
    measured = mock.block
    name = np.array([int(n.split("-")[1]) for n in measured.photos])
    late = np.zeros(len(measured.points), bool)
    late[measured.point[name[measured.photo] > 6]] = True
    early = np.zeros(len(measured.points), bool)
    early[measured.point[name[measured.photo] < 6]] = True
    both = (late & early)[measured.point]
    left, right, pairs, points = block.pairs_of(measured.without(both), fewest=5)
    with pytest.raises(block.Unjoined, match="no scale joins the photos"):
        orient_block(left, right, pairs, points, mock.ground)


def test_too_little_control_is_refused():
    mock = block.mock_block(6)
    few = block.ground(mock.ground.points[:2], mock.ground.coordinates[:2], 0.02)
    with pytest.raises(block.TooLittleControl, match="Fewer than seven"):
        block.place(mock.block, mock.photos, few)


def test_control_on_a_line_is_refused():
    """Within its errors: of five tie points, moved onto a line with all their rays."""
    mock = block.mock_block(6)
    rng = np.random.default_rng(6)
    chained = mock.photos
    line = np.linspace([500.0, 100.0, 20.0], [8000.0, 300.0, 60.0], 5)
    measured, names = mock.block, mock.block.points[:5]
    rays = np.flatnonzero(measured.point < 5)
    apart = line[measured.point[rays]] - chained.centres[measured.photo[rays]]
    inside = np.einsum("rij,rj->ri", chained.rotations[measured.photo[rays]], apart)
    x, y = measured.x.copy(), measured.y.copy()
    x[rays] = 153 * inside[:, 0] / inside[:, 2]
    y[rays] = -153 * inside[:, 1] / inside[:, 2]
    known = block.ground(names, line + rng.normal(0, 0.02, (5, 3)), 0.02)
    with pytest.raises(block.TooLittleControl, match="on one line"):
        block.place(measured._replace(x=x, y=y), chained, known)


@pytest.mark.parametrize("models", [3, pytest.param(8, marks=pytest.mark.slow)])
def test_a_free_network_determines_all_but_its_datum(models):
    """Four photos, and nine, for which there is no exact room."""
    mock = block.mock_block(7, block.Flight(models=models))
    chained = Chained(mock.photos.rotations, mock.photos.centres)
    free = adjust_block(mock.block, start_from(mock.block, chained))
    assert free.adjustment.result == RESULTS.successful
    count = free.numbered.number.max() + 1
    rays = int(np.sum(free.numbered.rays))
    photos = models + 1
    assert free.degrees_of_freedom == 2 * rays - 6 * photos - 3 * count + 7
    w = free.residuals / mock.block.sigma[:, None]
    squares = np.nansum(w**2) / free.degrees_of_freedom
    np.testing.assert_allclose(free.sigma0**2, squares, rtol=1e-9)
    redundancy = np.nansum(free.redundancy)
    np.testing.assert_allclose(redundancy, free.degrees_of_freedom, rtol=1e-7)


@pytest.mark.slow
@pytest.mark.parametrize("flight", [(1, 10), (5, 10)])
def test_intervals_of_photos_and_points_hold_the_truth(flight):
    """200 strips, 200 blocks; and the ellipsoids of the points."""
    strips, models = flight
    photos, points, ellipsoids = [], [], []
    for seed in range(200):
        mock = block.mock_block(1000 + seed, block.Flight(strips=strips, models=models))
        found = adjust_block(
            mock.block, start_from(mock.block, mock.photos), mock.ground
        )
        apart = np.abs(found.centres - mock.photos.centres)
        photos.append(np.mean(apart < 1.96 * found.centre_deviations))
        seen = found.numbered.number >= 0
        apart = (found.coordinates - mock.points)[seen]
        points.append(np.mean(np.abs(apart) < 1.96 * found.deviations[seen]))
        weights = np.linalg.inv(found.point_covariances[seen])
        squares = np.einsum("pi,pij,pj->p", apart, weights, apart)
        ellipsoids.append(np.mean(squares < 7.815))
    for share in (photos, points, ellipsoids):
        assert 0.94 < np.mean(share) < 0.96


@pytest.mark.slow
@pytest.mark.parametrize(("moved", "new"), [(0.0, 0), (0.02, 0), (0.5, 1)])
def test_a_place_is_one_measurement_however_it_comes_in(moved, new):
    """Shared by pairs, or once more as a ray; `moved` standard deviations, it is one as
    long as that is a small part."""
    measured = block.mock_block(3, block.Flight(models=3)).block
    left, right, pairs, points = block.pairs_of(measured)
    random = np.random.default_rng(3)
    shift = lambda a: a + moved * 0.7 * pairs.sigma * random.choice([-1, 1], len(a))
    pairs = pairs._replace(x_left=shift(pairs.x_left), y_right=shift(pairs.y_right))
    found = block.from_pairs(left, right, pairs, points)
    seen = len(set(zip(measured.photo, measured.point, strict=True)))
    assert (len(found.photo) > seen) == bool(new)
    at = np.stack([found.x, found.y], axis=1) + moved * found.sigma[:, None]
    names = (
        [found.photos[k] for k in found.photo],
        [found.points[k] for k in found.point],
    )
    more = add_rays(found, *names, at, found.sigma)
    assert (len(more.photo) > len(found.photo)) == bool(new)
    np.testing.assert_array_equal(more.x[: len(found.x)], found.x)


@pytest.mark.slow
def test_swapped_names_in_a_hundred_blocks():
    """Chained from their pairs, without wrong ties."""
    hits = 0
    for seed in range(100):
        mock = block.mock_block(2000 + seed, block.Flight(strips=5, models=10))
        rng = np.random.default_rng(seed)
        names, swapped = (
            list(mock.ground.points),
            rng.choice(len(mock.ground.points), 2),
        )
        if swapped[0] == swapped[1]:
            swapped[1] = (swapped[0] + 1) % len(names)
        i, j = swapped
        names[i], names[j] = names[j], names[i]
        left, right, pairs, points = block.pairs_of(mock.block, seed)
        measured = block.from_pairs(left, right, pairs, points)
        number = {name: k for k, name in enumerate(measured.photos)}
        ends = (np.array([number[name] for name in end]) for end in (left, right))
        chained = block.chain(measured, block.models_of(*ends, orient_ragged(pairs)))
        ground = mock.ground._replace(points=tuple(names))
        placed = block.place(measured, chained, ground)
        hits += np.flatnonzero(placed.wrong).tolist() == sorted((i, j))
    assert hits >= 95


def with_names_moved(given, own, step):
    """Each place of a photo has the name of the row before, or of the next one."""
    point = given.point.copy()
    own = own[np.argsort([given.points[k] for k in point[own]])]
    point[own] = np.roll(point[own], step)
    return given._replace(point=point)


def with_y_downwards(given, own):
    y = given.y.copy()
    y[own] = -y[own]
    return given._replace(y=y)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("names_moved", lambda *some: with_names_moved(*some, 1)),
        ("names_moved", lambda *some: with_names_moved(*some, -1)),
        ("photo_mirrored", with_y_downwards),
    ],
)
def test_a_photo_that_is_wrong_as_a_whole_is_named(name, change):
    """And the block adjusted as it would be right."""
    mock = block.mock_block(5, block.Flight(models=4), control_every=2)
    given = mock.block
    own = np.flatnonzero(given.photo == 2)
    found = orient_block(*block.pairs_of(change(given, own)), mock.ground)
    assert found.cause is not None and found.cause.name == name
    assert given.photos[2] in found.cause.sentence
    adjusted = found.adjusted
    assert adjusted.result == RESULTS.successful and not np.any(found.wrong.rays[own])


@pytest.mark.slow
@pytest.mark.parametrize(
    "row, axis, error, cause, told",
    [
        pytest.param(0, 2, 5.0, "confusable", 4, marks=pytest.mark.slow),
        (2, 2, 20.0, "confusable", 4),
        pytest.param(1, 2, 50.0, "known_point", 2, marks=pytest.mark.slow),
        pytest.param(1, 0, 50.0, "known_point", 1, marks=pytest.mark.slow),
    ],
)
def test_one_of_four_known_points_is_told_as_far_as_it_can_be(
    row: int, axis: int, error: float, cause: str, told: int
):
    """The twist of four heights in the corners is one misclosure, which each of them
    explains; in plan one stands out."""
    mock = block.mock_block(2, block.Flight(models=4), control_every=4)
    at = mock.ground.coordinates.copy()
    assert len(at) == 4
    at[row, axis] += error
    corners = mock.ground._replace(coordinates=at)
    found = orient_block(*block.pairs_of(mock.block), corners)
    assert found.cause is not None and found.cause.name == cause
    named = [name for name in mock.ground.points if name in found.cause.sentence]
    assert mock.ground.points[row] in named and len(named) == told


@pytest.mark.slow
def test_one_of_many_known_points_is_left_out():
    more = block.mock_block(2, block.Flight(models=4), control_every=1)
    at = more.ground.coordinates.copy()
    at[3, 2] += 50
    found = orient_block(
        *block.pairs_of(more.block), more.ground._replace(coordinates=at)
    )
    assert not found.contradictions and found.cause is None
    assert np.flatnonzero(np.any(found.wrong.control, axis=1)).tolist() == [3]


@pytest.mark.slow
def test_the_sign_of_a_coordinate_on_two_photos_throws_no_block_off():
    """The rays meet behind the photos: the point is lost, and nothing else."""
    mock = block.mock_block(5, block.Flight(models=4), control_every=2)
    given = mock.block
    photos = np.bincount(given.point)
    names = np.array(given.points)[given.point]
    ties = np.flatnonzero((photos[given.point] == 2) & (np.char.find(names, "t") == 0))
    ray = ties[np.argmax(np.abs(given.x[ties]))]
    x = given.x.copy()
    x[ray] = -x[ray]
    found = orient_block(*block.pairs_of(given._replace(x=x)), mock.ground)
    assert found.adjusted.result == RESULTS.successful and found.wrong.settled
    block_of = found.adjusted.block
    out = {block_of.points[k] for k in block_of.point[found.wrong.rays]}
    assert names[ray] in out and len(out) <= 2


@pytest.mark.slow
@pytest.mark.parametrize(
    ("change", "said"),
    [
        (
            lambda p: p._replace(sigma=p.sigma / 20),
            "times the standard deviations that are given",
        ),
        (
            lambda p: p._replace(
                focal_left=p.focal_left / 1e3, focal_right=p.focal_right / 1e3
            ),
            "is the focal length in the unit of the coordinates",
        ),
    ],
)
def test_why_nothing_joins_the_photos_is_told(change, said, monkeypatch):
    def refuse(measured, _):
        raise block.Unjoined([measured.photos[-1]])

    monkeypatch.setattr(sys.modules[orient_block.__module__], "chain", refuse)
    mock = block.mock_block(4, block.Flight(models=3))
    left, right, pairs, points = all_pairs(mock.block)
    with pytest.raises(block.Unjoined, match=said):
        orient_block(left, right, change(pairs), points, mock.ground)
