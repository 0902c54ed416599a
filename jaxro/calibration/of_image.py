"""One of several images that were adjusted together, as a calibration of its own."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Int

from ..adjustment import JointAdjustment, symmetric
from ..adjustment.blocks import dimension
from ..adjustment.elimination import Blocks, Layout, Solution
from .calibrate import observe
from .images import MeasuredImage
from .models import field_weights, focal_weights
from .result import Calibration
from .together import Together


def of_image(found: Together, image: Int[Array, ""]) -> Calibration:
    """The station of an image and its camera, with their covariance from the adjustment
    of all images.

    `measured` are the places of all images of the same camera, with the object points
    as they were found; `misfits` holds for places of this image alone.
    """
    camera = found.measured.camera[image]
    measured = _places_of(found, camera)
    focal = focal_weights(found.model, found.area.u, found.area)
    return Calibration(
        measured=measured,
        model=found.model,
        frame=found.frame,
        area=found.area,
        basis=jnp.eye(focal.shape[2]),
        observed=observe(measured, found.frame),
        focal_weights=focal,
        field_weights=field_weights(found.model, found.area.u, found.area),
        adjustment=_part(found.adjustment, image, camera, measured.mask),
        result=found.result,
    )


def _places_of(found: Together, camera: Int[Array, ""]) -> MeasuredImage:
    """The places that a camera took."""
    own = found.measured
    mask = own.camera[own.image] == camera
    used = lambda a: jnp.where(mask[:, None], a, 0.0)
    points = found.points[own.point]
    return MeasuredImage(
        places=used(own.places),
        points=used(points),
        sigma=jnp.where(mask, own.sigma, 1.0),
        point_sigma=jnp.zeros_like(points),
        mask=mask,
        handedness=own.handedness,
        bad_input=jnp.zeros((), bool),
    )


def _part(
    whole: JointAdjustment, image: Int[Array, ""], camera: Int[Array, ""], mask: Array
) -> JointAdjustment:
    """The parameters of one station and one camera; all others are eliminated."""
    members = {"station": image, "camera": camera}
    families = {
        name: jax.tree.map(lambda a, k=k: a[k][None], whole.parameters[name])
        for name, k in members.items()
    }
    places = [whole.layout.places(name, k) for name, k in members.items()]
    chosen = jnp.concatenate(places)
    cofactor = whole.cofactor[chosen[:, None], chosen[None, :]]
    normal = symmetric.inverse(cofactor)
    size = dimension(families["camera"])
    blocks = Blocks("station", 1, 6, 0), Blocks("camera", 1, size, 6)
    used = lambda a: jnp.where(mask[:, None], a, 0.0)
    return JointAdjustment(
        parameters=families,
        normal_matrix=normal.matrix,
        cofactor=cofactor,
        residuals=(used(whole.residuals[0]),),
        redundancy=(used(whole.redundancy[0]),),
        sigma0=whole.sigma0,
        pivot=whole.pivot,
        degrees_of_freedom=whole.degrees_of_freedom,
        iterations=whole.iterations,
        result=whole.result,
        solution=Solution(
            normal_matrix=normal.matrix,
            step=jnp.zeros_like(chosen, cofactor.dtype),
            cofactor=cofactor,
            eliminated=None,
            pivots=normal.pivots,
        ),
        layout=Layout(blocks),
    )
