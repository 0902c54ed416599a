"""Every way a calibration can end, with advice."""

from jaxtyping import Array, Bool

from ..adjustment import results


class RESULTS(results.RESULTS):  # pyright: ignore[reportGeneralTypeIssues]
    """How a calibration ended. Where it is not `is_usable`, do not use the numbers."""

    non_finite_input = (
        "A place, an object point or one of their standard deviations is NaN or "
        "infinite, or the standard deviation of a place is not positive. The point was "
        "left out; correct or mask it and calibrate again."
    )
    no_redundancy = (
        "As many coordinates as unknowns: nothing checks the result, and sigma0 does "
        "not exist. Measure more points, or choose a model with fewer zones."
    )
    too_few_points = (
        "Fewer coordinates than unknowns. Measure more points, or choose a model with "
        "fewer zones."
    )
    plane_object = (
        "The object points lie in a plane, and the principal place is unknown: station "
        "and focal length can change together without changing the image. Measure "
        "points off the plane, give the principal place (or the focal length) with its "
        "standard deviation, or calibrate several images of the camera together."
    )
    weakly_determined = (
        "The points determine the station too weakly: its standard deviation is more "
        "than a twentieth of its distance from the object. Measure points at more "
        "different depths, or choose a model with fewer zones."
    )
    empty_zone = (
        "A zone has no point, so that its focal length is unknown. Choose fewer zones, "
        "or measure points in all of them."
    )
    contradicted = (
        "The coordinates are more than ten times less accurate than their standard "
        "deviations say: that is no error of measurement. Object points or places are "
        "exchanged or in another unit, the camera is not what was given, or sigma is "
        "not in the unit of the coordinates."
    )


def of_adjustment(result: results.RESULTS) -> RESULTS:
    """What the end of an adjustment means for a calibration."""
    undetermined = result == results.RESULTS.rank_deficient
    failed = RESULTS.where(undetermined, RESULTS.rank_deficient, RESULTS.diverged)  # pyright: ignore[reportArgumentType]
    right = result == results.RESULTS.successful
    return RESULTS.where(right, RESULTS.successful, failed)  # pyright: ignore[reportArgumentType]


def is_usable(result: RESULTS) -> Bool[Array, "..."]:
    """True where the numbers may be used: successful, or no_redundancy (with its
    warning)."""
    return (
        (result == RESULTS.successful)  # pyright: ignore[reportReturnType]
        | (result == RESULTS.no_redundancy)
    )
