"""Whether two images have the same distortion, as `jaxro calibrate --difference` tells
it."""

import jax.numpy as jnp
import numpy as np
import pytest
from bad_tables import write
from calibrate_command import SIGMA, names_of, numbers, table, taken
from command_line import rows, run, words

from jaxro import calibration
from jaxro.calibration import Brown, Comparison, Field, Model, Whole
from jaxro.calibration.choice import Figures
from jaxro.commands.calibration_tests import common_models

LENS = Model(brown=Brown())


def scene(seed, number=32):
    rng = np.random.default_rng(seed)
    points = np.round(rng.uniform([-4, -4, -2], [4, 4, 2], (number, 3)), 5)
    return rng, points


def two_photos(folder, film=0.0, few=None):
    """The tables of two photos of different points; the film of the right one is
    deformed. `few`: so many points are in the left one."""
    texts, points = ["image,point,x,y"], []
    for k, (name, x) in enumerate((("left", -2.0), ("right", 2.0))):
        rng, of_image = scene(k + 1)
        station, angles = np.array([x, 0.0, 12.0]), (0.05, -0.05 * x, 0.1 * x)
        places = taken(rng, of_image, station, angles, film=k * film)
        number = few if few and not k else len(places)
        lines = table(
            "image,point,x,y", [name] * len(places), names_of(name, places), *places.T
        )
        texts += lines.splitlines()[1 : number + 1]
        points.append((names_of(name, of_image), of_image))
    known = table(
        "point,X,Y,Z",
        [name for names, _ in points for name in names],
        *np.concatenate([of_image for _, of_image in points]).T,
    )
    return (
        write(folder, "\n".join(texts), "photos.csv"),
        write(folder, known, "points.csv"),
    )


def compare(folder, tables, *asked, model="brown"):
    photos, known = tables
    return run(
        *("calibrate", photos, "--object", known, "--separately", "--model", model),
        *("--sigma", SIGMA, "--unit", "mm", "--difference", "left,right"),
        *("--out", folder / "out", *asked),
    )


@pytest.mark.slow
@pytest.mark.parametrize("film", [0.0, 0.1])
def test_the_difference_of_two_distortions(film, tmp_path):
    """Map, test and what is taken out are those of Python."""
    tables = two_photos(tmp_path, film)
    told = compare(tmp_path, tables)
    assert told.exit_code == 0, told.stderr
    measured, known = (rows(path) for path in tables)
    at = {row["point"]: [float(row[axis]) for axis in "XYZ"] for row in known}
    both = []
    for name in ("left", "right"):
        own = [row for row in measured if row["image"] == name]
        points = np.array([at[row["point"]] for row in own])
        image = calibration.image(*numbers(own, "x", "y").T, points, sigma=SIGMA)
        both.append(calibration.calibrate(image, LENS, calibration.known()))
    found = calibration.difference(*both)
    assert (found.probability < 1e-6) == (film > 0)

    (tested,) = rows(tmp_path / "out" / "difference_tests.csv")
    assert (tested["above"], tested["below"]) == (str(found.above), str(found.below))
    figures = numbers([tested], "F", "p", "turn_x_deg", "shift_x", "shift_y")[0]
    expected = [found.f, found.probability, np.degrees(found.turn[0]), *found.shift]
    np.testing.assert_allclose(figures, expected, rtol=1e-4, atol=1e-12)
    nodes = rows(tmp_path / "out" / "difference.csv")
    np.testing.assert_allclose(numbers(nodes, "x", "y"), found.places, rtol=1e-9)
    assert np.all(np.abs(numbers(nodes, "dx", "dy") - found.difference) < 1e-4 * SIGMA)
    deviations = numbers(nodes, "s_dx", "s_dy")
    np.testing.assert_allclose(deviations, found.deviations, rtol=1e-4)
    w = numbers(nodes, "wx", "wy")
    np.testing.assert_allclose(w * deviations, numbers(nodes, "dx", "dy"), atol=1e-9)

    inside = [calibration.correct(one, found.places).inside for one in both]
    expected = inside[0] & inside[1]
    shown = np.array([node["inside"] == "true" for node in nodes])
    np.testing.assert_array_equal(shown, expected)
    verdict = "differ" if film else "do not differ visibly"
    said = words(told.stdout)
    assert (
        f"left and right {verdict} in distortion or focal length: F({found.above}, "
        in said
    )
    most = np.max(np.hypot(*found.difference[expected].T))
    assert f"Largest difference {most:.2g}"[:-1] in said


@pytest.mark.slow
def test_a_picture_shows_the_difference(tmp_path):
    pytest.importorskip("matplotlib")
    told = compare(tmp_path, two_photos(tmp_path, 0.1), "--refocused")
    assert told.exit_code == 0 and "differ in distortion: F(" in words(told.stdout)
    assert "focal length times" in words(told.stdout)
    picture = tmp_path / "out" / "difference.png"
    assert picture.read_bytes().startswith(b"\x89PNG")


@pytest.mark.slow
def test_an_image_that_cannot_be_used_is_not_compared(tmp_path):
    told = compare(tmp_path, two_photos(tmp_path, few=6))
    assert told.exit_code == 1
    assert "left and right are not compared" in words(told.stdout)
    assert "left cannot be used" in words(told.stdout)
    (tested,) = rows(tmp_path / "out" / "difference_tests.csv")
    assert tested["F"] == "" and not (tmp_path / "out" / "difference.csv").exists()


@pytest.mark.slow
def test_accuracies_that_differ_are_said(tmp_path):
    """The test takes both sigma0 to be the same."""
    photos, known = two_photos(tmp_path)
    rng = np.random.default_rng(8)
    lines = photos.read_text().splitlines()
    for k, line in enumerate(lines):
        if line.startswith("left"):
            image, point, x, y = line.split(",")
            noise = rng.normal(0, 3 * SIGMA, 2)
            lines[k] = f"{image},{point},{float(x) + noise[0]},{float(y) + noise[1]}"
    photos.write_text("\n".join(lines))
    asked = "calibrate", photos, "--object", known, "--separately", "--model", "brown"
    told = run(*asked, "--difference", "left,right")
    assert told.exit_code == 0
    assert "one is measured less accurately than the other" in words(told.stdout)


WRONG = {  # more options, said
    "unknown image": (["--difference", "left,middle"], "found 'left,middle'"),
    "one name": (["--difference", "left"], "found 'left'; expected LEFT,RIGHT"),
    "one image twice": (["--difference", "left,left"], "two images of"),
    "no distortion": (["--model", "one-f", "--refocused"], "have no distortion"),
}
CASES = [
    pytest.param(case, marks=pytest.mark.slow if case == "no distortion" else ())
    for case in WRONG
]


@pytest.mark.parametrize("case", CASES)
def test_what_cannot_be_compared_is_named(case, tmp_path):
    asked, said = WRONG[case]
    told = compare(tmp_path, two_photos(tmp_path), *asked)
    assert told.exit_code == 2 and "--difference" in told.stderr
    assert said in words(told.stderr)
    assert not (tmp_path / "out").exists()


def test_only_images_calibrated_separately_are_compared(tmp_path):
    photos, known = two_photos(tmp_path)
    asked = "calibrate", photos, "--object", known
    told = run(*asked, "--difference", "left,right")
    assert told.exit_code == 2
    assert "--difference: found it for images that are calibrated together" in words(
        told.stderr
    )
    assert "--separately beside it" in words(told.stderr)
    told = run("calibrate", "--difference", "left,right")
    assert told.exit_code == 2 and "'left,right' for one image" in words(told.stderr)
    told = run(*asked, "--separately", "--refocused")
    assert told.exit_code == 2 and "--refocused: found it alone" in words(told.stderr)


def test_the_models_by_which_both_images_are_compared():
    """All coefficients of the lens first; else the evidence of both together."""
    film = Model(brown=Brown(), field=Field(0.8, 10.0))
    models = Model(), Model(y=Whole()), LENS, film

    def of(*scores):
        nothing = jnp.zeros(4)
        figures = Figures(jnp.array(scores), nothing, nothing, nothing, jnp.arange(4))
        return Comparison(models, figures)

    found = common_models(of(0.0, 9.0, 50.0, 49.0), of(0.0, 1.0, 50.0, 52.0))
    assert found == [LENS, Model()]
    found = common_models(of(9.0, 0.0, 5.0, 1.0), of(2.0, 1.0, np.inf, 2.0))
    assert found == [film, Model(y=Whole())]
