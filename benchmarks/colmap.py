"""The suites of COLMAP databases: `jaxro colmap` against COLMAP's own geometric
verification of the same database."""

import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np

from jaxro.commands.colmap import Options, orient_database

from .common import Size, rate, ratio
from .metrics import Metric, median_seconds

NOISE, WRONG = 1.0, 0.3
"""Pixels, and the share of wrong matches."""
PAIRS, WIDE_PAIRS = 250, 50
"""Times `Size.robust`: of the pinhole camera, and of each fisheye."""


def verify(before: Path, after: Path, pose: bool) -> None:
    """COLMAP's geometric verification of a copy."""
    import pycolmap

    shutil.copy(before, after)
    pycolmap.geometric_verification(
        str(after),
        two_view_geometry_options=pycolmap.TwoViewGeometryOptions(
            compute_relative_pose=pose
        ),
    )


def compare(own, other, name: str) -> list[Metric]:
    """The two verdicts; jaxro's poses have to be right as often as COLMAP's."""
    metrics = []
    for k, what in enumerate(
        ("within 0.1° of the truth", "right matches kept", "wrong of those kept")
    ):
        better = "lower" if k == 2 else "higher"
        metrics += [
            Metric(
                f"{name}: {what}, jaxro",
                own[k],
                "of 1",
                better,
                tolerance=0.02 if k < 2 else 0.5,
                goal=other[k] if k == 0 else None,
            ),
            Metric(f"{name}: {what}, COLMAP", other[k], "of 1", better, np.inf),
        ]
    return metrics


def colmap(size: Size) -> list[Metric]:
    """200 to 1,000 matches a pair, 30 % of them wrong, noise of a pixel; from database
    to database, both cores."""
    import pycolmap

    from .databases import FEWEST, MOST, judge, write_pinhole

    pycolmap.logging.minloglevel = 2
    pairs = PAIRS * size.robust if size.robust > 1 else 40
    rng = np.random.default_rng(0)
    counts = rng.integers(FEWEST, MOST + 1, pairs)
    with tempfile.TemporaryDirectory() as folder:
        before, ours, theirs = (
            Path(folder) / f"{name}.db" for name in ("before", "ours", "theirs")
        )
        truth = write_pinhole(before, counts, rng, NOISE, WRONG)

        def jaxro() -> None:
            orient_database(Options(before, sigma=NOISE, out=ours, force=True))

        first = median_seconds({"first": jaxro}, 1)["first"]
        verify(before, theirs, pose=True)
        name = "COLMAP database"
        metrics = compare(judge(ours, truth), judge(theirs, truth), name)
        contestants: dict[str, Callable[[], object]] = {
            "jaxro": jaxro,
            "colmap": lambda: verify(before, theirs, pose=False),
        }
        seconds = median_seconds(contestants, min(size.repeats, 5))
    return [
        *metrics,
        rate(f"{name}: jaxro", seconds["jaxro"] / pairs),
        rate(f"{name}: COLMAP's verification", seconds["colmap"] / pairs),
        ratio(f"{name}: against COLMAP", seconds["colmap"], seconds["jaxro"], 10),
        Metric(
            f"{name}: compilation at the first call",
            first - seconds["jaxro"],
            "s",
            "lower",
            0.5,
        ),
    ]


def colmap_fisheye(size: Size) -> list[Metric]:
    """The same of cameras with a field of 150°, by model."""
    import pycolmap

    from .databases import FEWEST, FISHEYES, MOST, judge, write_fisheye

    pycolmap.logging.minloglevel = 2
    pairs = WIDE_PAIRS * size.robust if size.robust > 1 else 10
    metrics = []
    for model in FISHEYES:
        rng = np.random.default_rng(0)
        counts = rng.integers(FEWEST, MOST + 1, pairs)
        with tempfile.TemporaryDirectory() as folder:
            before, ours, theirs = (
                Path(folder) / f"{name}.db" for name in ("before", "ours", "theirs")
            )
            truth = write_fisheye(before, model, counts, rng, NOISE, WRONG)
            orient_database(Options(before, sigma=NOISE, out=ours))
            verify(before, theirs, pose=True)
            found = judge(ours, truth), judge(theirs, truth)
        metrics += compare(*found, f"COLMAP database, {model}")
    return metrics


SUITES: dict[str, Callable[[Size], list[Metric]]] = {
    "colmap": colmap,
    "colmap-fisheye": colmap_fisheye,
}
