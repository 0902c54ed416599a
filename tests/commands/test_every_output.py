"""Every kind of input with every kind of output: each combination runs.

One scene in all kinds of files. The photos have a lens or unequal focal lengths, so that
the coordinates have covariances: what knows only equal accuracy is met as well.
"""

import json

import command_line
import numpy as np
import pixel_scene as scene
import pytest
from tiers import seldom

from jaxro import exchange
from jaxro.commands.block_request import Options, prepare
from jaxro.commands.request import Options as Measured
from jaxro.reports.files import columns_text
from jaxro.tables import cameras

pycolmap = pytest.importorskip("pycolmap", reason="pycolmap writes the models")
h5py = pytest.importorskip("h5py", reason="HDF5 files need h5py")
pa = pytest.importorskip("pyarrow")
pq = pytest.importorskip("pyarrow.parquet")

COUNT, SIGMA, PHOTOS = 14, 0.3, ("a.jpg", "b.jpg", "c.jpg")
K = np.array([[812.0, 0, 330.0], [0, 790.0, 236.0], [0, 0, 1]])
FOCAL, K1 = 700.0, -0.1


def pixels_of(number):
    """The places of all points on a photo, with errors of SIGMA."""
    errors = np.random.default_rng(number).normal(0, SIGMA, (COUNT, 2))
    return scene.pixels(scene.rays(scene.points(COUNT), number), K) + errors


def write_bundler(path):
    """Photos with a lens, places in its axes: y up, from the centre."""
    zero = "1 0 0\n0 1 0\n0 0 1\n0 0 0\n"
    text = f"# Bundle file v0.3\n3 {COUNT}\n" + 3 * f"{FOCAL} {K1} 0\n{zero}"
    seen = [(pixels_of(n) - K[:2, 2]) / K[[0, 1], [0, 1]] for n in range(3)]
    for point in range(COUNT):
        views = []
        for n in range(3):
            u, v = seen[n][point] * (1 + K1 * np.sum(seen[n][point] ** 2))
            views.append(f"{n} {point} {FOCAL * u:.12f} {-FOCAL * v:.12f}")
        text += f"0 0 0\n0 0 0\n3 {' '.join(views)}\n"
    path.write_text(text)


def write_colmap(folder):
    """A model as text."""
    folder.mkdir()
    (folder / "cameras.txt").write_text("1 PINHOLE 640 480 812 790 330 236\n")
    images = []
    for n, name in enumerate(PHOTOS):
        keypoints = [
            f"{x!r} {y!r} {k + 1}" for k, (x, y) in enumerate(pixels_of(n).tolist())
        ]
        images += [f"{n + 1} 1 0 0 0 0 0 0 1 {name}", " ".join(keypoints)]
    (folder / "images.txt").write_text("\n".join(images) + "\n")
    tracks = lambda k: " ".join(f"{n + 1} {k}" for n in range(3))
    points = [f"{k + 1} 0 0 5 0 0 0 0.5 {tracks(k)}\n" for k in range(COUNT)]
    (folder / "points3D.txt").write_text("".join(points))


def write_h5(path):
    """The same pairs, each for itself."""
    with h5py.File(path, "w") as file:
        for name, photos in (("x", (0, 1)), ("y", (0, 2)), ("z", (1, 2))):
            group = file.create_group(name)
            for side, n in enumerate(photos, 1):
                group[f"x{side}"], group[f"camera{side}"] = pixels_of(n), K


def write_tables(folder, found):
    """A CSV and a Parquet table of what was found in a file, with its cameras."""
    table = found.table.with_sigma(SIGMA)
    columns = {
        "pair": table.names[table.owners],
        **table.photos_of_rows,
        "point": table.points,
        **table.numbers,
    }
    lists = {name: column.tolist() for name, column in columns.items()}
    (folder / "pairs.csv").write_text(columns_text(lists))
    pq.write_table(pa.table(lists), folder / "pairs.parquet")
    focals = {name: camera.focal for name, camera in found.cameras.photos.items()}
    (folder / "cameras.toml").write_text(cameras.text_of(focals))


@pytest.fixture(scope="module")
def inputs(tmp_path_factory):
    """By kind the words of the command line that name the input."""
    folder = tmp_path_factory.mktemp("inputs")
    write_bundler(folder / "bundle.out")
    write_colmap(folder / "text")
    (folder / "binary").mkdir()
    model = pycolmap.Reconstruction()
    model.read_text(str(folder / "text"))
    model.write_binary(str(folder / "binary"))
    write_h5(folder / "pairs.h5")
    write_tables(folder, exchange.read(folder / "text"))
    given = ["--camera", folder / "cameras.toml", "--unit", "px"]
    sigma = ["--sigma", SIGMA]
    files = {
        name: [folder / name, *sigma]
        for name in ("bundle.out", "text", "binary", "pairs.h5")
    }
    return files | {
        name: [folder / name, *given] for name in ("pairs.csv", "pairs.parquet")
    }


INPUTS = ("bundle.out", "text", "binary", "pairs.h5", "pairs.csv", "pairs.parquet")

OUTPUTS = {
    "files": ("--out", "OUT"),
    "json": ("--json",),
    "page": ("--report", "OUT/report.html"),
    "pictures": ("--plots", "OUT"),
    "all": ("--out", "OUT", "--plots", "OUT", "--report", "OUT/page.html"),
    "graph": ("--g2o", "OUT/pairs.g2o"),
    "parquet": ("--parquet", "--out", "OUT"),
}


def run(command, words, output, out):
    """A call with an output into a folder."""
    more = [word.replace("OUT", str(out)) for word in OUTPUTS[output]]
    return command_line.run(command, *words, *more)


QUICK = ("orient", "pairs.csv", "all"), ("clean", "bundle.out", "json")
"""One way through each command; every further one is a program or two, or pictures."""


def cases(command, *without):
    """Inputs with outputs."""
    for kind in INPUTS:
        for output in OUTPUTS:
            if output in without:
                continue
            quick = (command, kind, output) in QUICK
            marks = [] if quick else [pytest.mark.slow]
            yield pytest.param(command, kind, output, marks=marks)


@pytest.mark.parametrize(
    ("command", "kind", "output"), [*cases("orient"), *cases("clean", "graph")]
)
def test_every_output_of_every_input(command, kind, output, inputs, tmp_path):
    out = tmp_path / "out"
    done = run(command, inputs[kind], output, out)
    assert done.exit_code == 0, done.output
    assert output == "json" or any(out.iterdir())


@pytest.mark.parametrize("kind", seldom(INPUTS[:-1], []))
def test_what_was_cleaned_is_read_again_to_the_same_result(kind, inputs, tmp_path):
    """Kept points of cleaned.csv, with the cameras that stand beside it."""
    out = tmp_path / "out"
    assert command_line.run("clean", *inputs[kind], "--out", out).exit_code == 0
    given = inputs[kind][1:]
    if (out / "cameras.toml").exists():
        given = ["--camera", out / "cameras.toml", "--unit", "px"]
    again = command_line.run("orient", out / "cleaned.csv", *given, "--json")
    pairs = [
        json.loads(text)["pairs"]
        for text in ((out / "summary.json").read_text(), again.stdout)
    ]
    for one, other in zip(*pairs, strict=True):
        assert one["pair"] == other["pair"] and one["points"] == other["points"]
        values = [
            [e[key] for e in pair["elements"].values() for key in ("value", "sd")]
            for pair in (one, other)
        ]
        np.testing.assert_allclose(*values, rtol=1e-4, atol=1e-7)
        assert one["sigma0"] == pytest.approx(other["sigma0"], rel=1e-5)


@pytest.mark.parametrize("kind", ["bundle.out", "pairs.h5"])
def test_parquet_results_of_another_program_are_its_csv_results(kind, inputs, tmp_path):
    """Covariances, relative until --sigma is known, go through a table in between."""
    csv, parquet = tmp_path / "csv", tmp_path / "parquet"
    assert run("orient", inputs[kind], "files", csv).exit_code == 0
    assert run("orient", inputs[kind], "parquet", parquet).exit_code == 0
    expected = command_line.rows(csv / "elements.csv")
    found = pq.read_table(parquet / "elements").to_pylist()
    for name in ("bx", "sd_bx", "omega_deg", "sd_omega_deg", "sigma0"):
        numbers = [float(row[name]) for row in expected]
        np.testing.assert_allclose([row[name] for row in found], numbers, rtol=1e-9)


SEPARATORS = {"tabs.csv": "\t", "semicolons.csv": ";"}


@pytest.fixture(scope="module")
def blocks(inputs):
    """The inputs that hold a block, and its table with other separators."""
    blocks = {kind: words for kind, words in inputs.items() if kind != "pairs.h5"}
    table, *given = inputs["pairs.csv"]
    for kind, separator in SEPARATORS.items():
        other = table.with_name(kind)
        other.write_text(table.read_text().replace(",", separator))
        blocks[kind] = [other, *given]
    return blocks


def ground_of(kind, folder):
    """A table of control, with the names that a file gives its points."""
    first = 0 if kind == "bundle.out" else 1
    lines = [
        f"{first + k},{x!r},{y!r},{z!r},0.001,{'check' if k >= 8 else ''}"
        for k, (x, y, z) in enumerate(scene.points(COUNT).tolist())
    ]
    path = folder / "ground.csv"
    path.write_text("\n".join(["point,X,Y,Z,sigma,role", *lines]))
    return path


@pytest.mark.parametrize(
    "kind", [*(kind for kind in INPUTS if kind != "pairs.h5"), *SEPARATORS]
)
def test_a_block_is_the_same_from_every_input(kind, blocks, tmp_path):
    """Photos, points and control find each other, and the places are those of the
    scene."""
    path, *_, value = blocks[kind]
    given = {"camera": path.with_name("cameras.toml"), "unit": value}
    if "pairs" not in kind and kind not in SEPARATORS:
        given = {"sigma": str(value)}
    measured = Measured(file=path, **given)
    task, _ = prepare(Options(measured=measured, control=ground_of(kind, tmp_path)))
    block, ground = task.more, task.ground
    assert len(block.photos) == 3 and len(block.photo) == 3 * COUNT
    assert sorted(ground.points) == sorted(block.points) and sum(ground.check) == 6
    for number in range(3):
        rows = np.flatnonzero(block.photo == number)
        names = [
            int(block.points[k]) - (kind != "bundle.out") for k in block.point[rows]
        ]
        expected = (pixels_of(number) - K[:2, 2]) / K[[0, 1], [0, 1]] * [1, -1]
        seen = np.stack([block.x, block.y], axis=1)[rows] / block.focal[number]
        np.testing.assert_allclose(seen, expected[names], atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["bundle.out", "binary", "semicolons.csv"])
def test_a_block_of_every_input_is_true(kind, blocks, tmp_path):
    out = tmp_path / "out"
    control = "--control", ground_of(kind, tmp_path)
    done = command_line.run("block", *blocks[kind], *control, "--out", out)
    assert done.exit_code == 0, done.output
    told = json.loads((out / "summary.json").read_text())
    assert told["check_points"] == 6 and 0.6 < told["sigma0"] < 1.4


def test_pairs_that_nothing_joins_are_no_block(inputs):
    done = command_line.run("block", *inputs["pairs.h5"])
    assert done.exit_code == 2 and "photos and points of their own" in done.stderr


@pytest.mark.slow
def test_rejected_points_of_a_table_are_left_out(tmp_path):
    """Other verdicts than those that a cleaning writes are no verdicts."""
    header = "point,x_left,y_left,x_right,y_right,verdict,q_mm\n"
    table = tmp_path / "cleaned.csv"
    lines = [f"{k},{k},{k * k},{k - 9},{k * k},kept,0.1\n" for k in range(7)]
    table.write_text(header + "".join(lines) + "wrong,90,90,0,0,rejected,9.9\n")
    told = command_line.run("orient", table, "--focal", 100, "--json")
    assert json.loads(told.stdout)["pairs"][0]["points"] == 7
    assert "1 point is left out" in told.stderr
    table.write_text(header + lines[0].replace("kept", "keep"))
    told = command_line.run("orient", table, "--focal", 100)
    assert told.exit_code == 2 and "line 2, column verdict: found 'keep'" in told.stderr
