"""`jaxro heights` and `jaxro plan` as their user meets them: reports, files, what is
said of bad tables."""

import json
import re
import sys

import numpy as np
import pytest
from bad_tables import write
from command_line import rows, run, words

from jaxro.tables.examples import survey as survey_example

CAMERAS = [
    "--camera-height",
    str(survey_example.CAMERA_HEIGHT),
    "--base",
    str(survey_example.BASE),
]


@pytest.fixture
def tables(tmp_path):
    """The example as a user's files."""
    return (
        write(tmp_path, survey_example.READINGS, "readings.csv"),
        write(tmp_path, survey_example.GRID, "grid.csv"),
        write(tmp_path, survey_example.TRAVERSES, "traverses.csv"),
    )


def survey(readings, grid, traverses=None, *options):
    legs = [] if traverses is None else ["--traverses", traverses]
    return run("heights", readings, "--grid", grid, *legs, *CAMERAS, *options)


def test_heights_of_the_example_are_true_within_their_deviations(example):
    """Held against the surface that was photographed."""
    told = example("heights")
    assert told.exit_code == 0 and not told.stderr
    assert "simulated example" in told.stdout
    out = told.out
    files = {"heights.csv", "traverses.csv", "legs.csv", "summary.json", "surface.png"}
    assert {path.name for path in out.iterdir()} == files
    assert (out / "surface.png").read_bytes().startswith(b"\x89PNG")
    points = rows(out / "heights.csv")
    height, sd, alone, sd_alone = (
        np.array([float(p[c]) for p in points])
        for c in ("height_mm", "sd_mm", "over_grid_mm", "sd_over_grid_mm")
    )
    truth, free = np.array(survey_example.TRUTH), sd > 0
    assert np.sum(~free) == 2 and all(
        p["from"] == "known" for p, f in zip(points, free, strict=True) if not f
    )
    np.testing.assert_array_equal(height[~free], truth[~free])
    for error, deviation in (
        ((height - truth)[free], sd[free]),
        (alone - truth, sd_alone),
    ):
        assert (
            np.max(np.abs(error / deviation)) < 3.3
            and 0.4 < np.sqrt(np.mean((error / deviation) ** 2)) < 1.4
        )
    shares = np.array(
        [[float(v) for k, v in p.items() if k.startswith("share_")] for p in points]
    )
    np.testing.assert_allclose(np.sum(shares[free], axis=1), 1, rtol=1e-9)
    summary = json.loads((out / "summary.json").read_text(), parse_constant=pytest.fail)
    assert summary["degrees_of_freedom"] == 3 and summary["suspicious"] == []
    legs = rows(out / "legs.csv")
    assert len(legs) == survey_example.TRAVERSES.count("\n") - 1


def test_tables_of_a_user_give_the_same(tables, tmp_path, example, monkeypatch, unkept):
    """By a program that is kept."""
    monkeypatch.setenv("JAXRO_CACHE", str(tmp_path / "kept"))
    read = survey(*tables)
    assert len(list((tmp_path / "kept").iterdir())) == 1
    assert read.exit_code == 0
    figures = [
        words(told.stdout).split(" Written to ")[0].split("H 1505")[1]
        for told in (read, example("heights"))
    ]
    assert figures[0] and figures[1].startswith(figures[0])


def test_a_wrong_leg_is_named(tables, tmp_path):
    """0.08 mm in a reading of the middle traverse: 7.8 mm, where 5.7 is detectable."""
    text = re.sub(
        r"(?m)^middle,s7,s8,([\d.]+),([\d.]+)$",
        lambda m: f"middle,s7,s8,{m[1]},{float(m[2]) + 0.08:.3f}",
        survey_example.TRAVERSES,
    )
    assert text != survey_example.TRAVERSES
    wrong = write(tmp_path, text, "wrong.csv")
    told = survey(tables[0], tables[1], wrong, "--out", tmp_path / "out")
    said = words(told.output)
    assert told.exit_code == 1 and "Mind: Traverse middle (s6 - s10) has |w| =" in said
    size = float(re.search(r"wrong by some ([\d.]+) mm", said)[1])
    np.testing.assert_allclose(size, 7.8, atol=1.5)
    assert (
        json.loads((tmp_path / "out" / "summary.json").read_text())["suspicious"][0]
        == "middle"
    )


def test_without_traverses_heights_are_read_from_known_points_or_the_grid(
    tables, tmp_path
):
    """A reading of the grid for each square stands for those at the points; no places,
    no picture."""
    lines = [line.split(",") for line in survey_example.READINGS.split()]
    readings = write(
        tmp_path,
        "\n".join(",".join([*line[:3], line[6]]) for line in lines),
        "short.csv",
    )
    grid = survey_example.GRID.split()
    first = {line[1]: line[3] for line in reversed(lines[1:])}
    squares = [
        f"{grid[0]},parallax",
        *(f"{line},{first[line.split(',')[0]]}" for line in grid[1:]),
    ]
    told = survey(
        readings,
        write(tmp_path, "\n".join(squares), "squares.csv"),
        None,
        "--out",
        tmp_path / "out",
    )
    assert (
        told.exit_code == 0
        and "no picture of the surface: the readings have no columns x and y"
        in told.stderr
    )
    assert {path.name for path in (tmp_path / "out").iterdir()} == {
        "heights.csv",
        "summary.json",
    }
    origin = {
        row["point"]: row["from"] for row in rows(tmp_path / "out" / "heights.csv")
    }
    assert (
        origin["p1"] == "s1"
        and origin["p2"] == origin["s2"] == "grid"
        and origin["s1"] == "known"
    )


@pytest.mark.slow
def test_a_traverse_may_hang_on_corners_of_the_grid(tables, tmp_path):
    legs = [
        "traverse,from,to,back,fore",
        "t,A1,s1,55.49,54.021",
        "t,s1,s2,54.021,53.903",
        "t,s2,A2,53.903,55.485",
    ]
    unknown = re.sub(r"-\d+\.\d$", "", survey_example.READINGS, flags=re.M)
    told = survey(
        write(tmp_path, unknown, "r.csv"),
        tables[1],
        write(tmp_path, "\n".join(legs), "t.csv"),
    )
    found = re.search(
        r"s1 (-[\d.]+) ([\d.]+) (-[\d.]+) ([\d.]+) traverses", words(told.stdout)
    )
    assert (
        told.exit_code == 0
        and abs(float(found[1]) - survey_example.TRUTH[0]) < 3 * float(found[2]) < 6
    )
    assert "Traverse t, 3 legs, closes with" in told.stdout


def test_without_matplotlib_the_rest_is_written(tables, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    told = survey(*tables, "--out", tmp_path / "out")
    assert (
        told.exit_code == 0
        and "jaxro[plots]" in told.stderr
        and (tmp_path / "out" / "heights.csv").exists()
    )


READINGS, GRID, LEGS = 0, 1, 2
BAD = {  # the table, what stands there, what stands there instead, line, column, found
    "unknown square": (READINGS, "s2,A2", "s2,A7", 3, "square", "'A7'"),
    "point twice": (READINGS, "s3,A3", "s2,A3", 4, "point", "first on line 3"),
    "a reading in µm": (READINGS, "53.830", "53830", 4, "parallax", "over it"),
    "a reading in m": (
        READINGS,
        "53.830",
        "0.05383",
        4,
        "parallax",
        "no point has the parallax",
    ),
    "no reading": (READINGS, "53.830", "", 4, "parallax", "an empty field"),
    "longer than the world": (READINGS, "53.830", "1e308", 4, "parallax", "'1e308'"),
    "known height over the cameras": (
        READINGS,
        "57,-127.6",
        "57,5000",
        2,
        "height",
        "5000.0",
    ),
    "zero parallax": (READINGS, "53.830", "0", 4, "parallax", "a reading of 0"),
    "a word": (READINGS, "53.830", "deep", 4, "parallax", "'deep'"),
    "no reading of the grid": (
        READINGS,
        "53.830,55.465",
        "53.830,",
        4,
        "grid",
        "no reading of the grid",
    ),
    "unknown column": (READINGS, "grid,x", "grid,z", 1, "z", "an unknown column"),
    "point named as a square": (READINGS, "s2,A2", "B1,A2", 3, "point", "'B1'"),
    "square twice": (GRID, "A2,", "A1,", 3, "square", "first on line 2"),
    "side zero": (GRID, "A3,99.9", "A3,0", 4, "side", "'0'"),
    "side in cm": (
        GRID,
        "A3,99.9",
        "A3,9.99",
        4,
        "photo_side",
        "a focal length of 754.9 mm",
    ),
    "photo side zero": (GRID, "5.016", "0", 3, "photo_side", "'0'"),
    "unknown point": (LEGS, "main,s2,s3", "main,s2,q", 3, "to", "'q'"),
    "gap in a traverse": (LEGS, "main,s2,s3", "main,s4,s3", 3, "from", "'s4'"),
    "leg to itself": (LEGS, "main,s2,s3", "main,s2,s2", 3, "to", "'s2'"),
    "short line": (LEGS, "main,s2,s3,", "main,s2,", 3, "fore", "4 fields"),
    "leg reading in µm": (
        LEGS,
        "main,s1,s2,5",
        "main,s1,s2,5000",
        2,
        "back",
        "over it",
    ),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_tables_say_where_and_write_nothing(case, tables, tmp_path):
    table, old, new, line, column, found = BAD[case]
    text = tables[table].read_text()
    assert old in text
    tables[table].write_text(text.replace(old, new, 1))
    told = survey(*tables, "--out", tmp_path / "out")
    place = f"{tables[table]}, line {line}" + (f", column {column}" if column else "")
    assert (
        told.exit_code == 2
        and f"{place}: found" in told.stderr
        and found in told.stderr
        and "expected" in told.stderr
    )
    assert not (tmp_path / "out").exists() and not told.stdout


def test_traverses_without_a_known_height_and_options_that_do_not_fit(tables, tmp_path):
    loose = write(
        tmp_path,
        re.sub(r"-\d+\.\d$", "", survey_example.READINGS, flags=re.M),
        "loose.csv",
    )
    told = survey(loose, *tables[1:])
    assert told.exit_code == 2 and "no legs join to a known height" in told.stderr
    grid = write(
        tmp_path,
        re.sub(
            r"(\d\.\d{3})$",
            lambda m: f"{float(m[1]) * 1000:g}",
            survey_example.GRID,
            flags=re.M,
        ),
        "m.csv",
    )
    assert "a focal length of" in survey(tables[0], grid).stderr  # all squares in µm
    for options, said in (
        ([tables[0]], "no table of the grid"),
        (
            [tables[0], "--grid", tables[1], "--base", "375"],
            "--camera-height: found no value",
        ),
        (
            [tables[0], "--grid", tables[1], "--camera-height", "1500", "--base", "0"],
            "0.0",
        ),
        (["--grid", tables[1]], "without READINGS.csv"),
        (["--sd", "lens=1"], "camera-height=10"),
        (["--sd", "base=-1"], "'base=-1'"),
        (["--sd", "base=1", "--sd", "base=2"], "base a second time"),
        (["--sd", "point=0"], "'point=0'"),  # the weights of traverses
        (["--out", tmp_path], "--force"),
        (
            [tmp_path / "missing.csv", "--grid", tables[1], *CAMERAS],
            "no file that can be read",
        ),
    ):
        result = run("heights", *options)
        assert result.exit_code == 2 and said in result.stderr and not result.stdout, (
            options
        )


def test_a_known_height_that_is_not_what_is_read_is_told(tables, tmp_path, example):
    """Given 12 mm too high, and read with ± 1.1 mm."""
    moved = write(
        tmp_path, survey_example.READINGS.replace("57,-127.6", "57,-115.6"), "moved.csv"
    )
    told = survey(moved, *tables[1:])
    assert (
        told.exit_code == 1
        and "The height of s1 is given as -115.6 mm, and read as -127."
        in words(told.stdout)
    )
    assert "The height of" not in words(example("heights").stdout)


def test_heights_from_another_zero(tables, tmp_path, example):
    """Grid, known heights and cameras 250 m higher: heights 250 m higher, to the
    rounding of their numbers."""
    lift = lambda text: re.sub(
        r"(?m)(-[\d.]+)$", lambda m: f"{250_000 + float(m[1]):.1f}", text
    )
    readings = write(tmp_path, lift(survey_example.READINGS), "high.csv")
    grid = re.sub(r"(?m)$", ",250000", survey_example.GRID.strip()).replace(
        "photo_side,250000", "photo_side,height"
    )
    high = write(tmp_path, grid + "\n", "high_grid.csv")
    options = "--grid", high, "--traverses", tables[2], "--base", "375"
    assert (
        run(
            "heights",
            readings,
            *options,
            "--camera-height",
            "251505",
            "--out",
            tmp_path / "high",
        ).exit_code
        == 0
    )
    one, other = (
        rows(folder / "heights.csv")
        for folder in (tmp_path / "high", example("heights").out)
    )
    for column, zero in (
        ("height_mm", 250_000),
        ("sd_mm", 0),
        ("over_grid_mm", 250_000),
    ):
        a, b = (
            np.array([float(row[column]) for row in table]) for table in (one, other)
        )
        np.testing.assert_allclose(a - zero, b, atol=1e-6)
    wrong = run("heights", readings, *options, "--camera-height", "1505")
    assert (
        wrong.exit_code == 2
        and "line 2, column height" in wrong.stderr
        and "from the same zero" in wrong.stderr
    )


@pytest.mark.slow
def test_a_plan_is_told_and_answers_backwards():
    told = words(
        run("plan", "--camera-height", 3500, "--base", 815, "--want", 1.54).stdout
    )
    assert "a height over the grid (1) 1.57 2224" in told
    base = float(re.search(r"a base of at least (\d+) mm", told)[1])
    assert 815 < base < 875
    again = words(run("plan", "--camera-height", 3500, "--base", base).stdout)
    assert "a height over the grid (1) 1.54" in again
    better = words(
        run(
            "plan", "--camera-height", 3500, "--base", 815, "--sd", "camera-height=0"
        ).stdout
    )
    np.testing.assert_allclose(
        float(re.search(r"grid \(1\) ([\d.]+)", better)[1]),
        np.sqrt(1.57**2 - 0.57**2),
        atol=0.01,
    )


@pytest.mark.slow
def test_what_no_limit_was_found_for_is_not_told_as_one():
    plan = (
        "plan",
        "--camera-height",
        500,
        "--depth",
        50,
        "--step",
        5,
        "--of",
        "in-square",
        "--want",
    )
    assert "with this H:B of 4.0 even 20 times the camera height" in words(
        run(*plan, 8).stdout
    )
    assert "any base, even of 0.125 mm" in words(run(*plan, 1e9).stdout)
    told = words(run("plan", "--legs", 1).stdout)
    assert "the middle of a traverse of 1 leg (13) - -" in told


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--want", "0.1"], "which no base and no camera height gives"),
        (["--want", "-1"], "--want"),
        (["--base", "900"], "at most a quarter of the camera height, 525"),
        (
            ["--of", "depth", "--want", "1"],
            "height, difference, in-square, middle, node, detail",
        ),
        (["--legs", "0"], "--legs"),
        (["--depth", "3000"], "--depth"),
        (["--focal", "0"], "--focal"),
        (["--side", "1e-300"], "a positive length in mm"),
        (["--sd", "point=1e-200"], "'point=1e-200'"),
    ],
)
def test_plans_that_cannot_be_say_so(options, said):
    result = run("plan", *options)
    assert result.exit_code == 2 and said in words(result.stderr)


def test_the_table_of_1982_is_reproduced():
    told = words(run("reproduce", "gutkin1982").stdout)
    assert (
        "m_pc 0.0690 0.059 [1] 0.0100 0.0730 0.073" in told
        and "misprint for 0.069" in told
    )
    assert "(20) H² / x B, n = 9 5386 5500" in told


def test_the_table_of_1982_has_room_on_a_narrow_terminal():
    told = run("reproduce", "gutkin1982", columns=80)
    assert told.exit_code == 0 and "\u2026" not in told.output
    assert max(map(len, told.output.splitlines())) <= 80
