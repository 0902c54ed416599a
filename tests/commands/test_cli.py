"""The command line as its user meets it: output, exit codes, files."""

import json
import math
import os
import subprocess
import sys

import command_line
import numpy as np
import pytest
from bad_tables import BAD_CAMERAS, BAD_TABLES, write
from command_line import rows, words
from workload import aerial

import jaxro
from jaxro.tables import cameras, csv as tables
from jaxro.tables.examples import pair as pair_example

FILES = {
    "elements.csv",
    "residuals.csv",
    "points.csv",
    "reliability.csv",
    "summary.json",
}
FOCAL = ["--focal", str(pair_example.FOCAL)]


def run(*arguments):
    return command_line.run("orient", *arguments)


def numbers(row, *names):
    return [float(row[name]) for name in names]


@pytest.fixture(scope="module")
def sample(tmp_path_factory):
    """The example as a user's file."""
    return write(tmp_path_factory.mktemp("sample"), pair_example.TABLE, "dewitt.csv")


def test_the_example_prints_the_published_solution(example):
    told = example("orient")
    assert told.exit_code == 0
    for printed in (
        "bx 91.9825 given mm",
        "by -1.7187 0.0209 mm",
        "bz -3.8105 0.0075 mm",
        "omega 2.4077 0.0065 °",
        "phi 0.5550 0.0069 °",
        "kappa -0.2053 0.0032 °",
        "sigma0 0.0045 mm",
        "1 degree of freedom",
        "a -0.0036 0.0000 0.0019",
    ):
        assert printed in words(told.stdout)


def test_files_hold_the_python_result(example):
    out = example("orient").out
    assert {path.name for path in out.iterdir()} == FILES
    assert len(list(out.parent.iterdir())) == 1
    (measured,) = tables.parse(pair_example.TABLE, "a.csv", "a").pairs
    camera = jaxro.Camera(pair_example.FOCAL)
    pair = cameras.to_pair(measured, "", camera, camera)
    o = jaxro.orient(pair, elements=jaxro.DependentElements)
    (row,) = rows(out / "elements.csv")
    lengths, angles = ("by_mm", "bz_mm"), ("omega_deg", "phi_deg", "kappa_deg")
    values = np.asarray(o.elements.values())
    deviations = np.asarray(o.sigma0) * np.sqrt(np.diagonal(np.asarray(o.cofactor)))
    for prefix, wanted in (("", values), ("sd_", deviations)):
        got = numbers(row, *(prefix + name for name in lengths + angles))
        np.testing.assert_allclose(
            got, [*wanted[:2], *(wanted[2:] * (180 / np.pi))], rtol=1e-15
        )
    assert numbers(row, "sigma0_mm", "m_q_mm", "bx_mm") == [
        float(o.sigma0),
        float(o.m_q),
        float(np.mean(measured.coordinates[0] - measured.coordinates[2])),
    ]
    assert (row["result"], row["advice"], row["degrees_of_freedom"]) == (
        "successful",
        "",
        "1",
    )
    residuals, points = rows(out / "residuals.csv"), rows(out / "points.csv")
    assert [r["point"] for r in residuals] == list("abcdef")
    wanted = (o.parallax, *o.corrections(pair), o.redundancy)
    names = (
        "q_mm",
        "v_x_left_mm",
        "v_y_left_mm",
        "v_x_right_mm",
        "v_y_right_mm",
        "redundancy",
    )
    # another program, which rounds otherwise
    np.testing.assert_allclose(
        [numbers(r, *names) for r in residuals], np.stack(wanted, axis=-1), rtol=1e-9
    )
    np.testing.assert_array_equal(
        [numbers(p, "X_mm", "Y_mm", "Z_mm") for p in points], np.stack(o.model, axis=-1)
    )
    summary = json.loads((out / "summary.json").read_text())
    (only,) = summary["pairs"]
    assert (only["sigma0"], only["elements"]["by"]["value"]) == (
        float(o.sigma0),
        values[0],
    )
    assert summary["usable"] == 1 and summary["units"]["sigma0"] == "mm"


def test_what_could_hide_is_told_and_written(tmp_path):
    """Twelve points, one of them wrong by 9 sigma: named; the file holds what `assess`
    says."""
    coordinates = [c[0] for c in aerial(1, 12)]
    coordinates[3][4] += 0.09
    lines = [
        "point,x_left,y_left,x_right,y_right",
        *(
            f"p{i},{','.join(map(repr, p.tolist()))}"
            for i, p in enumerate(np.transpose(coordinates))
        ),
    ]
    file, out = write(tmp_path, "\n".join(lines), "twelve.csv"), tmp_path / "out"
    told = words(run(file, "--focal", 150, "--sigma", 0.01, "--out", out).output)
    pair = jaxro.pair(*coordinates, focal=150.0, sigma=0.01)
    reading = jaxro.assess(pair, jaxro.orient(pair), sigma0=1.0)
    assert (
        f"Mind: Point p4 has |w| = {abs(float(reading.w[4])):.2f} where 3.29 is allowed"
        in told
    )
    assert "times less accurate than their sigma says" in told
    (poor,) = np.flatnonzero(np.asarray(reading.redundancy) < 0.1)
    assert f"Poorly checked (redundancy below 0.1): point p{poor}; an error of" in told
    written = rows(out / "reliability.csv")
    np.testing.assert_allclose([float(r["w"]) for r in written], reading.w, rtol=1e-9)
    np.testing.assert_allclose(
        [float(r["detectable_y_right_mm"]) for r in written],
        reading.detectable[3],
        rtol=1e-9,
    )
    assert {r["control_y_left"] for r in written} <= {
        "not",
        "poorly",
        "sufficiently",
        "well",
    }
    without = words(run(file, "--focal", 150).output)
    assert "tau, limit 2.45" in without and "Mind: Point p4" in without


@pytest.mark.slow
def test_every_pair_has_a_row_and_failed_ones_their_advice(sample, tmp_path):
    lines = pair_example.TABLE.split()[1:]
    behind = [*lines, "g,1.599,-5.274,40.965,-4.319"]
    pairs = {"good": lines, "four": lines[:4], "five": lines[:5], "[behind]": behind}
    table = "pair,point,x_left,y_left,x_right,y_right\n"
    table += "".join(
        f"{name},{line}\n" for name, members in pairs.items() for line in members
    )
    out = tmp_path / "out"
    result = run(
        write(tmp_path, table, "pairs.csv"),
        *FOCAL,
        "--elements",
        "dependent",
        "--out",
        out,
    )
    assert result.exit_code == 1
    elements = {row["pair"]: row for row in rows(out / "elements.csv")}
    results = ["successful", "too_few_points", "no_redundancy", "points_behind_camera"]
    assert (
        list(elements) == list(pairs)
        and [row["result"] for row in elements.values()] == results
    )
    np.testing.assert_allclose(
        numbers(elements["good"], "by_mm", "sd_by_mm"),
        [-1.7187166, 0.0209246],
        rtol=1e-6,
    )
    assert (
        elements["five"]["by_mm"]
        and not elements["five"]["sd_by_mm"]
        and not elements["five"]["m_q_mm"]
    )
    for name in ("four", "[behind]"):
        assert (
            not elements[name]["by_mm"]
            and not elements[name]["sigma0_mm"]
            and elements[name]["advice"]
        )
        assert name in result.output and elements[name]["advice"] in words(
            result.output
        )
    front = {
        row["point"]: row["in_front"]
        for row in rows(out / "residuals.csv")
        if row["pair"] == "[behind]"
    }
    assert front == {**dict.fromkeys("abcdef", "true"), "g": "false"}
    assert len(rows(out / "points.csv")) == len(table.split()) - 1
    written = json.loads((out / "summary.json").read_text(), parse_constant=pytest.fail)
    assert written["failed"] == 2 and written["pairs"][1]["sigma0"] is None
    assert "nan" not in (out / "elements.csv").read_text().lower()


def test_relative_elements_have_deviations_and_sigma_makes_a_ratio(sample, tmp_path):
    out = tmp_path / "out"
    assert run(sample, *FOCAL, "--sigma", "0.005", "--out", out).exit_code == 0
    (row,) = rows(out / "elements.csv")
    base = numbers(row, "bx", "by", "bz")
    assert math.isclose(np.dot(base, base), 1, abs_tol=1e-14)
    np.testing.assert_allclose(
        numbers(row, "omega_deg", "phi_deg", "kappa_deg"),
        [2.4077, 0.5550, -0.2053],
        atol=5e-5,
    )
    sd = numbers(row, "sd_omega_deg", "sd_phi_deg", "sd_kappa_deg")
    np.testing.assert_allclose(sd, [0.0065, 0.0069, 0.0032], atol=6e-5)
    # by / bx of the unit base to first order: the dependent element over bx
    np.testing.assert_allclose(numbers(row, "sd_by")[0] * 91.9825, 0.0209, rtol=2e-3)
    np.testing.assert_allclose(numbers(row, "sigma0"), 0.0045223 / 0.005, rtol=1e-4)


def test_a_bad_table_writes_nothing(tmp_path):
    """What is said of each kind of bad table is tested where tables are read."""
    content, line, column, _ = BAD_TABLES["not a number"]
    path = write(tmp_path, content, "pairs.csv")
    result = run(path, *FOCAL, "--out", tmp_path / "out")
    place = f"{path}, line {line}, column {column}"
    assert result.exit_code == 2 and place in result.stderr
    assert not result.stdout and list(tmp_path.iterdir()) == [path]


BAD_OPTIONS = {
    "no focal length": ([], "neither --focal nor --camera"),
    "negative focal length": (["--focal", "-3"], "-3.0"),
    "infinite principal point": ([*FOCAL, "--principal-point", "0", "inf"], "inf"),
    "zero pixel size": ([*FOCAL, "--pixel-size", "0"], "0.0"),
    "negative sigma": ([*FOCAL, "--sigma", "-1"], "-1.0"),
    "base of relative elements": ([*FOCAL, "--base", "3"], "relative"),
    "zero base": ([*FOCAL, "--base", "0", "--elements", "dependent"], "0.0"),
    "a unit that is no name": ([*FOCAL, "--unit", "[/b]"], "'[/b]'"),
    "unknown elements": ([*FOCAL, "--elements", "absolute"], "absolute"),
    "two cameras": ([*FOCAL, "--camera", "camera.toml"], "beside --camera"),
    "tables of another kind": ([*FOCAL, "--tables", "points"], "--parquet"),
    "engine for another kind": ([*FOCAL, "--engine", "ray"], "--parquet"),
    "no camera file": (["--camera", "missing.toml"], "missing.toml"),
}


@pytest.mark.parametrize("case", BAD_OPTIONS)
def test_bad_options_write_nothing(case, sample, tmp_path):
    options, found = BAD_OPTIONS[case]
    result = run(sample, *options, "--out", tmp_path / "out")
    assert (
        result.exit_code == 2
        and found in result.stderr
        and not list(tmp_path.iterdir())
    )


def test_bad_camera_files_write_nothing(sample, tmp_path):
    content, line, key, _ = BAD_CAMERAS["unknown key"]
    path = write(tmp_path, content, "camera.toml")
    result = run(sample, "--camera", path, "--out", tmp_path / "out")
    assert (
        result.exit_code == 2 and f"{path}, line {line}, column {key}" in result.stderr
    )
    assert list(tmp_path.iterdir()) == [path]


def test_results_are_overwritten_only_by_force(tmp_path):
    keep = tmp_path / "notes.txt"
    keep.write_text("mine")
    refused = run("--out", tmp_path)
    assert (
        refused.exit_code == 2
        and "--force" in refused.stderr
        and list(tmp_path.iterdir()) == [keep]
    )
    assert run("--out", keep, "--force").exit_code == 2 and keep.read_text() == "mine"
    for name, said in (
        ("/", "the root of all folders"),
        (tmp_path / ("a" * 250), "too long"),
    ):
        result = run("--out", name, "--force")
        assert result.exit_code == 2 and said in result.stderr and not result.stdout
    assert run("--out", tmp_path, "--force").exit_code == 0
    assert {path.name for path in tmp_path.iterdir()} == FILES | {
        "notes.txt"
    } and keep.read_text() == "mine"


def test_a_result_never_takes_the_place_of_what_was_read(sample, tmp_path):
    table = tmp_path / "points.csv"
    table.write_bytes(sample.read_bytes())
    result = run(table, *FOCAL, "--out", tmp_path, "--force")
    assert result.exit_code == 2 and "points.csv" in result.stderr
    assert (
        list(tmp_path.iterdir()) == [table]
        and table.read_bytes() == sample.read_bytes()
    )


def test_nothing_is_left_of_a_result_that_could_not_be_written(tmp_path, monkeypatch):
    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("jaxro.tables.whole.os.replace", full)
    result = run("--out", tmp_path / "out")
    assert (
        result.exit_code == 2
        and "No space left" in result.stderr
        and not list(tmp_path.iterdir())
    )


@pytest.mark.slow
def test_kept_programs_change_nothing_but_the_time(tmp_path):
    def call() -> str:
        command = [sys.executable, "-W", "error", "-m", "jaxro", "orient"]
        environment = os.environ | {
            "JAXRO_CACHE": str(tmp_path / "kept"),
            "JAX_COMPILATION_CACHE_DIR": "",
        }
        done = subprocess.run(
            command, capture_output=True, text=True, env=environment, check=True
        )
        assert not done.stderr
        return done.stdout

    first = call()
    kept = {program: program.read_bytes() for program in (tmp_path / "kept").iterdir()}
    assert len(kept) == 2  # the orientation and what is told of it
    assert call() == first
    assert {program: program.read_bytes() for program in kept} == kept
