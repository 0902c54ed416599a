"""Tables with a row for each place are tables of pairs."""

import json

import pytest
from bad_tables import write
from command_line import run, words

from jaxro.tables.examples import pair as example

FOCAL = ("--focal", str(example.FOCAL))


def places_of(table, *, right="", left=""):
    """The places of a table of one pair, those of the right photo first; `left`, `right`:
    further cells of their rows."""
    points = [line.split(",") for line in table.strip().splitlines()[1:]]
    rows = [f"B,{name},{x},{y}{right}" for name, _, _, x, y in points]
    return rows + [f"A,{name},{x},{y}{left}" for name, x, y, _, _ in points]


def written(tmp_path, header, rows):
    return write(tmp_path, "\n".join([header, *rows]), "places.csv")


def oriented(table, *more):
    told = run("orient", table, *FOCAL, *more, "--json")
    assert told.exit_code == 0, told.stderr
    (pair,) = json.loads(told.stdout)["pairs"]
    return pair


def test_a_pair_by_its_places_is_the_pair(tmp_path):
    pair = oriented(write(tmp_path, example.TABLE, "pair.csv"))
    rows = places_of(example.TABLE)
    same = oriented(written(tmp_path, "photo,point,x,y", rows))
    assert same.pop("pair") == "A-B" and pair.pop("pair") == "pair"
    assert same == pair


@pytest.mark.parametrize("left", [0.005, pytest.param(0.01, marks=pytest.mark.slow)])
def test_places_have_their_own_deviations(left, tmp_path):
    rows = places_of(example.TABLE, left=f",{left}", right=",0.005")
    found = oriented(written(tmp_path, "photo,point,x,y,sigma", rows))
    points = [line.split(",") for line in example.TABLE.strip().splitlines()]
    names = [f"sigma_{axis}_{side}" for side in ("left", "right") for axis in "xy"]
    head = ",".join([*points[0], *names])
    lines = [",".join([*p, *2 * [str(left)], *2 * ["0.005"]]) for p in points[1:]]
    expected = oriented(write(tmp_path, "\n".join([head, *lines]), "pair.csv"))
    assert found["sigma0"] == pytest.approx(expected["sigma0"], rel=1e-9)
    for name, one in expected["elements"].items():
        assert found["elements"][name]["value"] == pytest.approx(one["value"], rel=1e-9)


def test_photos_without_points_in_common_make_no_pair(tmp_path):
    rows = places_of(example.TABLE)[:7]
    told = run("clean", written(tmp_path, "photo,point,x,y", rows), *FOCAL)
    assert told.exit_code == 2
    assert "found no two of 2 photos with 6 points in common" in told.stderr


@pytest.mark.parametrize(
    ("command", "cells", "camera", "said"),
    [
        ("block", (",a", ",c"), "[camera.a]\nfocal = 3\n[camera.b]\nfocal = 4\n",
         "column camera: found 'c'; expected a camera of"),
        ("block", ("", ""), "[camera.a]\nfocal = 3\n",
         "column camera: found no such column"),
        ("block", (",a", ",a"), "[photo.A]\nfocal = 3\n[photo.B]\nfocal = 4\n",
         "found 'a' for photos with different entries in --camera"),
        ("clean", (",a", ",b"), "[camera.a]\nfocal = 3\n[camera.b]\nfocal = 4\n",
         "found cameras by names of their own"),
    ],
)  # fmt: skip
def test_cameras_that_do_not_fit_the_places(command, cells, camera, said, tmp_path):
    left, right = cells
    rows = places_of(example.TABLE, left=left, right=right)
    header = "photo,point,x,y" + (",camera" if left else "")
    file = write(tmp_path, camera, "camera.toml")
    table = written(tmp_path, header, rows)
    told = run(command, table, "--camera", file, "--sigma", "0.005")
    assert told.exit_code == 2 and said in words(told.stderr)
