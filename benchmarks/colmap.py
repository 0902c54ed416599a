"""The suite of COLMAP databases: `jaxro colmap` against COLMAP's own geometric
verification of the same database."""

import shutil
import sqlite3
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
from numpy.typing import NDArray

from jaxro.commands.colmap import Options, orient_database
from jaxro.geometry import mock_pairs

from .common import Size, rate, ratio
from .metrics import Metric, median_seconds

FOCAL, CENTRE, NOISE, WRONG = 2000.0, 3000.0, 1.0, 0.3
"""Pixels, and the share of wrong matches."""
FEWEST, MOST = 200, 1000
"""Matches of a pair, uniformly."""
RIGHT = np.deg2rad(0.1)
PAIRS = 250
"""Times `Size.robust`."""


class Truth(NamedTuple):
    """By pair: pair_id, R and t of cam2_from_cam1, which matches are right."""

    pair_ids: list[int]
    rotation: NDArray[np.float64]
    translation: NDArray[np.float64]
    good: list[NDArray[np.bool_]]


def written(path: Path, pairs: int, seed: int = 0) -> Truth:
    """A database of pairs of photos in any position (`mock_pairs.random_pairs`); a
    wrong match has the partner of another one."""
    import pycolmap

    rng = np.random.default_rng(seed)
    exact, pose = mock_pairs.random_pairs(
        jax.random.key(seed), pairs, MOST, focal=FOCAL
    )
    photos = [np.asarray(c) for c in exact.coordinates]
    camera = pycolmap.Camera(
        model="PINHOLE",
        width=int(2 * CENTRE),
        height=int(2 * CENTRE),
        params=[FOCAL, FOCAL, CENTRE, CENTRE],
        has_prior_focal_length=True,
    )
    pair_ids, good = [], []
    with (
        pycolmap.Database.open(str(path)) as database,
        pycolmap.DatabaseTransaction(database),
    ):
        number = database.write_camera(camera)
        for i, count in enumerate(rng.integers(FEWEST, MOST + 1, pairs)):
            images = []
            for x, y in (photos[:2], photos[2:]):
                image = database.write_image(
                    pycolmap.Image(name=f"{i:06d}_{len(images)}.png", camera_id=number)
                )
                pixels = np.stack(
                    [CENTRE + x[i, :count], CENTRE - y[i, :count]], axis=-1
                )
                database.write_keypoints(
                    image,
                    (pixels + rng.normal(0, NOISE, pixels.shape)).astype(np.float32),
                )
                images.append(image)
            partner, out = (
                np.arange(count),
                rng.permutation(count)[: round(WRONG * count)],
            )
            partner[out] = np.roll(out, 1)
            database.write_matches(
                *images,
                np.stack([np.arange(count), partner], axis=-1).astype(np.uint32),
            )
            pair_ids.append(pycolmap.image_pair_to_pair_id(*images))
            good.append(partner == np.arange(count))
    turned = np.diag([1.0, -1.0, -1.0])
    rotation, base = (np.array(part) for part in pose.relative())
    rotation = turned @ np.moveaxis(rotation, (0, 1), (2, 1)) @ turned
    return Truth(
        pair_ids, rotation, -np.einsum("pij,jp->pi", rotation @ turned, base), good
    )


def verdict(path: Path, truth: Truth) -> tuple[float, float, float]:
    """Shares of the pairs within RIGHT of the truth, of the right matches kept, and of
    those kept that are wrong."""
    with sqlite3.connect(path) as connection:
        rows = connection.execute(
            "SELECT pair_id, data, qvec, tvec FROM two_view_geometries"
        ).fetchall()
    found = {pair_id: rest for pair_id, *rest in rows}
    right, kept, false = [], [], []
    for pair_id, r, t, good in zip(*truth, strict=True):
        data, *pose = (blob or b"" for blob in found[pair_id])
        matches = np.frombuffer(data, "<u4").reshape(-1, 2)
        q, base = (np.frombuffer(blob, "<f8") for blob in pose)
        use = np.zeros(len(good), bool)
        use[matches[:, 0]] = True
        kept.append(np.mean(use[good]))
        false.append(np.sum(use & ~good) / max(np.sum(use), 1))
        right.append(
            len(q) == 4
            and bool(np.any(base))
            and max(_turn(q, r), _angle(base, t)) < RIGHT
        )
    return float(np.mean(right)), float(np.mean(kept)), float(np.mean(false))


def _angle(one: NDArray, other: NDArray) -> float:
    return float(
        2
        * np.arcsin(
            min(
                np.linalg.norm(
                    one / np.linalg.norm(one) - other / np.linalg.norm(other)
                )
                / 2,
                1,
            )
        )
    )


def _turn(q: NDArray, r: NDArray) -> float:
    w, v = q[0], q[1:]
    cross = np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])
    own = np.eye(3) + 2 * w * cross + 2 * cross @ cross
    return float(2 * np.arcsin(min(np.sqrt(np.sum((own - r) ** 2) / 8), 1)))


def colmap(size: Size) -> list[Metric]:
    """200 to 1,000 matches a pair, 30 % of them wrong, noise of a pixel; from database
    to database, both cores."""
    import pycolmap

    pycolmap.logging.minloglevel = 2
    with tempfile.TemporaryDirectory() as folder:
        before, ours, theirs = (
            Path(folder) / f"{name}.db" for name in ("before", "ours", "theirs")
        )
        truth = written(before, PAIRS * size.robust if size.robust > 1 else 40)

        def jaxro() -> None:
            orient_database(Options(before, sigma=NOISE, out=ours, force=True))

        def peer(pose: bool = False) -> None:
            shutil.copy(before, theirs)
            options = pycolmap.TwoViewGeometryOptions(compute_relative_pose=pose)
            pycolmap.geometric_verification(
                str(theirs), two_view_geometry_options=options
            )

        first = median_seconds({"first": jaxro}, 1)["first"]
        peer(pose=True)
        own, other = verdict(ours, truth), verdict(theirs, truth)
        metrics = []
        for k, what in enumerate(
            ("within 0.1° of the truth", "right matches kept", "wrong of those kept")
        ):
            better = "lower" if k == 2 else "higher"
            goal = other[k] if k == 0 else None
            metrics += [
                Metric(
                    f"COLMAP database: {what}, jaxro",
                    own[k],
                    "of 1",
                    better,
                    0.02 if k < 2 else 0.5,
                    goal,
                ),
                Metric(
                    f"COLMAP database: {what}, COLMAP", other[k], "of 1", better, np.inf
                ),
            ]
        contestants: dict[str, Callable[[], object]] = {"jaxro": jaxro, "colmap": peer}
        seconds = median_seconds(contestants, min(size.repeats, 5))
    pairs = len(truth.pair_ids)
    return [
        *metrics,
        rate("COLMAP database: jaxro", seconds["jaxro"] / pairs),
        rate("COLMAP database: COLMAP's verification", seconds["colmap"] / pairs),
        ratio(
            "COLMAP database: against COLMAP", seconds["colmap"], seconds["jaxro"], 10
        ),
        Metric(
            "COLMAP database: compilation at the first call",
            first - seconds["jaxro"],
            "s",
            "lower",
            0.5,
        ),
    ]


SUITES: dict[str, Callable[[Size], list[Metric]]] = {"colmap": colmap}
