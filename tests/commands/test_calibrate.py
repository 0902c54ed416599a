"""`jaxro calibrate` as its user meets it: reports, files, bad input, and the road from
raw coordinates of two non-metric photos to a model of the object."""

import json
import re

import numpy as np
import pytest
from bad_tables import write
from calibrate_command import SIGMA, names_of, numbers, one_image, table, taken
from command_line import rows, run, words

from jaxro import calibration
from jaxro.commands.calibrate import LEAST_ROOM
from jaxro.tables.examples import calibration as calibration_example


def photos(film):
    """24 control points and 20 new points, and their places in two photos."""
    rng = np.random.default_rng(5)
    control = rng.uniform([-4, -3, -2], [4, 3, 2], (24, 3))
    new = rng.uniform([-3, -2.5, -1.5], [3, 2.5, 1.5], (20, 3))
    found = {}
    for name, x, angle in (("left", -2.0, -0.15), ("right", 2.0, 0.15)):
        station, angles = np.array([x, 0.0, 12.0]), (0.05, angle, 0.1 * x)
        found[name] = [taken(rng, p, station, angles, film) for p in (control, new)]
    return control, new, found


def files(folder, film):
    """Both photos in one table of control points and one of new points, and the
    object; the new point n7 is measured wrongly by .1 mm in the right photo."""
    control, new, found = photos(film)
    texts = []
    for number, (letter, points) in enumerate((("c", control), ("n", new))):
        images = [name for name in found for _ in points]
        names = names_of(letter, points) * 2
        places = np.concatenate([places[number] for places in found.values()])
        if letter == "n":
            places[len(points) + 6, 1] += 0.1
        texts.append(table("image,point,x,y", images, names, *places.T))
    known = table("point,X,Y,Z", names_of("c", control), *control.T)
    return (
        write(folder, texts[0], "control.csv"),
        write(folder, texts[1], "new.csv"),
        write(folder, known, "points.csv"),
    )


@pytest.mark.slow
def test_few_points_leave_no_choice_and_a_contradiction_is_not_usable(tmp_path):
    """Four points and a known camera: residuals of one focal length, not of a lens that
    makes them vanish. Object heights in feet are named, a sigma that is far too small is
    contradicted."""
    rng = np.random.default_rng(7)
    points = np.array([[-4, -3, 0], [4, -3, 1], [-4, 3, -1], [4, 3, 2], [0, 0.5, -2.0]])
    places = taken(rng, points, np.array([0.5, 0.3, 12.0]), (0.02, -0.03, 0.1))
    camera = "--focal", 60, "--principal-point", 100, 50, "--y-down"
    image, known = one_image(tmp_path, places, points)
    found = run("calibrate", image, "--object", known, *camera)
    assert found.exit_code == 0
    assert "One focal length: too few points for a choice" in words(found.stdout)
    options = "--sigma", SIGMA / 1000, "--model", "one-f"
    found = run("calibrate", image, "--object", known, *camera, *options)
    assert found.exit_code == 1 and found.stdout.count("contradicted: ") == 1
    feet = one_image(tmp_path, places, points * [1, 1, 3.2808])[1]
    options = "--sigma", SIGMA, "--model", "one-f"
    found = run("calibrate", image, "--object", feet, *camera, *options)
    assert found.exit_code == 2 and "they are in feet" in words(found.stderr)


@pytest.mark.slow
def test_the_figures_are_those_of_python(tmp_path):
    """Files and report of one image hold the numbers that the interface of Python
    gives."""
    pytest.importorskip("matplotlib")
    rng = np.random.default_rng(4)
    # as many as the command line makes room for: one program for both
    points = np.round(rng.uniform([-4, -4, -2], [4, 4, 2], (LEAST_ROOM, 3)), 5)
    places = taken(rng, points, np.array([0.0, 1.0, 12.0]), (0.1, -0.1, 0.3))
    image, known = one_image(tmp_path, np.round(places, 5), points)
    out = tmp_path / "out"
    told = run(
        *("calibrate", image, "--object", known, "--model", "one-f"),
        *("--sigma", SIGMA, "--unit", "mm", "--out", out),
    )
    assert told.exit_code == 0 and "One focal length, as asked." in told.stdout
    assert {path.name for path in out.iterdir()} == {
        *("cameras.csv", "stations.csv", "zones.csv", "residuals.csv"),
        *("variants.csv", "corrections.csv", "corrections.png", "residuals.png"),
        *("summary.json", "opencv.json"),
    }
    assert all(path.read_bytes().startswith(b"\x89PNG") for path in out.glob("*.png"))

    measured = calibration.image(*np.round(places, 5).T, points, sigma=SIGMA)
    found = calibration.calibrate(measured, calibration.Model(), calibration.known())
    (station,), (camera,) = rows(out / "stations.csv"), rows(out / "cameras.csv")
    for axis, value, deviation in zip(
        "XYZ", found.centre, found.centre_deviations, strict=True
    ):
        assert abs(float(station[axis]) - value) < 1e-4 * deviation
        np.testing.assert_allclose(float(station[f"s_{axis}"]), deviation, rtol=1e-5)
        assert f"{axis} {value:.4f} {deviation:.4f}" in words(told.stdout)
    omega = np.degrees(found.angles[0])
    np.testing.assert_allclose(float(station["omega_deg"]), omega, atol=1e-6)
    np.testing.assert_allclose(float(camera["sigma0"]), found.sigma0, rtol=1e-6)
    assert f"sigma0 {float(found.sigma0):.2f}, 55 degrees of" in words(told.stdout)
    (zone,) = rows(out / "zones.csv")
    np.testing.assert_allclose(float(zone["focal"]), found.focal[0], rtol=1e-7)
    np.testing.assert_allclose(
        numbers(rows(out / "residuals.csv"), "vx", "vy"),
        -np.asarray(found.misfits(np.round(places, 5), points)),
        atol=1e-7,
    )
    check_corrections(found, rows(out / "corrections.csv"))
    (told,) = json.loads((out / "opencv.json").read_text())["cameras"].values()
    focal, principal = float(found.focal[0]), np.asarray(found.principal)
    down = [1, float(found.frame.handedness)]
    expected = [[focal, 0, principal[0]], [0, focal, (down * principal)[1]], [0, 0, 1]]
    np.testing.assert_allclose(told["camera_matrix"], expected, rtol=1e-6, atol=1e-4)
    np.testing.assert_allclose(told["distortion_coefficients"], 0, atol=1e-6)
    assert told["rest_largest"] < 1e-5


def check_corrections(found, nodes):
    """The map is that of `calibration.correct`."""
    at = numbers(nodes, "x", "y")
    ideal = calibration.correct(found, at)
    inside = np.array([node["inside"] == "true" for node in nodes])
    np.testing.assert_array_equal(inside, ideal.inside)
    axes = np.array([1.0, -float(found.frame.handedness)])
    expected = np.asarray(found.principal) + np.asarray(ideal.places) * axes - at
    np.testing.assert_allclose(numbers(nodes, "dx", "dy"), expected, atol=1e-5)
    total = numbers(nodes, "s_x", "s_y")
    np.testing.assert_allclose(total, ideal.deviations, rtol=1e-4)
    # the distortion is known better than the principal place, which all places share
    assert np.all(numbers(nodes, "s_dx", "s_dy") < 0.1 * total)


@pytest.mark.slow
def test_the_example_needs_a_field(tmp_path):
    """The station of the simulated photo is found within its deviations."""
    out = tmp_path / "out"
    told = run("calibrate", "--unit", "mm", "--out", out)
    assert told.exit_code == 0 and "Your own image: jaxro calibrate" in told.stdout
    assert "This image needs a displacement field" in told.stdout
    (station,) = rows(out / "stations.csv")
    for axis, truth in zip("XYZ", calibration_example.STATION, strict=True):
        assert abs(float(station[axis]) - truth) < 3.5 * float(station[f"s_{axis}"])
    tried = rows(out / "variants.csv")
    assert len(tried) == len(calibration.default_models())
    assert tried[0]["score_behind_best"] == "0.0"


@pytest.mark.slow
@pytest.mark.parametrize(("film", "model"), [(0.0, "one-f"), (0.2, None)])
def test_from_raw_coordinates_to_a_model_in_three_commands(film, model, tmp_path):
    """The wrong point is found, and the others are where they are."""
    control, new, known = files(tmp_path, film)
    out = tmp_path / "calibrated"
    asked = ["--separately", "--unit", "mm", "--out", out]
    asked += [] if model is None else ["--model", model]
    told = run(
        *("calibrate", control, "--object", known, *asked),
        *("--correct", new, "--pair", "left,right"),
    )
    assert told.exit_code == 0, told.stderr
    corrected = rows(out / "corrected.csv")
    outside = sum(row["inside"] == "false" for row in corrected)
    assert len(corrected) == 40 and outside
    assert f"{outside} of 40 corrected places lie outside" in words(told.stderr)
    assert np.all(numbers(corrected, "sigma") < numbers(corrected, "sx"))
    pair = (out / "pairs.csv", "--camera", out / "cameras.toml")

    oriented = run("orient", *pair)
    assert oriented.exit_code == 0 and "Point n7 has |w|" in words(oriented.stdout)
    cleaned = run("clean", *pair, "--out", tmp_path / "model")
    assert cleaned.exit_code == 0
    model = rows(tmp_path / "model" / "points.csv")
    kept = [row["point"] for row in model]
    assert kept == [name for name in names_of("n", range(20)) if name != "n7"]

    truth = photos(film)[1][[int(name[1:]) - 1 for name in kept]]
    found = numbers(model, *(f"{axis}_bases" for axis in "XYZ"))
    assert np.sqrt(np.mean(similar(found, truth) ** 2)) < 0.01


def similar(found, truth):
    """What is left between points after the best shift, turn and scale."""
    a, b = found - found.mean(axis=0), truth - truth.mean(axis=0)
    u, s, v = np.linalg.svd(b.T @ a)
    proper = np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ v))])
    scale = np.trace(np.diag(s) @ proper) / np.sum(a**2)
    return b - scale * a @ (u @ proper @ v).T


@pytest.mark.slow
def test_several_images_are_calibrated_together(tmp_path):
    """Unknown points come out within their deviations."""
    rng = np.random.default_rng(6)
    points = rng.uniform([-3, -3, -2], [3, 3, 2], (24, 3))
    names, images = names_of("p", points), ("a", "b", "c")
    places = []
    for k, x in enumerate((-2.0, 0.0, 2.0)):
        angles = 0.1 * (-1) ** k, 0.12 * x, 0.8 * k
        places.append(taken(rng, points, np.array([x, 0.5 * k, 11.0]), angles))
    of_images = [name for name in images for _ in points]
    text = table("image,point,x,y", of_images, names * 3, *np.concatenate(places).T)
    unknown = np.arange(24) >= 12
    lines = [
        f"{name},,," if free else f"{name},{','.join(f'{c:.6f}' for c in point)}"
        for name, point, free in zip(names, points, unknown, strict=True)
    ]
    known = write(tmp_path, "point,X,Y,Z\n" + "\n".join(lines), "points.csv")
    asked = write(tmp_path, text, "images.csv"), "--object", known, "--sigma", SIGMA
    out = tmp_path / "out"
    told = run("calibrate", *asked, "--model", "brown", "--unit", "mm", "--out", out)
    assert told.exit_code == 0, told.stderr
    assert "3 images together, 1 camera" in told.stdout
    found = rows(out / "points.csv")
    values = numbers(found, "X", "Y", "Z")
    deviations = numbers(found, "s_X", "s_Y", "s_Z")
    w = (values - points)[unknown] / deviations[unknown]
    assert np.max(np.abs(w)) < 4.5 and 0.6 < np.sqrt(np.mean(w**2)) < 1.4
    cameras = rows(out / "cameras.csv")
    assert len(cameras) == 3 and len({row["x0"] for row in cameras}) == 1
    assert abs(float(cameras[0]["sigma0"]) - 1) < 0.3

    measured = calibration.images(
        *np.loadtxt(text.splitlines()[1:], delimiter=",", usecols=(2, 3)).T,
        np.repeat(np.arange(3), 24),
        np.tile(np.arange(24), 3),
        np.where(unknown[:, None], np.nan, np.round(points, 6)),
        sigma=SIGMA,
    )
    model = calibration.Model(brown=calibration.Brown())
    expected = calibration.calibrate_together(measured, model)
    stations = numbers(rows(out / "stations.csv"), "X", "Y", "Z")
    np.testing.assert_allclose(stations, expected.centres, atol=1e-5)


@pytest.mark.slow
def test_distances_stand_beside_coordinates(tmp_path):
    """The paper's form gives the same station."""
    rng = np.random.default_rng(7)
    points = rng.uniform([-4, -4, -2], [4, 4, 2], (16, 3))
    places = taken(rng, points, np.array([0.0, 0.0, 12.0]), (0.1, -0.1, 0.3))
    image, known = one_image(tmp_path, places, points)
    out = tmp_path / "out"
    told = run("calibrate", image, "--object", known, "--distances", "--out", out)
    assert told.exit_code == 0, told.stderr
    by_distances = numbers(rows(out / "distances.csv"), "value", "sd")
    (station,) = rows(out / "stations.csv")
    centre = np.array([float(station[axis]) for axis in "XYZ"])
    assert np.all(np.abs(by_distances[:3, 0] - centre) < 0.02 * by_distances[:3, 1])
    assert "by distances" in told.stdout


@pytest.mark.slow
def test_a_plane_object_needs_the_principal_place(tmp_path):
    """Else the result has no numbers, and the exit code says it."""
    rng = np.random.default_rng(8)
    points = rng.uniform([-4, -4, 0], [4, 4, 0], (24, 3))
    places = taken(rng, points, np.array([1.0, 0.0, 12.0]), (0.3, -0.2, 0.3))
    image, known = one_image(tmp_path, places, points)
    asked = "calibrate", image, "--object", known, "--model", "one-f"
    told = run(*asked, "--out", tmp_path / "out")
    assert told.exit_code == 1 and "plane_object" in told.stdout
    assert "--principal-point X Y" in words(told.stdout)
    (camera,) = rows(tmp_path / "out" / "cameras.csv")
    assert camera["result"] == "plane_object" and camera["x0"] == ""
    told = run(*asked, "--principal-point", 100, 50, "--principal-sigma", 0.01)
    assert told.exit_code == 0 and "One focal length, as asked." in told.stdout
    z = re.search(r"\bZ (\S+) (\S+)", words(told.stdout))
    assert z and abs(float(z[1]) - 12) < 0.05


IMAGE, OBJECT, OPTIONS = "image", "object", "options"
BAD = {  # the table, what stands there, what stands there instead, said
    "unknown point": (IMAGE, "c3,", "q3,", "line 4, column point: found 'q3'"),
    "point twice": (IMAGE, "c3,", "c2,", "line 4, column point: found 'c2' a second"),
    "a word": (IMAGE, "c1,", "c1,deep", "line 2, column x: found 'deep"),
    "no points in common": (IMAGE, "c", "k", "found no point of"),
    "unknown column": (IMAGE, "point,x,y", "point,x,z", "column z: found an unknown"),
    "point of the object twice": (OBJECT, "c3,", "c2,", "line 4, column point"),
    "half a point": (OBJECT, "c1,", "c1,,", "line 2"),
    "unknown model": (OPTIONS, "--model", "square", "--model: found 'square'"),
    "unknown zones": (OPTIONS, "--zones", "squares:3", "--zones: found 'squares:3'"),
    "borders that fall": (OPTIONS, "--zones", "rings:3,2", "borders have to grow"),
    "zones of y alone": (OPTIONS, "--zones-y", "rings:2", "it without --zones"),
    "zones without points": (OPTIONS, "--zones", "strips-x:9", "points for f of zone"),
    "negative sigma": (OPTIONS, "--sigma", "-1", "--sigma: found -1.0"),
    "a deviation of nothing": (OPTIONS, "--focal-sigma", "1", "it alone"),
    "mirrored": (OPTIONS, "--y-up", None, "an image that is mirrored then"),
    "pair of nothing": (OPTIONS, "--pair", "image,b", "it without --out"),
}


@pytest.fixture(scope="module")
def image_and_object():
    rng = np.random.default_rng(9)
    points = rng.uniform([-4, -4, -2], [4, 4, 2], (16, 3))
    return taken(rng, points, np.array([0.0, 0.0, 12.0]), (0.1, -0.1, 0.3)), points


SLOW = {"zones without points", "mirrored"}
CASES = [
    pytest.param(case, marks=pytest.mark.slow if case in SLOW else ()) for case in BAD
]


@pytest.mark.parametrize("case", CASES)
def test_bad_input_says_where_and_writes_nothing(case, image_and_object, tmp_path):
    which, old, new, said = BAD[case]
    image, known = one_image(tmp_path, *image_and_object)
    extra = []
    if which == OPTIONS:
        extra = [old] if new is None else [old, new]
    else:
        path = image if which == IMAGE else known
        text = path.read_text()
        assert old in text
        every = -1 if case == "no points in common" else 1
        path.write_text(text.replace(old, new, every))
    if "--pair" not in extra:
        extra += ["--out", tmp_path / "out"]
    told = run("calibrate", image, "--object", known, *extra)
    assert told.exit_code == 2, told.output
    assert said in words(told.stderr)
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_images_that_cannot_be_calibrated_are_named(tmp_path):
    control, _, known = files(tmp_path, 0.0)
    lines = control.read_text().splitlines()
    few = [line for line in lines if not line.startswith("right")] + lines[-3:]
    short = write(tmp_path, "\n".join(few), "few.csv")
    told = run("calibrate", short, "--object", known, "--separately")
    assert told.exit_code == 2
    assert "line 26, column point: found 3 known points in image 'right'" in words(
        told.stderr
    )
    told = run("calibrate", short, "--object", known)
    assert told.exit_code == 2 and "image 'right' has 3" in words(told.stderr)
    told = run(
        *("calibrate", control, "--object", known, "--separately"),
        *("--pair", "left,middle", "--out", tmp_path / "out"),
    )
    assert told.exit_code == 2 and "--pair: found 'left,middle'" in told.stderr
