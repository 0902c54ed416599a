"""The standard deviation of a table from its own residuals: against the truth, and what
is cleaned with it."""

import csv
import json

import jax
import numpy as np
import pytest
from typer.testing import CliRunner
from workload import FOCAL, aerial, any_position, with_wrong_points

import jaxro
from jaxro.batches import table_noise
from jaxro.cli import app
from jaxro.rejection import Recommended

SIGMA = 0.01


def measured(make, pairs: int, points: int, share: float, seed: int = 7):
    """Pairs that state no standard deviation, and which of their points are wrong."""
    photos, wrong = with_wrong_points(
        make(pairs, points, sigma=SIGMA, seed=seed), share, seed=seed
    )
    return jaxro.pair(*photos, focal=FOCAL), wrong


def pose_of(rejection):
    return rejection.orientation.pose


def right(pairs, poses) -> float:
    """The share of the pairs that are oriented within 0.05° of these poses after
    cleaning."""
    found = jaxro.clean_batch(pairs, Recommended(), select=pose_of)
    turns = [
        np.stack([np.asarray(a) for a in jax.tree.leaves(pose)[:4]])
        for pose in (found, poses)
    ]
    angle = 2 * np.arccos(np.minimum(np.abs(np.sum(turns[0] * turns[1], axis=0)), 1))
    return float(np.mean(angle < np.deg2rad(0.05)))


def compared(make, tables: int, pairs: int, points: int, share: float):
    """The noise of each of some tables over the truth, and by how much more of its
    pairs are right than with the true sigma."""
    ratios, gains = [], []
    for seed in range(7, 7 + tables):
        table, wrong = measured(make, pairs, points, share, seed)
        noise = table_noise.estimate(table)
        assert noise.deviation < 0.1 * SIGMA and noise.pairs > 0.8 * noise.asked
        poses = jaxro.orient_batch(table.with_mask(~wrong), select=lambda o: o.pose)
        given = table_noise.TableNoise(SIGMA, 0.0, 0, 0).applied(table)
        ratios.append(noise.sigma / SIGMA)
        gains.append(right(noise.applied(table), poses) - right(given, poses))
    return np.array(ratios), np.array(gains)


CASES = [(any_position, 1, 12, 50, 0.3, 0.15)] + [
    (make, 5, 64, points, share, 0.1)
    for make in (aerial, any_position)
    for points in (16, 50, 200)
    for share in (0.0, 0.3, 0.5)
    if (points, share) != (16, 0.5)
]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("make", "tables", "pairs", "points", "share", "within"), CASES
)
def test_the_table_tells_its_noise_and_is_cleaned_as_well_with_it(
    make, tables, pairs, points, share, within
):
    """The median of tables within a tenth of the truth, one of few pairs within a
    little more; and on the average no fewer right orientations than with the true
    sigma."""
    ratios, gains = compared(make, tables, pairs, points, share)
    assert abs(np.median(ratios) - 1) < within
    assert np.mean(gains) >= -0.02


@pytest.mark.slow
@pytest.mark.parametrize("make", [aerial, any_position])
def test_half_of_sixteen_points_wrong_tells_no_noise(make):
    """Few of the pairs have eight right points so near their pose that they are no
    accident, by chance: their noise is two thirds of that of the others."""
    table, _ = measured(make, 64, 16, 0.5, 7)
    with pytest.raises(
        ValueError, match=r"of 64 pairs have enough .* state the standard deviation"
    ):
        table_noise.estimate(table)


@pytest.fixture(scope="module")
def small():
    """A table of few pairs, and its noise."""
    pairs, _ = measured(any_position, 6, 50, 0.2)
    return pairs, table_noise.estimate(pairs)


@pytest.mark.slow
def test_sigma_is_in_the_unit_of_the_coordinates_and_a_multiple_of_the_pair_s(small):
    """Another unit, or a stated sigma, changes the number accordingly; lists, ragged
    pairs and batches agree."""
    pairs, noise = small
    pixels = jaxro.pair(
        *(200 * np.asarray(c) for c in pairs.coordinates), focal=200 * FOCAL
    )
    np.testing.assert_allclose(
        table_noise.estimate(pixels).sigma, 200 * noise.sigma, rtol=1e-6
    )
    stated = table_noise.TableNoise(0.5 * SIGMA, 0.0, 0, 0).applied(pairs)
    np.testing.assert_allclose(
        table_noise.estimate(stated).sigma, noise.sigma / (0.5 * SIGMA), rtol=1e-6
    )
    singly = jaxro.unstack(pairs)
    assert (
        table_noise.estimate(singly)
        == table_noise.estimate(jaxro.join(singly))
        == noise
    )


@pytest.mark.slow
def test_what_tells_no_noise_is_refused():
    """Pairs of five points, and pairs without a common point; as many places as above,
    so that the same programs serve."""
    pairs, _ = measured(aerial, 6, 50, 0.0)
    five = pairs.with_mask(np.broadcast_to(np.arange(50) < 5, (6, 50)))
    with pytest.raises(ValueError, match=r"six points.* state the standard deviation"):
        table_noise.estimate(five)
    rng = np.random.default_rng(8)
    strangers = jaxro.pair(*rng.uniform(-70, 70, (4, 6, 50)), focal=FOCAL)
    with pytest.raises(
        ValueError,
        match=r"agree with one pose of their pair; state the standard deviation",
    ):
        table_noise.estimate(strangers)


def written(path, pairs):
    """A table of these pairs."""
    columns = [np.asarray(c) for c in pairs.coordinates]
    with path.open("w", newline="") as file:
        table = csv.writer(file)
        table.writerow(["pair", "point", "x_left", "y_left", "x_right", "y_right"])
        for k, i in np.ndindex(columns[0].shape):
            table.writerow([f"p{k:02}", i, *(repr(float(c[k, i])) for c in columns)])
    return path


def run(*arguments):
    result = CliRunner().invoke(
        app, [*map(str, arguments), "--focal", FOCAL], env={"COLUMNS": "200"}
    )
    assert result.exception is None or isinstance(result.exception, SystemExit), (
        result.exception
    )
    return result


@pytest.mark.slow
def test_auto_on_the_command_line(small, tmp_path):
    """The number taken is told, stands in the summaries, and gives what it gives when
    it is stated; part by part the same, and after a run that was stopped."""
    pairs, noise = small
    table, cheap = (
        written(tmp_path / "pairs.csv", pairs),
        ("--procedure", "three-sigma"),
    )
    outs = [tmp_path / name for name in ("auto", "stated", "parts")]
    found = run("clean", table, *cheap, "--sigma", "auto", "--out", outs[0])
    told = (
        f"sigma {noise.sigma:.5f} ± {noise.deviation:.5f} mm, from the residuals of "
        f"{noise.pairs} pairs"
    )
    assert told in " ".join(found.stdout.split()), found.stdout
    summaries = [
        json.loads((outs[0] / name).read_text())
        for name in ("summary.json", "decisions.json")
    ]
    assert summaries[0]["sigma"] == noise.sigma
    assert all(
        summary["sigma_from_residuals"] == noise._asdict() for summary in summaries
    )
    run("clean", table, *cheap, "--sigma", repr(noise.sigma), "--out", outs[1])
    for name in ("elements.csv", "cleaned.csv", "reliability.csv"):
        assert (outs[0] / name).read_bytes() == (outs[1] / name).read_bytes()
    pytest.importorskip("pyarrow")
    found = run("orient", table, "--parquet", "--sigma", "auto", "--out", outs[2])
    assert f"from the residuals of {noise.pairs} pairs" in found.stdout
    summary = json.loads((outs[2] / "summary.json").read_text())
    assert (
        summary["sigma"] == noise.sigma
        and summary["sigma_from_residuals"] == noise._asdict()
    )


def test_what_auto_cannot_do_is_told(tmp_path):
    """A word that is none, a table of five points, and a table that states its
    sigma."""
    five = written(tmp_path / "five.csv", measured(aerial, 2, 5, 0.0)[0])
    found = run("clean", five, "--sigma", "aut")
    assert (
        found.exit_code == 2
        and "found 'aut'; expected a standard deviation such as 0.005, or auto"
        in found.stderr
    )
    found = run("orient", five, "--sigma", "auto")
    assert (
        found.exit_code == 2
        and "auto, but no pair has six points" in found.stderr
        and "--sigma SD" in found.stderr
    )
    text = five.read_text().splitlines()
    stated = tmp_path / "stated.csv"
    stated.write_text(
        "\n".join([text[0] + ",sigma", *(f"{line},0.01" for line in text[1:])]) + "\n"
    )
    found = run("clean", stated, "--sigma", "auto")
    assert found.exit_code == 2 and "beside the column sigma" in found.stderr
