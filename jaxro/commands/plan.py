"""One call of `jaxro plan`: the accuracy to expect of a survey over a grid, or what a
wanted accuracy needs."""

from dataclasses import dataclass

import jax
import numpy as np

from ..reports.pair import table
from ..reports.terminal import consoles
from ..reports.text import number
from ..surveys import planning as planning
from ..surveys.planning import Deviations, Plan
from ..tables.fields import TableError
from .heights import deviations_of, positive

QUANTITIES = {
    "height": "a height over the grid (1)",
    "difference": "the difference to a neighbour in the next square (5)",
    "in-square": "the difference to a neighbour in the same square (19)",
    "middle": "the middle of a traverse of {legs} (13)",
    "node": "a node of {traverses} of {legs} (16)",
    "detail": "a point read from the middle of a traverse (20)",
}
"""What is asked for, in the order of `Expected`."""


@dataclass(frozen=True)
class Options:
    """What the user asked for; None where nothing was said."""

    focal: float
    camera_height: float
    base: float | None
    side: float
    depth: float
    step: float
    legs: int
    traverses: int
    deviations: list[str]
    want: float | None
    of: str


def run(options: Options) -> bool:
    """Calculate and show. Raises TableError, also where a wanted accuracy cannot be
    reached."""
    plan, deviations = read_plan(options)
    console, _ = consoles()
    told = jax.tree.map(float, planning.expected_accuracy(plan, deviations))
    base = float(np.asarray(plan.base))
    console.print(
        f"f {options.focal:g} mm, H {options.camera_height:g} mm, B {base:g} mm "
        f"(H:B {options.camera_height / base:.1f}), squares of {options.side:g} mm,\n"
        f"points {options.depth:g} mm below the grid, whose parallax is "
        f"{options.focal * base / options.camera_height:.2f} mm",
        markup=False,
    )
    rows = table("expected standard deviation of", "mm", "H / m")
    for what, value in zip(labels(options), told, strict=True):
        rows.add_row(
            what,
            number(value, 2),
            number(options.camera_height / value if value else np.inf, 0),
        )
    console.print(rows)
    console.print(_budget(plan, deviations))
    if options.want is not None:
        for line in _needs(options, plan, deviations, options.want):
            console.print(line, markup=False)
    return True


def labels(options: Options) -> list[str]:
    """The quantities in words."""
    counted = lambda count, what: (
        f"{count} {what}" if count == 1 else f"{count} {what}s"
    )
    legs, traverses = (
        counted(options.legs, "leg"),
        counted(options.traverses, "traverse"),
    )
    return [what.format(legs=legs, traverses=traverses) for what in QUANTITIES.values()]


def read_plan(options: Options) -> tuple[Plan, Deviations]:
    """The plan, checked. Raises TableError."""
    lengths = {
        "--focal": options.focal,
        "--camera-height": options.camera_height,
        "--side": options.side,
    }
    focal, camera_height, side = (
        positive(name, value) for name, value in lengths.items()
    )
    base = positive(
        "--base",
        camera_height * planning.LARGEST_BASE if options.base is None else options.base,
    )
    if base > planning.LARGEST_BASE * camera_height * (1 + 1e-9):
        expected = (
            "at most a quarter of the camera height, "
            f"{planning.LARGEST_BASE * camera_height:g}"
        )
        raise TableError("--base", found=f"{base:g}", expected=expected)
    for name, value in (("--depth", options.depth), ("--step", options.step)):
        if not 0 <= value < camera_height:
            raise TableError(
                name,
                found=repr(value),
                expected="a length in mm, less than the camera height",
            )
    for name, count in (("--legs", options.legs), ("--traverses", options.traverses)):
        if count < 1:
            raise TableError(name, found=repr(count), expected="1 or more")
    if options.of not in QUANTITIES:
        raise TableError(
            "--of", found=repr(options.of), expected=f"one of {', '.join(QUANTITIES)}"
        )
    if options.want is not None:
        positive("--want", options.want)
    plan = Plan(
        focal=focal,
        camera_height=camera_height,
        base=base,
        side=side,
        depth=options.depth,
        step=options.step,
        legs=options.legs,
        traverses=options.traverses,
    )
    return plan, deviations_of(options.deviations)


def _budget(plan: Plan, deviations: Deviations):
    """What every source adds to a height and to a difference, mm."""
    over = jax.tree.map(float, planning.height_budget(plan, deviations).parts)
    between = jax.tree.map(float, planning.difference_budget(plan, deviations).parts)
    rows = table("of that comes from, mm", "error", "a height", "a difference")
    station = lambda parts: parts[0]
    sights = lambda parts: jax.tree.map(
        lambda *s: float(np.hypot.reduce(s)), *parts[1:]
    )
    for name, error, of in (
        (
            "camera height",
            deviations.camera_height,
            lambda parts: station(parts).camera_height,
        ),
        ("base", deviations.base, lambda parts: station(parts).base),
        ("side of a square", deviations.side, lambda parts: sights(parts).square.side),
        (
            "the same on the photo",
            deviations.photo_side,
            lambda parts: sights(parts).square.photo_side,
        ),
        ("reading of the grid", deviations.grid, lambda parts: sights(parts).grid),
        ("reading of a point", deviations.point, lambda parts: sights(parts).point),
    ):
        rows.add_row(name, f"{error:g}", number(of(over), 2), number(of(between), 2))
    return rows


def _needs(
    options: Options, plan: Plan, deviations: Deviations, want: float
) -> list[str]:
    """What the wanted accuracy needs. Raises TableError where nothing gives it."""
    place = list(QUANTITIES).index(options.of)
    of = lambda expected: expected[place]
    what = f"± {want:g} mm of {labels(options)[place]}"
    base = float(planning.base_needed(plan, deviations, want, of))
    now = float(np.asarray(plan.base))
    highest = {
        text: float(
            planning.camera_height_allowed(
                plan, deviations, want, of, fixed_ratio=fixed
            )
        )
        for text, fixed in (
            (f"with this H:B of {options.camera_height / now:.1f}", True),
            (f"with this base of {now:g} mm", False),
        )
    }
    longest = planning.LARGEST_BASE * options.camera_height
    best = float(
        of(planning.expected_accuracy(plan._replace(base=longest), deviations))
    )
    if not np.isfinite(base) and not any(highest.values()):
        expected = (
            f"a larger one (± {best:.2f} mm with the largest base at this camera "
            "height), or better readings (--sd)"
        )
        raise TableError(
            "--want",
            found=f"{what}, which no base and no camera height gives",
            expected=expected,
        )
    lines = [f"For {what}:"]
    if base <= (shortest := planning.SHORTEST_BASE * options.camera_height) * (
        1 + 1e-9
    ):
        lines.append(f"  at this camera height any base, even of {shortest:.3g} mm")
    elif np.isfinite(base):
        lines.append(
            f"  at this camera height a base of at least {base:.0f} mm (H:B "
            f"{options.camera_height / base:.1f})"
        )
    else:
        lines.append(
            f"  at this camera height no base: the largest, {longest:g} mm, gives ± "
            f"{best:.2f} mm"
        )
    for text, value in highest.items():
        if value >= planning.HIGHEST * options.camera_height * (1 - 1e-9):
            told = f"even {planning.HIGHEST:g} times the camera height"
        else:
            told = (
                f"a camera height of at most {value:.0f} mm"
                if value
                else "no camera height"
            )
        lines.append(f"  {text} {told}")
    return lines
