"""Every way an orientation can end, with advice.

A result is a value, never an exception: inside a batch one bad pair must not harm its
neighbours. `RESULTS[result]` gives the sentence of one member; `Orientation.check()`
raises it for callers who want that.
"""

from jaxtyping import Array, Bool

from ..adjustment import results


class RESULTS(results.RESULTS):  # pyright: ignore[reportGeneralTypeIssues]
    """How an orientation ended. Where it is not `is_usable`, do not use the
    elements."""

    no_redundancy = (
        "Exactly five points: the elements are determined but nothing checks them, so "
        "m_q and sigma0 do not exist. Measure at least one more point."
    )
    two_solutions = (
        "A second orientation fits the points as well, with all of them in front of "
        "both photos: the points lie (nearly) in one plane, or are too few. The better "
        "one is returned. Give an approximate start, or measure points off the plane."
    )
    too_few_points = (
        "Fewer than five usable points: relative orientation has five unknowns. "
        "Measure more points."
    )
    non_finite_input = (
        "A coordinate, standard deviation or focal length is NaN, infinite, out of all "
        "proportion (a coordinate above 1e9 focal lengths) or not positive where it "
        "must be. The point was left out; correct or mask it and orient again."
    )
    weakly_determined = (
        "For its errors the layout determines the elements too weakly: one of them has "
        "a standard deviation above 0.04 rad (2°), or moving the points by a few "
        "sigma0 would leave one undetermined (points near a line, in one zone, or a "
        "needed zone empty). Add points far from the present ones, or look for gross "
        "errors if sigma0 is larger than you measure."
    )
    zero_base = (
        "The photos are explained by a pure rotation: the base is zero (or every point "
        "is far away), so neither base direction nor model points exist. Use photos "
        "taken from different places."
    )
    points_behind_camera = (
        "At least one accurate point lies behind a photo: a wrong match, a sign error "
        "in the coordinates, or a wrong solution. `in_front` names the points."
    )
    photos_swapped = (
        "The right photo lies on the other side of the left one than the given base "
        "says: swap left and right, or give a negative base."
    )
    elements_undefined = (
        "The chosen elements do not exist here, or have standard deviations above 0.04 "
        "rad (2°) where the pose has not: the base is nearly at right angles to the x "
        "axis (or along the photo axis), or a photo turned by 90°; or the given base "
        "is no length: 0, not finite, or negative for IndependentElements. Give "
        "another base, or use RelativePose, which exists for every position."
    )
    carried_by_few = (
        "A few points alone carry the base: without those of the smallest redundancy "
        "the others do not determine it, and wrong points like those that were "
        "rejected may agree with it by chance. Measure these points again, or more "
        "points at other depths."
    )
    several_solutions = (
        "Other points, far apart from each other, agree with another orientation, and "
        "neither can be an accident: something moved, looks alike at two places, or "
        "two scenes are in view. Nothing in the measurements says which orientation is "
        "that of the photos. Those that were found are listed with their points: leave "
        "out the points of the others, or measure more."
    )
    mirrored = (
        "All points fit, but lie behind the right photo: y of one photo counts the "
        "other way (downwards), or its x and y are exchanged. With one photo mirrored "
        "they fit, and lie in front of both. Correct the axes of that photo (y_down of "
        "its camera) and orient again."
    )
    out_of_field = (
        "No camera sees rays so far from its axis (87° and more): the coordinates, the "
        "principal point and the focal length are not in one unit. Give all of them in "
        "the unit of the coordinates."
    )


def of_adjustment(result: results.RESULTS) -> RESULTS:
    """What the end of an adjustment means for an orientation; `RESULTS.promote` would
    look it up, pair by pair."""
    undetermined = result == results.RESULTS.rank_deficient
    failed = RESULTS.where(undetermined, RESULTS.rank_deficient, RESULTS.diverged)  # pyright: ignore[reportArgumentType]
    right = result == results.RESULTS.successful
    return RESULTS.where(right, RESULTS.successful, failed)  # pyright: ignore[reportArgumentType]


def is_usable(result: RESULTS) -> Bool[Array, "..."]:
    """True where the elements may be used: successful, no_redundancy or two_solutions
    (with their warnings)."""
    return (
        (result == RESULTS.successful)  # pyright: ignore[reportReturnType]
        | (result == RESULTS.no_redundancy)
        | (result == RESULTS.two_solutions)
    )
