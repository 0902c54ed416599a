"""`--plots` and the power of procedures: which pictures there are, and of what."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from command_line import run

import jaxro
from jaxro.commands import orient as jobs, plots as pictures
from jaxro.commands.clean import SIMULATED
from jaxro.commands.documents import Documents
from jaxro.commands.request import Options
from jaxro.experiments.compare import Comparison, Estimate, Score, Setting
from jaxro.reports import pair_plots
from jaxro.reports.columns import RESULT_NAMES
from jaxro.tables.fields import TableError

pytest.importorskip("matplotlib")

OF_A_PAIR = {"residuals", "tests", "leave_one_out", "influence", "model"}
NONE = Estimate(np.nan, np.nan)


def score(procedure, errors, size, found, alarms, *, calibrated=False):
    return Score(
        setting=Setting("rows", errors, size),
        procedure=procedure,
        calibrated=calibrated,
        trials=10,
        found=Estimate(found, 0.01),
        misnamed=NONE,
        lost=NONE,
        perfect=NONE,
        alarms=Estimate(alarms, 0.0),
        unfinished=NONE,
        angle=NONE,
    )


SCORES = [
    score(name, errors, size, found / (1 + calibrated), 0.1, calibrated=calibrated)
    for calibrated in (False, True)
    for name in ("one", "two")
    for errors, size, found in ((0, 0.0, 0.0), (1, 4.0, 0.4), (1, 8.0, 0.8))
]


def table_of_pairs(folder: Path, number: int) -> Path:
    """Pairs of ten points, each much noisier than the one before; the last has four points."""
    rng = np.random.default_rng(1)
    layout = jaxro.mock_pairs.row_layout()
    exact = jaxro.mock_pairs.mock_pair(layout, heights=rng.uniform(-5, 5, 16))
    lines = ["pair,point,x_left,y_left,x_right,y_right"]
    at = np.stack([np.asarray(c) for c in exact.coordinates])
    for k in range(number):
        places = at + rng.normal(0, 0.001 * 4.0**k, at.shape)
        for i in range(4 if k == number - 1 else 10):
            lines.append(
                ",".join([f"pair {k}", f"p{i}", *map(repr, places[:, i].tolist())])
            )
    file = folder / "pairs.csv"
    file.write_text("\n".join(lines) + "\n")
    return file


def check_model(monkeypatch, options, procedure=None):
    """Model and covariances of the first pair, which are read from the columns of a
    report, are those of the orientation."""
    pictures_wanted = Documents(plots=Path("pictures"))
    options = replace(options, documents=pictures_wanted)
    job = jobs.prepare(options, SIMULATED, procedure)
    results, verdicts = jobs.solve_table(job, lambda done: None)
    one, seen = pair_plots.One(results, 0), []
    keep = lambda model, covariances, **more: seen.append((model, covariances))
    monkeypatch.setattr(jaxro.plots, "draw_model_errors", keep)
    pair_plots.draw_model(one)
    ((shown, covariances),) = seen
    _, pair, _ = pair_plots.measured(one, verdicts)
    kept = np.asarray(pair.mask)
    orientation = jaxro.orient(pair, elements=results.system, base=options.base)
    model = np.stack([np.asarray(c) for c in orientation.model], axis=-1)
    expected = jaxro.plots.model_covariances(pair, orientation)
    np.testing.assert_allclose(shown, model[kept], atol=1e-8)
    np.testing.assert_allclose(covariances, expected[kept], rtol=1e-6)
    return kept


def test_a_cleaned_pair_has_all_pictures(example):
    told = example("clean")
    assert told.exit_code == 0
    made = {path.stem: path.read_bytes() for path in told.plots.iterdir()}
    assert set(made) == OF_A_PAIR
    assert {content[:4] for content in made.values()} == {b"\x89PNG"}


@pytest.mark.slow
def test_the_wrong_point_takes_no_part_in_the_model(monkeypatch):
    """And a given base is its scale."""
    options = Options(elements="independent", base=65.0)
    kept = check_model(monkeypatch, options, jaxro.rejection.Dorozhinsky())
    assert np.flatnonzero(~kept).tolist() == [6]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "base"), [("relative", None), ("dependent", 65.0)], ids=str
)
def test_a_given_sigma_changes_no_accuracy_a_posteriori(
    tmp_path, monkeypatch, name, base
):
    file = table_of_pairs(tmp_path, 2)
    more = {"focal": 70.0, "sigma": "0.02", "base": base}
    check_model(monkeypatch, Options(file=file, elements=name, **more))


@pytest.mark.slow
def test_of_many_pairs_the_worst_are_drawn(tmp_path):
    """The pair that failed comes first, then those of the largest m_q."""
    file = table_of_pairs(tmp_path, 6)
    out = tmp_path / "out"
    told = run("orient", file, "--focal", "70", "--plots", out)
    assert told.exit_code == 1
    made = sorted(path.stem for path in out.iterdir())
    ranks = {name.split("_")[1] for name in made if name != "sigma0"}
    assert "sigma0" in made and ranks == {"1", "2", "3"}
    assert [name for name in made if "worst_1" in name] == ["worst_1_pair_5_residuals"]
    assert {f"worst_2_pair_4_{name}" for name in OF_A_PAIR} <= set(made)


def test_a_picture_of_power_for_each_setting():
    """Curves are sorted by procedure; false alarms are those of the same version."""
    alarms = [s for s in SCORES if not s.setting.errors]
    wrong = [s for s in SCORES if s.setting.errors]
    for calibrated, part in ((False, 1.0), (True, 0.5)):
        one, two = pictures.curves(wrong, alarms, calibrated=calibrated)
        assert (one.procedure, two.procedure) == ("one", "two")
        np.testing.assert_allclose(one.sizes, [4.0, 8.0])
        np.testing.assert_allclose(two.found, [0.4 * part, 0.8 * part])
        assert one.false_alarms == 0.1
    found = Comparison(SCORES, 0.05, {})
    svg = pictures.picture_of_comparison(found, Path("power.SVG")).decode()
    assert svg.count("1 wrong point, as they are") >= 1
    assert "1 wrong point, equal false alarms" in svg and "rows" in svg
    alone = replace(found, scores=[s for s in SCORES if not s.calibrated])
    assert pictures.picture_of_comparison(alone, Path("power.pdf"))[:4] == b"%PDF"
    with pytest.raises(TableError, match="no setting with wrong points"):
        pictures.picture_of_comparison(replace(found, scores=alarms), Path("a.png"))


def test_a_picture_needs_a_name_that_tells_its_format():
    pictures.check_picture(None)
    pictures.check_picture(Path("power.PNG"))
    with pytest.raises(TableError, match=r"ends in \.png, \.svg, \.pdf"):
        pictures.check_picture(Path("power.jpg"))


def test_names_of_pairs_become_names_of_files():
    assert pictures.file_name("../a b/ö:1") == "_a_b_ö_1"
    assert len(pictures.file_name("x" * 200)) == 60


def test_failed_pairs_are_the_worst():
    number = {name: k for k, name in RESULT_NAMES.items()}
    good, bad = number["successful"], number["diverged"]
    result, m_q = (
        np.array([good, bad, good, good]),
        np.array([1.0, np.nan, 3.0, np.nan]),
    )
    assert pair_plots.order(result, m_q).tolist() == [1, 2, 0, 3]
