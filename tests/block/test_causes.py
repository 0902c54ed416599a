"""Whole columns that are wrong, in blocks: by simulation, the chain being the truth."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tiers import seldom

from jaxro import block
from jaxro.block import absolute_causes
from jaxro.block.adjust_chained import adjust_chained
from jaxro.block.bars import bars
from jaxro.block.columns import alter
from jaxro.block.contest import is_misplaced
from jaxro.block.contradictions import (
    contradictions,
    is_suspicious,
    stands_under_ground,
)
from jaxro.block.exchanged import find_exchanged
from jaxro.block.orient_block import adjust_and_judge
from jaxro.block.photos import find_copies, find_held
from jaxro.block.wrong_points import decide

FOOT = 0.3048
PLACE = np.array([435_000.0, 4_566_000.0, 0.0])
"""Where the block lies."""


def strip(seed=3, stations=False, relief=60.0):
    """A strip with its control, and its stations, on the ground."""
    flight = block.Flight(models=6, relief=relief)
    mock = block.mock_block(seed, flight, control_every=2)
    names, at = list(mock.ground.points), mock.ground.coordinates + PLACE
    sigma, of_stations = mock.ground.sigma, np.zeros(len(names), bool)
    if stations:
        centres = mock.photos.centres + PLACE
        noise = np.random.default_rng(seed).normal(0, 0.1, centres.shape)
        names += list(mock.block.photos)
        at = np.concatenate([at, centres + noise])
        sigma = np.concatenate([sigma, np.full(centres.shape, 0.1)])
        of_stations = np.append(of_stations, np.ones(len(centres), bool))
    known = block.ground(names, at, sigma, station=of_stations)
    return mock, block.Given(mock.block, known)


def with_coordinates(given, change, rows=None):
    at = given.ground.coordinates.copy()
    rows = np.ones(len(at), bool) if rows is None else rows
    at[rows] = change(at[rows])
    return given._replace(ground=given.ground._replace(coordinates=at))


def cause_of(mock, given):
    """The cause of a block that is not to be used."""
    return adjust_and_judge(given, mock.photos).cause


def in_degrees(at):
    """Longitude, latitude and height of points of a plane that touches the ellipsoid at
    9 and 41 degrees, in the middle of the block: by differences of its equation, inverted
    by Newton's method."""
    square = (2 - 1 / 298.257) / 298.257

    def from_centre(places):
        (east, north), up = np.radians(places[:2]), places[2]
        n = 6_378_137.0 / np.sqrt(1 - square * np.sin(north) ** 2)
        over = (n + up) * np.cos(north)
        z = (n * (1 - square) + up) * np.sin(north)
        return np.array([over * np.cos(east), over * np.sin(east), z])

    middle = np.array([9.0, 41.0, 0.0])
    (lon, lat), origin = np.radians(middle[:2]), from_centre(middle)
    up = np.array([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)])
    east = np.array([-np.sin(lon), np.cos(lon), 0.0])
    axes = np.stack([east, np.cross(up, east), up])
    found = []
    for place in (at - at.mean(axis=0)) * [1, 1, 0] + at * [0, 0, 1]:
        here, steps = middle, np.diag([1e-5, 1e-5, 1.0])
        for _ in range(5):
            slopes = [
                (from_centre(here + d) - from_centre(here - d)) / (2 * d.max())
                for d in steps
            ]
            off = origin + place @ axes - from_centre(here)
            here = here + np.linalg.solve(np.array(slopes).T, off)
        found.append(here)
    return np.array(found)


@pytest.mark.parametrize(
    ("name", "change"),
    seldom(
        [
            ("mirrored", lambda at: at[:, [1, 0, 2]]),
            ("heights_in_feet", lambda at: at / [1, 1, FOOT]),
            ("plan_in_feet", lambda at: at * [1, 1, FOOT]),
            ("heights_equal", lambda at: at * [1, 1, 0]),
            ("degrees", in_degrees),
        ],
        ["mirrored", "heights_in_feet"],
    ),
)
def test_columns_of_control_are_named(name, change):
    mock, given = strip()
    cause = cause_of(mock, with_coordinates(given, change))
    assert cause is not None and cause.name == name


@pytest.mark.parametrize(
    ("name", "change"),
    seldom(
        [
            ("mirrored", lambda at: at[:, [1, 0, 2]]),
            ("heights_in_feet", lambda at: at / [1, 1, FOOT]),
        ],
        ["heights_in_feet"],
    ),
)
def test_columns_of_flat_control_are_named_though_most_of_it_fits(name, change):
    """Heights within some metres: a strip bends until hardly a known point stands out."""
    mock, given = strip(relief=0.0)
    cause = cause_of(mock, with_coordinates(given, change))
    assert cause is not None and cause.name == name


def test_photos_under_the_ground_are_told():
    """Control in a plane fits the mirror image as well."""
    mock, given = strip()
    at = given.ground.coordinates * [1, 1, 0]
    rough = given.ground.sigma * [1, 1, 1e4]
    flat = given._replace(ground=given.ground._replace(coordinates=at, sigma=rough))
    above = adjust_chained(flat, mock.photos).adjusted
    turned = adjust_chained(
        with_coordinates(flat, lambda at: at[:, [1, 0, 2]]), mock.photos
    ).adjusted
    assert not stands_under_ground(above) and stands_under_ground(turned)


@pytest.mark.parametrize(
    ("name", "change"),
    seldom(
        [
            ("stations_shifted", lambda at: at + np.array([0, 0, 45])),
            ("rows_shifted", lambda at: np.roll(at, 1, axis=0)),
        ],
        ["stations_shifted"],
    ),
)
def test_columns_of_stations_are_named(name, change):
    mock, given = strip(stations=True)
    wrong = with_coordinates(given, change, given.ground.station)
    cause = cause_of(mock, wrong)
    assert cause is not None and cause.name == name


def test_a_good_block_has_no_cause():
    """Nor one with a single wrong known point, which is left out by name."""
    mock, given = strip(stations=True)
    digit = given.ground.coordinates.copy()
    digit[4, 0] += 100
    for ground, names in (
        (given.ground, []),
        (given.ground._replace(coordinates=digit), [given.ground.points[4]]),
    ):
        found = adjust_chained(given._replace(ground=ground), mock.photos)
        left_out = np.flatnonzero(np.any(found.wrong.control, axis=1))
        assert [ground.points[k] for k in left_out] == names
        rest = given._replace(ground=ground), found.adjusted, found.wrong
        assert not is_suspicious(*rest) and not contradictions(*rest)
        assert not is_misplaced(rest[0], mock.photos)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("focal", lambda m: m._replace(focal=np.full(len(m.focal), 135.0))),
        ("principal", lambda m: m._replace(x=m.x + 1.5, y=m.y - 0.8)),
        ("sigma", lambda m: m._replace(sigma=m.sigma / 10)),
    ],
)
def test_cameras_and_standard_deviations_are_named(name, change):
    mock, given = strip()
    cause = cause_of(mock, given._replace(block=change(mock.block)))
    assert cause is not None and cause.name == name
    if name == "focal":
        value, deviation = (
            float(word.strip(",")) for word in np.array(cause.sentence.split())[[6, 8]]
        )
        assert abs(value - 153) < 4 * deviation < 4
        assert not cause.is_hint  # points lie elsewhere by many of their deviations


def test_contradictions_are_told_where_no_cause_is_known():
    """Half of the control in another system, by 30 m."""
    mock, given = strip()
    some = np.arange(len(given.ground.points)) % 2 == 0
    wrong = with_coordinates(given, lambda at: at + np.array([30, -20, 0]), some)
    found = adjust_chained(wrong, mock.photos)
    said = contradictions(wrong, found.adjusted, found.wrong)
    assert any("known points fit the photos" in sentence for sentence in said)


@pytest.mark.slow
def test_a_bar_is_judged_by_the_block_without_it():
    """The wrong one of three is left out, and no ray in its place; two that contradict
    each other are both told."""
    mock, given = strip()
    given = given._replace(ground=None)
    at = dict(zip(mock.block.points, mock.points, strict=True))
    ends = [("t20", "t40"), ("t25", "t38"), ("t30", "t46")]
    length = np.array([np.linalg.norm(at[a] - at[b]) for a, b in ends])
    length[0] += 10
    some = lambda rows: bars(
        *zip(*[ends[k] for k in rows], strict=True), length[rows], 0.01
    )
    found = adjust_chained(given._replace(bars=some([0, 1, 2])), mock.photos)
    assert found.wrong.bars.tolist() == [True, False, False]
    assert not np.any(found.wrong.rays)
    off = (
        np.linalg.norm(
            found.adjusted.coordinates[mock.block.points.index("t30")]
            - found.adjusted.coordinates[mock.block.points.index("t46")]
        )
        - length[2]
    )
    assert abs(off) < 0.2
    both = given._replace(bars=some([0, 2]))
    found = adjust_chained(both, mock.photos)
    assert contradictions(both, found.adjusted, found.wrong)


@pytest.mark.slow
def test_a_bar_in_another_unit_is_named_beside_good_numbers():
    """One of three, which is left out; the unit is a hint, as no point moves without the
    bar. A length that no unit explains has no cause."""
    mock, given = strip()
    at = dict(zip(mock.block.points, mock.points, strict=True))
    one, other = ["t20", "t25", "t30"], ["t40", "t38", "t46"]
    length = np.array(
        [np.linalg.norm(at[a] - at[b]) for a, b in zip(one, other, strict=True)]
    )
    for factor, name in ((1000, "bar_unit"), (1.01, None)):
        lengths = bars(one, other, length * [1, factor, 1], 0.05)
        found = adjust_and_judge(given._replace(bars=lengths), mock.photos)
        assert found.outcome.wrong.bars.tolist() == [False, True, False]
        assert not found.contradictions
        assert (found.cause and found.cause.name) == name
        if found.cause is not None:
            assert found.cause.is_hint and "t25-t38 is in millimetres" in (
                found.cause.sentence
            )


def test_rays_that_cannot_be_told_apart_are_left_out_together():
    """A parallax of a point on two photos is in either of them; among four rays the wrong
    one is found."""
    mock, given = strip()
    measured = mock.block
    photos = np.bincount(measured.point, minlength=len(measured.points))
    ties = np.array([name.startswith("t") for name in measured.points])
    found = adjust_chained(given, mock.photos).adjusted
    for number, alone in ((2, False), (3, True)):
        point = int(np.flatnonzero(ties & (photos == number))[2])
        rays = np.flatnonzero(measured.point == point)
        y = measured.y.copy()
        y[rays[0]] += 0.2
        moved = replace(found, block=measured._replace(y=y))
        flagged = np.zeros(len(y), bool)
        flagged[rays[-1]] = True
        out = decide(moved, flagged)
        assert out[rays[0]] and np.sum(out) == (1 if alone else number)


def test_exchanged_points_are_named_beside_good_numbers():
    """Two points that three photos show each; they are left out on one photo."""
    mock, given = strip()
    measured = mock.block
    photos = np.bincount(measured.point, minlength=len(measured.points))
    own = np.flatnonzero((measured.photo == 3) & (photos[measured.point] == 3))
    one, other = own[[1, 4]]
    point = measured.point.copy()
    point[[one, other]] = point[[other, one]]
    given = given._replace(block=measured._replace(point=point))
    found = adjust_and_judge(given, mock.photos)
    names = sorted(measured.points[measured.point[k]] for k in (one, other))
    assert find_exchanged(found.outcome.adjusted) == {tuple(names): ["1-4"]}
    assert found.cause is not None and found.cause.is_hint
    assert all(name in found.cause.sentence for name in (*names, "1-4"))


def test_hypotheses_undo_what_they_name():
    """On numbers alone."""
    rng = np.random.default_rng(1)
    at = PLACE + rng.uniform(0, 1, (8, 3)) * [3000, 2000, 200]
    every = np.ones(8, bool)
    changes = {
        "mirrored": lambda a: a[:, [1, 0, 2]],
        "heights_in_feet": lambda a: a / [1, 1, FOOT],
        "plan_in_feet": lambda a: a * [1, 1, FOOT],
    }
    for name, change in changes.items():
        (right,) = [
            one for one in alter(change(at), every, "points") if one.name == name
        ]
        np.testing.assert_allclose(right.coordinates, at)
    metres = [
        one for one in alter(in_degrees(at), every, "points") if one.name == "degrees"
    ]
    apart = metres[0].coordinates - metres[0].coordinates.mean(axis=0)
    # planes that touch the ellipsoid at places some metres apart differ by a turn
    np.testing.assert_allclose(apart, at - at.mean(axis=0), atol=0.01)


def test_a_photo_under_two_names_and_one_that_a_point_holds_are_told():
    mock, _ = strip()
    measured = mock.block
    own = measured.photo == 2
    twice = measured._replace(
        photos=(*measured.photos, "again"),
        photo=np.append(measured.photo, np.full(np.sum(own), len(measured.photos))),
        focal=np.append(measured.focal, measured.focal[2]),
        **{
            name: np.append(getattr(measured, name), getattr(measured, name)[own])
            for name in ("point", "x", "y", "sigma")
        },
    )
    assert find_copies(measured) == []
    assert find_copies(twice) == [(measured.photos[2], "again")]
    none = np.zeros(len(measured.points), bool), np.zeros(len(measured.photos), bool)
    every = np.ones(len(measured.photo), bool)
    assert find_held(measured, every, *none) == []
    photos = np.bincount(measured.point, minlength=len(measured.points))
    first = np.flatnonzero((measured.photo == 0) & (photos[measured.point] >= 3))
    used = every.copy()
    used[first[1:]] = False
    (held,) = find_held(measured, used, *none)
    assert held == (measured.photos[0], measured.points[measured.point[first[0]]])


@pytest.mark.parametrize(
    ("name", "change"),
    seldom(
        [
            (None, lambda at: at),
            ("heights_in_feet", lambda at: at / [1, 1, FOOT]),
            ("heights_equal", lambda at: at * [1, 1, 0]),
            ("degrees", in_degrees),
            ("rows_shifted", lambda at: np.roll(at, 1, axis=0)),
        ],
        [None, "heights_in_feet"],
    ),
)
def test_columns_of_the_control_of_a_model_are_named(name, change):
    """One model, turned and scaled; of good control, and of one wrong point, no cause is
    named."""
    rng = np.random.default_rng(5)
    at = PLACE + rng.uniform(0, 1, (9, 3)) * [1500, 1000, 80]
    turn = Rotation.from_euler("zyx", [0.4, 0.02, -0.03]).as_matrix()
    inside = (at - at.mean(axis=0)) @ turn.T / 900
    given = change(at + rng.normal(0, 0.03, at.shape))
    measured = block.model(inside, given)
    cause = absolute_causes.find_cause(measured, block.orient_model(measured))
    assert (cause and cause.name) == name
    if name is None:
        given[2, 0] += 40
        measured = block.model(inside, given)
        assert (
            absolute_causes.find_cause(measured, block.orient_model(measured)) is None
        )
