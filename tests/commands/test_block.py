"""`jaxro block` as its user meets it: reports, files, what is wrong, bad tables."""

import json

import numpy as np
import pytest
from bad_tables import write
from command_line import rows, run, words

from jaxro.block import Flight, mock_block
from jaxro.tables.examples import block as block_example

AXES = ("X", "Y", "Z")
FILES = ("photos", "points", "control", "residuals")
COVARIANCES = ("photo_covariances", "point_covariances")


def numbers(table, *columns):
    return np.array([[float(row[c] or "nan") for c in columns] for row in table])


@pytest.fixture(scope="module")
def made():
    """A simulated strip as `jaxro block` makes it."""
    return block_example.simulate(models=4, seed=3)


@pytest.fixture
def tables(made, tmp_path):
    """Its tables as a user's files."""
    texts = made.tables()
    return tuple(write(tmp_path, texts[name], name) for name in texts)


def block(tables, *more, sigma="0.005"):
    given = () if sigma is None else ("--sigma", sigma)
    control = () if tables[1] is None else ("--control", tables[1])
    return run("block", tables[0], *control, "--focal", "153", *given, *more)


@pytest.fixture(scope="module")
def written(made, tmp_path_factory):
    """The results of the tables as a user has them."""
    folder = tmp_path_factory.mktemp("block")
    texts = made.tables()
    tables = tuple(write(folder, texts[name], name) for name in texts)
    assert block(tables, "--out", folder / "out").exit_code == 0
    return folder / "out"


@pytest.mark.slow
def test_the_tables_of_a_simulated_block_give_its_numbers(example, written, tables):
    """Names, orders and units survive; what is wrong is named."""
    told = example("block")
    first, second = told.out, written
    assert told.exit_code == 0 and not told.stderr
    names = {f"{name}.csv" for name in (*FILES, *COVARIANCES, "pairs", "ground")}
    assert {p.name for p in first.iterdir()} == names | {"summary.json", "block.png"}
    for path in tables:
        assert path.read_text() == (first / f"{path.stem}.csv").read_text()
    for name in (*FILES, *COVARIANCES):
        one, other = (rows(folder / f"{name}.csv") for folder in (first, second))
        assert [list(row) for row in one] == [list(row) for row in other]
        for row, same in zip(one, other, strict=True):
            for column, value in row.items():
                if column in ("photo", "point", "role", "left_out") or not value:
                    assert same[column] == value
                else:
                    expected = pytest.approx(float(value), rel=1e-6, abs=1e-6)
                    assert float(same[column]) == expected
    wrong = [row for row in rows(first / "residuals.csv") if row["left_out"] == "true"]
    assert len(wrong) == 1
    assert float(wrong[0]["vy"]) == pytest.approx(-0.125, abs=0.03)
    assert "1 of 90 places left out as wrong" in words(told.stdout)
    summary = json.loads((first / "summary.json").read_text())
    assert summary["usable"] and summary["rays_left_out"] == 1


def test_points_and_photos_are_true_within_their_deviations(written):
    out = written
    truth = mock_block(3, Flight(models=4), control_every=2)
    at = dict(zip(truth.block.points, truth.points, strict=True))
    points = rows(out / "points.csv")
    places, deviations = (numbers(points, *(b + a for a in AXES)) for b in ("", "s"))
    off = (places - [at[row["point"]] for row in points]) / deviations
    assert np.max(np.abs(off)) < 4.5 and 0.5 < np.sqrt(np.mean(off**2)) < 1.5
    photos = rows(out / "photos.csv")
    centres = dict(zip(truth.block.photos, truth.photos.centres, strict=True))
    places, deviations = (numbers(photos, *(b + a for a in AXES)) for b in ("", "s"))
    off = (places - [centres[row["photo"]] for row in photos]) / deviations
    assert np.max(np.abs(off)) < 4.5
    covariance = numbers(rows(out / "point_covariances.csv"), "X_X", "Y_Y", "Z_Z")
    np.testing.assert_allclose(
        np.sqrt(covariance)[:3], numbers(points, "sX", "sY", "sZ")[:3]
    )
    control = rows(out / "control.csv")
    assert {row["role"] for row in control} == {"control", "check"}
    v, w = (numbers(control, *(b + a for a in AXES)) for b in ("v", "w_"))
    tested = np.isfinite(w)
    assert np.all(np.sign(v[tested]) == np.sign(w[tested]))
    checks = [row for row in control if row["role"] == "check"]
    assert np.all(np.abs(numbers(checks, "w_X", "w_Y", "w_Z")) < 4)


def edited(path, edit):
    """The table after each of its lines has become edit(cells), None to delete it."""
    lines = [line.split(",") for line in path.read_text().splitlines()]
    kept = [lines[0]] + [new for line in lines[1:] if (new := edit(line)) is not None]
    path.write_text("\n".join(map(",".join, kept)) + "\n")


@pytest.mark.slow
def test_sigma_is_found_where_none_is_given(tables):
    told = block(tables, sigma=None)
    assert told.exit_code == 0
    found = words(told.stdout).split("(sigma ")[1].split(" ")[0]
    assert 0.003 < float(found) < 0.007


def test_a_wrong_control_point_is_named(tables, tmp_path):
    def edit(cells):
        if cells[0] == "c3":
            cells[3] = str(float(cells[3]) + 8.0)
        return [*cells[:7], "control"]

    edited(tables[1], edit)
    told = block(tables, "--out", tmp_path / "out")
    assert told.exit_code == 0
    assert "Control points left out as wrong: c3" in words(told.stdout)
    (row,) = (r for r in rows(tmp_path / "out/control.csv") if r["point"] == "c3")
    assert row["left_out"] == "true" and float(row["vZ"]) == pytest.approx(-8, abs=1)


@pytest.mark.slow
def test_control_in_plan_and_in_height_alone(tables):
    """No point has all three coordinates."""

    def edit(cells):
        hidden = (3, 6) if cells[0] in ("c0", "c2", "c4") else (1, 2, 4, 5)
        return ["" if k in hidden else cell for k, cell in enumerate(cells[:7])] + [""]

    edited(tables[1], edit)
    told = block(tables)
    assert told.exit_code == 0, told.stdout
    assert "control 3 in plan, 3 in height" in words(told.stdout)


def test_without_control_the_network_is_free(tables):
    told = block((tables[0], None), "--datum", "points")
    assert told.exit_code == 0
    assert "free network" in told.stdout
    assert "refer to its points as a whole (inner constraints)" in words(told.stdout)


def test_a_control_point_on_one_photo_counts(tables, written, tmp_path):
    """By --rays; two more measurements, and three known coordinates."""
    plain = json.loads((written / "summary.json").read_text())
    rays = write(tmp_path, "photo,point,x,y\n1-3,new,10.0,5.0\n", "rays.csv")
    ground = tables[1].read_text() + "new,2000.0,80.0,30.0,50,50,50,control\n"
    tables[1].write_text(ground)
    found = json_of(tables, tmp_path / "more", "--rays", rays)
    assert found["degrees_of_freedom"] == plain["degrees_of_freedom"] + 2
    assert found["points"] == plain["points"] + 1


def test_rays_that_stand_in_the_pairs_count_once(tables, written, tmp_path):
    """They are the same measurements, read a second time; it is told."""
    plain = json.loads((written / "summary.json").read_text())
    both = [
        f"{row[side]},{row['point']},{row[f'x_{side}'][:12]},{row[f'y_{side}'][:12]}"
        for row in rows(tables[0])
        for side in ("left", "right")
    ]
    rays = write(
        tmp_path, "\n".join(["photo,point,x,y", *dict.fromkeys(both)]), "r.csv"
    )
    told = block(tables, "--rays", rays, "--json")
    for name in ("degrees_of_freedom", "sigma0", "points"):
        assert json.loads(told.stdout)[name] == plain[name]
    assert "stand in" in told.stderr and "counts once" in words(told.stderr)


def places_of(pairs):
    """The places of a table of pairs, each once."""
    places = {}
    for row in rows(pairs):
        for side in ("left", "right"):
            place = row[f"x_{side}"], row[f"y_{side}"]
            places[row[side], row["point"]] = place
    return places


def test_a_row_for_each_place_is_the_same_block(tables, written, tmp_path):
    """In any order of the rows, and with a point that one photo shows alone."""
    places = places_of(tables[0])
    lines = [",".join([*names, *place]) for names, place in reversed(places.items())]
    text = "\n".join(["Photo;Point;x;y", *lines, "1-1,lonely,1.5,-2.5"])
    table = write(tmp_path, text.replace(",", ";"), "places.csv")
    out = tmp_path / "out"
    told = block((table, tables[1]), "--out", out)
    assert told.exit_code == 0, told.stderr
    assert f"on {len(places) + 1} places" in words(told.stdout)
    for name in ("photos", "points"):
        expected = rows(written / f"{name}.csv")
        found = [
            row for row in rows(out / f"{name}.csv") if "lonely" not in row.values()
        ]
        own = [column for column in expected[0] if column.startswith(AXES)]
        np.testing.assert_allclose(
            numbers(found, *own), numbers(expected, *own), rtol=1e-6, atol=1e-6
        )


@pytest.mark.parametrize(
    ("rows", "more", "said"),
    [
        (["1,a,0,0,A", "2,a,5,0,A"], (), "found no two of 2 photos with 6 points in"),
        (["1,a,0,0,A", "1,a,5,0,A"], (), "line 3, column point: found 'a' a second"),
        (["1,a,0,0,A", "2,a,5,0,B"], (), "column camera: found 'B' beside 'A'"),
        (["1,a,0,0,A"], ("--rays", "RAYS"), "--rays: found it beside"),
        (["1,a,0,0,A"], ("--camera", "OTHER"), "column photo: found '1'; expected a"),
        (
            [f"{k},p{j},{j},{k},{k}" for k in range(11) for j in range(6)],
            ("--inner", "focal, field", "--sigma", "1"),
            "--inner: found field for 11 cameras; expected at most 10",
        ),
    ],
)
def test_places_that_make_no_block(rows, more, said, tmp_path):
    text = "\n".join(["photo,point,x,y,camera", *rows])
    table = write(tmp_path, text, "places.csv")
    files = {
        "RAYS": write(tmp_path, "photo,point,x,y\n1,b,1,1\n", "rays.csv"),
        "OTHER": write(tmp_path, "[photo.7]\nfocal = 153\n", "camera.toml"),
    }
    focal = () if "--camera" in more else ("--focal", "153")
    told = run("block", table, *focal, *(files.get(value, value) for value in more))
    assert told.exit_code == 2 and said in words(told.stderr), told.stderr


@pytest.mark.slow
def test_stations_inner_parameters_and_components(tables, written, tmp_path):
    """Stations are rows of the ground with this role; a wrong focal length is found."""
    plain = json.loads((written / "summary.json").read_text())
    photos = rows(written / "photos.csv")
    rng = np.random.default_rng(1)
    for row in photos:
        at = [float(row[a]) + rng.normal(0, 0.1) for a in AXES]
        line = ",".join([row["photo"], *map(str, at), "0.1,0.1,0.1,station"])
        tables[1].write_text(tables[1].read_text() + line + "\n")
    out = tmp_path / "out"
    told = run(
        *("block", tables[0], "--control", tables[1], "--focal", "153.4"),
        *("--sigma", "0.005", "--inner", "focal,principal", "--components"),
        *("--out", out),
    )
    assert told.exit_code == 0, told.output
    assert "Variance components, times the stated: places" in told.stdout
    assert "station of 1-1" in told.stdout
    cameras = rows(out / "cameras.csv")
    assert [row["parameter"] for row in cameras] == ["focal", "x0", "y0"]
    for row, true in zip(cameras, (153.0, 0.0, 0.0), strict=True):
        assert abs(float(row["value"]) - true) < 4 * float(row["sd"])
    summary = json.loads((out / "summary.json").read_text())
    freedom = plain["degrees_of_freedom"] + 3 * len(photos) - 3
    assert summary["degrees_of_freedom"] == freedom
    assert set(summary["components"]) == {"places", "control", "stations"}


@pytest.mark.slow
def test_other_ways_are_told_beside_it(tables):
    """By conditions the solution is the same; classical models are less accurate."""
    told = block(tables, "--conditions", "--classical")
    assert told.exit_code == 0, told.output
    text = words(told.stdout)
    apart = text.split("largest difference of a residual ")[1].split(" ")[0]
    assert float(apart) < 1e-9
    lines = [
        line.split() for line in told.stdout.splitlines() if "centres tied" in line
    ]
    assert len(lines) == 2
    for line in lines:
        plan, height = map(float, line[-6:-4])
        assert 1 < plan < 2 and 1 < height < 2
    refused = block(tables, "--conditions", "--inner", "focal")
    assert refused.exit_code == 2 and "--conditions" in refused.stderr


@pytest.mark.slow
def test_scale_bars_without_control(tables, tmp_path):
    ground = {row["point"]: row for row in rows(tables[1])}
    at = {name: numbers([row], *AXES)[0] for name, row in ground.items()}
    length = np.linalg.norm(at["c0"] - at["c5"])
    text = f"from,to,length,sigma\nc0,c5,{length},0.02\nc1,c4,3000.0,5000\n"
    bars = write(tmp_path, text, "bars.csv")
    out = tmp_path / "out"
    told = block((tables[0], None), "--bars", bars, "--out", out)
    assert told.exit_code == 0, told.output
    assert "free network; 2 scale bars" in words(told.stdout)
    points = {
        row["point"]: numbers([row], *AXES)[0] for row in rows(out / "points.csv")
    }
    across = np.linalg.norm(at["c1"] - at["c4"])
    found = np.linalg.norm(points["c1"] - points["c4"])
    assert found == pytest.approx(across, rel=1e-3)
    weak = rows(out / "bars.csv")[1]
    assert float(weak["redundancy"]) > 0.999


def json_of(tables, out, *more):
    told = block(tables, "--out", out, *more)
    assert told.exit_code == 0, told.output
    return json.loads((out / "summary.json").read_text())


def test_parquet_in_and_out(tables, written, tmp_path):
    import pyarrow.parquet as pq

    from jaxro.tables.conversion import convert

    target = tmp_path / "pairs.parquet"
    convert(tables[0], target)
    json_of((target, tables[1]), tmp_path / "parquet")
    for name in (*FILES, *COVARIANCES):
        expected = rows(written / f"{name}.csv")
        table = pq.read_table(tmp_path / f"parquet/{name}.parquet").to_pylist()
        assert [list(row) for row in table] == [list(row) for row in expected]
        first = [value for value in table[0].values() if isinstance(value, float)]
        same = [expected[0][c] for c, v in table[0].items() if isinstance(v, float)]
        np.testing.assert_allclose(first, np.array(same, float), rtol=1e-6, atol=1e-7)


HEADER = "pair,point,x_left,y_left,x_right,y_right\n"


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (
            lambda pairs, ground: (
                "left,point,x_left,y_left,x_right,y_right\na,1,1,1,1,1\n",
                ground,
            ),
            "column right: found no such column beside left",
        ),
        (
            lambda pairs, ground: (
                "left,right,point,x_left,y_left,x_right,y_right\na,a,1,1,1,1,1\n",
                ground,
            ),
            "line 2, column right: found 'a', as in column left",
        ),
        (
            lambda pairs, ground: (HEADER + "a-b-c,1,1,1,1,1\n", ground),
            "line 2, column pair: found 'a-b-c', which can be split in 2 ways",
        ),
        (
            lambda pairs, ground: (HEADER + "ab,1,1,1,1,1\n", ground),
            "line 2, column pair: found 'ab'; expected LEFT-RIGHT",
        ),
        (
            lambda pairs, ground: (
                "pair,left,right,point,x_left,y_left,x_right,y_right\n"
                "p,a,b,1,1,1,1,1\np,a,c,2,1,1,1,1\n",
                ground,
            ),
            "line 3, column left: found the photos a and c, and on line 2 a and b",
        ),
        (
            lambda pairs, ground: (pairs, "point,X,Y,Z\nc0,1,2,3\n"),
            "found no standard deviations",
        ),
        pytest.param(
            lambda pairs, ground: (pairs, keep(ground, "c0", "c5")),
            "Missing: tilt (heights of three points that are not on one line)",
            marks=pytest.mark.slow,
        ),
        (
            lambda pairs, ground: (pairs, minimal(ground)),
            "The known coordinates fit the block in two positions equally well",
        ),
        (
            lambda pairs, ground: (swapped(pairs), ground),
            "for two places of photo '1-2'",
        ),
        (
            lambda pairs, ground: (divided(pairs), ground),
            "found no scale that joins the photos",
        ),
    ],
)
def test_what_cannot_be_oriented_is_refused(tables, change, said, tmp_path):
    texts = change(*(path.read_text() for path in tables))
    for path, text in zip(tables, texts, strict=True):
        path.write_text(text)
    out = tmp_path / "out"
    told = block(tables, "--out", out)
    assert told.exit_code == 2 and said in words(told.stderr), told.stderr
    assert not out.exists()


def keep(ground, *names):
    """The header, and the lines of some points."""
    lines = ground.splitlines()
    some = [line for line in lines[1:] if line.split(",")[0] in names]
    return "\n".join([lines[0], *some]) + "\n"


def minimal(ground):
    """Two points and one height."""
    lines = keep(ground, "c0", "c1", "c5").splitlines()
    cells = lines[-1].split(",")
    cells[1] = cells[2] = cells[4] = cells[5] = ""
    return "\n".join([*lines[:-1], ",".join(cells)]) + "\n"


def swapped(pairs):
    """A point of photo 1-2 with the name of a far one, in one pair."""
    lines = pairs.splitlines()
    of_photo = [k for k, line in enumerate(lines) if line.startswith("1-2,1-3,")]
    of_photo = of_photo or [k for k, line in enumerate(lines) if "1-3,1-2," in line]
    first, last = lines[of_photo[0]].split(","), lines[of_photo[-1]].split(",")
    first[2], last[2] = last[2], first[2]
    lines[of_photo[0]], lines[of_photo[-1]] = ",".join(first), ",".join(last)
    return "\n".join(lines) + "\n"


def divided(pairs):
    """Only pairs of photos that have no photo in common."""
    lines = pairs.splitlines()
    both = ({"1-1", "1-2"}, {"1-3", "1-4"})
    some = [line for line in lines[1:] if set(line.split(",")[:2]) in both]
    return "\n".join([lines[0], *some]) + "\n"


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("--control", "ground.csv"), "--control: found it without PAIRS.csv"),
        (("--control-sigma", "0.1"), "--control-sigma: found it without --control"),
        (("--level", "2"), "--level: found 2.0"),
        (("--inner", "focal,zoom"), "--inner: found 'zoom'; expected some of focal"),
        (("--datum", "points"), "--datum: found it beside no table"),
    ],
)
def test_options_without_their_table(arguments, said):
    told = run("block", *arguments)
    assert told.exit_code == 2 and said in words(told.stderr)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("--models", "3"), "--models: found it beside a table"),
        (("--control-sigma", "0.1"), "found it beside the standard deviations"),
        (("--bars", "BARS"), "found no bar with both of its points"),
        (("--datum", "points"), "--datum: found it beside --control"),
        (("--rays", "RAYS"), "column photo: found 'strange'; expected a photo of"),
    ],
)
def test_options_that_do_not_fit_the_tables(tables, arguments, said, tmp_path):
    rays = write(tmp_path, "photo,point,x,y\nstrange,1,2,3\n", "rays.csv")
    bars = write(tmp_path, "from,to,length,sigma\na,b,1,0.1\n", "bars.csv")
    files = {"RAYS": rays, "BARS": bars}
    told = block(tables, *(files.get(a, a) for a in arguments))
    assert told.exit_code == 2 and said in words(told.stderr)


def test_cameras_of_left_and_right_photos_are_refused(tables, tmp_path):
    text = "[left]\nfocal = 153\n[right]\nfocal = 152\n"
    camera = write(tmp_path, text, "camera.toml")
    told = run("block", tables[0], "--camera", camera, "--sigma", "0.005")
    assert told.exit_code == 2 and "[photo.NAME] for each" in words(told.stderr)
