"""One call of `jaxro colmap`: every matched pair of a COLMAP database oriented, its
two-view geometry written."""

from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from rich.console import Console

from ..colmap.blocks import Block, orient_blocks, read_photos
from ..colmap.database import Geometry
from ..colmap.transaction import open_database
from ..colmap.two_view import geometries
from ..rejection.classification import Kind
from ..reports.terminal import Spent, consoles, progress, stopwatch
from ..reports.text import number, table
from ..tables.fields import TableError
from ..xla.programs import pause_collection
from ..xla.slabs import Progress, silent

MEANING = {
    Kind.oriented: ("oriented", "CALIBRATED, with relative pose"),
    Kind.plane: ("plane scene", "PLANAR, with relative pose"),
    Kind.two_poses: ("two poses", "PLANAR, without pose: two explain the matches"),
    Kind.rotation: ("pure rotation", "PANORAMIC, the base is zero"),
    Kind.weak: ("weak", "CALIBRATED, without pose: base too short for its errors"),
    Kind.no_consensus: (
        "no consensus",
        "DEGENERATE, no matches: agreement could be an accident",
    ),
    Kind.too_few: ("too few", "DEGENERATE, no matches: fewer than six"),
    Kind.several: (
        "several poses",
        "MULTIPLE, without pose: some matches each, none by accident",
    ),
}
GOOD = (Kind.oriented, Kind.plane, Kind.two_poses, Kind.rotation)


@dataclass(frozen=True)
class Options:
    """The command line. `sigma`: standard deviation of a keypoint coordinate in
    pixels."""

    database: Path
    sigma: float = 1.0
    out: Path | None = None
    force: bool = False
    assume_calibrated: bool = False


@dataclass
class Summary:
    """What became of the pairs: their number, matches and kept matches by kind; sigma0
    of the oriented; keypoints without photo coordinates; geometries of pairs without
    matches; the time."""

    pairs: Counter[Kind] = field(default_factory=Counter)
    matches: Counter[Kind] = field(default_factory=Counter)
    kept: Counter[Kind] = field(default_factory=Counter)
    sigma0: list[float] = field(default_factory=list)
    unseen: int = 0
    untouched: int = 0
    spent: Spent = field(default_factory=lambda: Spent(0.0, 0.0))

    def add(self, block: Block, rows: list[Geometry]) -> None:
        """Count the pairs of a block, whose geometries are these."""
        for i, row in enumerate(rows):
            kind = Kind(int(block.found.kind[i]))
            self.pairs[kind] += 1
            self.matches[kind] += len(block.matches[i])
            self.kept[kind] += len(row.matches)
            if kind == Kind.oriented:
                self.sigma0.append(float(block.found.sigma0[i]))


def run(options: Options) -> bool:
    """Orient, write, show. True if every pair has a geometry. Raises TableError."""
    console, errors = consoles()
    with progress(errors, "Orienting", None) as told:
        summary = orient_database(options, told)
    _show(console, options, summary)
    return all(kind in GOOD for kind in summary.pairs)


@pause_collection()
def orient_database(options: Options, told: Progress = silent) -> Summary:
    """Orient every matched pair and write its geometry, all or none. Raises
    TableError."""
    if not (np.isfinite(options.sigma) and options.sigma > 0):
        expected = "a positive number of pixels"
        raise TableError("--sigma", found=repr(options.sigma), expected=expected)
    spent, summary = stopwatch(), Summary()
    with open_database(options.database, options.out, options.force) as database:
        matched = database.pair_ids()
        pair_ids = [pair_id for pair_id, _ in matched]
        photos = read_photos(database, pair_ids, options.assume_calibrated)
        summary.unseen = photos.unseen
        for block in orient_blocks(database, photos, matched, options.sigma, told):
            k1, k2 = (
                np.stack([photo.matrix for photo in side])
                for side in photos.sides(block.pair_ids)
            )
            rows = geometries(block.pair_ids, block.matches, block.found, k1, k2)
            database.write(rows)
            summary.add(block, rows)
        summary.untouched = database.geometries() - len(matched)
    summary.spent = spent()
    return summary


def _show(console: Console, options: Options, summary: Summary) -> None:
    pairs, kept, matches = (
        sum(c.values()) for c in (summary.pairs, summary.kept, summary.matches)
    )
    name = options.database.name
    console.print(
        f"Two-view geometries of {name}: {pairs} pairs, {kept} of {matches} matches "
        "kept",
        markup=False,
    )
    heads = "outcome", "pairs", "matches", "kept", "kept [%]", "written as"
    rows = table(*heads, left=1)
    counters = summary.pairs, summary.matches, summary.kept
    for kind, (outcome, written) in MEANING.items():
        if summary.pairs[kind]:
            share = 100 * summary.kept[kind] / max(summary.matches[kind], 1)
            counts = [str(counter[kind]) for counter in counters]
            rows.add_row(outcome, *counts, number(share, 1), written)
    console.print(rows)
    if summary.unseen:
        console.print(
            f"{summary.unseen} keypoints have no photo coordinates (beyond what the "
            "distortion shows, or more than 89° off the axis); their matches are out."
        )
    if summary.untouched:
        console.print(
            f"Mind: {summary.untouched} geometries of pairs without a row in matches "
            "stay as they were."
        )
    if summary.sigma0:
        ratio = float(np.median(summary.sigma0))
        console.print(
            f"sigma0 of the oriented pairs, median: {number(ratio * options.sigma, 2)} "
            f"px (--sigma {options.sigma:g})"
        )
        if not 0.5 <= ratio <= 2:
            console.print(
                "Mind: keypoints seem to have about this sigma: try --sigma "
                f"{ratio * options.sigma:.2g}"
            )
    each = 1e3 * summary.spent.work / max(pairs, 1)
    console.print(
        f"{each:.2f} ms a pair, in all {summary.spent}. Written to "
        f"{options.out or options.database}",
        markup=False,
    )
