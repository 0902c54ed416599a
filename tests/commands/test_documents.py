"""What calls make for programs and people beside their tables: JSON, pages, pictures,
pose graphs; and what is refused before anything is written."""

import json

import examples
import numpy as np
import pytest
from command_line import run, words
from tiers import seldom


@pytest.mark.parametrize("name", seldom(examples.ARGUMENTS, ["orient", "block"]))
def test_json_is_the_summary_and_nothing_else(name, example):
    told = example(name)
    assert told.json_code == 0
    said = json.loads(told.json)
    summary = json.loads((told.out / "summary.json").read_text())
    assert (said["orientation"] if name == "clean" else said) == summary
    assert said["program"].startswith("jaxro ")


@pytest.mark.slow
def test_a_pose_graph_of_a_strip(tmp_path):
    """Photos that share points: every edge has the length that the points tell."""
    random = np.random.default_rng(3)
    focal, photos, points = 150.0, 4, 60
    places = np.stack(
        [
            random.uniform(-60, 60 + 90 * (photos - 1), points),
            random.uniform(-80, 80, points),
            -150 * random.uniform(0.9, 1.1, points),
        ],
        axis=-1,
    )
    rows = ["left,right,point,x_left,y_left,x_right,y_right"]
    for k in range(photos - 1):
        seen = [
            -focal * (p := places - [90.0 * i, 0, 0])[:, :2] / p[:, 2:]
            for i in (k, k + 1)
        ]
        both = np.flatnonzero(np.all(np.abs(np.hstack(seen)) < 115, axis=1))
        for i in both:
            numbers = np.hstack([s[i] for s in seen]) + random.normal(0, 0.004, 4)
            rows.append(f"p{k},p{k + 1},t{i}," + ",".join(f"{v:.4f}" for v in numbers))
    table = tmp_path / "strip.csv"
    table.write_text("\n".join(rows) + "\n")
    graph = tmp_path / "strip.g2o"
    told = run("orient", table, "--focal", focal, "--sigma", "0.004", "--g2o", graph)
    assert told.exit_code == 0 and "4 photos, 3 edges" in words(told.stdout)
    lines = [line.split() for line in graph.read_text().splitlines()]
    edges = [line for line in lines if line[0] == "EDGE_SE3:QUAT"]
    lengths = [np.linalg.norm(np.array(line[3:6], float)) for line in edges]
    assert np.allclose(lengths, 1.0, atol=2e-3)
    assert all(len(line) == 3 + 7 + 21 for line in edges)


@pytest.mark.slow
def test_what_cannot_be_made_is_refused_before_anything_is_written(tmp_path):
    table = tmp_path / "pairs.csv"
    table.write_text(
        "pair,point,x_left,y_left,x_right,y_right\n"
        + "".join(f"a,{i},{i},{i * i},{i - 9},{i * i}\n" for i in range(6))
    )
    for options, word in (
        (("--g2o", tmp_path / "graph.g2o"), "photos"),
        (("--parquet", "--report", tmp_path / "page.html"), "--report"),
        (("--parquet", "--json"), "--json"),
        (("--report", tmp_path / "page.docx"), ".pdf"),
    ):
        out = tmp_path / "out"
        refused = run("orient", table, "--focal", "150", "--out", out, *options)
        assert refused.exit_code == 2 and word in refused.stderr
        assert [path.name for path in tmp_path.iterdir()] == ["pairs.csv"]
