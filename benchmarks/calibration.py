"""The suites of calibrations: of one image, of several images, of a large network.

Every workload runs in a new process, without any compiled program at hand. Times are
processor times: those of all threads together, as on one core.
"""

import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any

import jax
import numpy as np
from numpy.typing import NDArray

from jaxro import calibration as cal
from jaxro.calibration import Brown, Field, Model, Whole

from .common import Size, ratio
from .first import BARE, seconds_of
from .metrics import Metric
from .processes import in_new_process

HERE = "calibration"

SIGMA, FOCAL, CENTRE = 0.1, 1800.0, np.array([512.0, 384.0])
"""Of the images of networks, in pixels; the principal place is their middle."""

FIELD = Model(brown=Brown(), field=Field(0.5, 1.0))
seconds = partial(Metric, unit="s", direction="lower")


def timed(call: Callable[[], Any]) -> tuple[float, Any]:
    """Processor time of a call, until its arrays are there, and what it returns."""
    begin = time.process_time()
    answer = jax.block_until_ready(call())
    return time.process_time() - begin, answer


def demand(apart: Any, bound: float, what: str) -> None:
    """Raises ArithmeticError where answers are farther apart than `bound`."""
    if not apart <= bound:
        raise ArithmeticError(f"{what} differ by {apart:.1e}; nothing timed")


def photo(seed: int = 0) -> cal.MeasuredImage:
    """An image of 100 points, on film that is stretched on one side."""
    rng = np.random.default_rng(seed)
    points = rng.uniform([-4, -4, -2], [4, 4, 2], (100, 3))
    x, y = 900 * points[:, :2].T / (12 - points[:, 2]) + rng.normal(0, 0.1, (2, 100))
    return cal.image(512 + x + 2e-5 * x**2, 384 - y, points, sigma=0.1, y_down=True)


def network(images: int, points: int, rays: int) -> tuple[Any, NDArray]:
    """A reconstruction of pycolmap: images of one camera around points, each of which
    is measured in so many images; and the true points."""
    import pycolmap

    pycolmap.set_random_seed(0)
    options = pycolmap.SyntheticDatasetOptions(
        num_rigs=1,
        num_frames_per_rig=images,
        num_points3D=points,
        track_length=rays,
        camera_model_id=pycolmap.CameraModelId.PINHOLE,
        camera_params=[FOCAL, FOCAL, *CENTRE],
    )
    made = pycolmap.synthesize_dataset(options)
    noise = pycolmap.SyntheticNoiseOptions(point2D_stddev=SIGMA)
    pycolmap.synthesize_noise(noise, made)
    return made, np.array([point.xyz for point in made.points3D.values()])


def measured_in(made: Any, true: NDArray, known: int, bent: bool) -> cal.MeasuredImages:
    """The places of a network and its first points, as many as are known. `bent`: the
    places are distorted by lens and film."""
    rows = [
        (*made.images[one.image_id].point2D(one.point2D_idx).xy, one.image_id, number)
        for number, point in enumerate(made.points3D.values())
        for one in point.track.elements
    ]
    image, point = np.array(rows)[:, 2:].astype(int).T
    p = (np.array(rows)[:, :2] - CENTRE) / FOCAL
    radial = p * np.sum(p**2, axis=1, keepdims=True)
    more = 0.1 * radial + 0.0003 * np.sin(10 * p[:, ::-1])
    x, y = (CENTRE + FOCAL * (p + more if bent else p)).T
    points = np.where(np.arange(len(true)) < known, true.T, np.nan)
    return cal.images(x, y, image - 1, point, points.T, sigma=SIGMA)


def targets() -> cal.MeasuredImages:
    """21 images that show 100 targets, 20 of which are known."""
    return measured_in(*network(21, 100, rays=21), 20, bent=True)


CALLS: dict[str, tuple[Callable, Callable]] = {
    "calibrate": (photo, cal.calibrate),
    "choose": (photo, lambda image: cal.choose(image)[0]),
    "calibrate_together": (targets, partial(cal.calibrate_together, model=FIELD)),
    "choose_together": (targets, lambda images: cal.choose_together(images)[0]),
}


def answers(name: str, bare: float, turns: int) -> list[Metric]:
    """One of `CALLS`: all of a new process until the first answer, over `bare`, that of
    JAX alone; and later calls."""
    make, calibrate = CALLS[name]
    measured = make()
    call = lambda: calibrate(measured).check()
    jax.block_until_ready(call())
    first = time.process_time() / bare
    later = median(timed(call)[0] for _ in range(turns))
    return [
        Metric(f"calibration, first answer: {name}", first, "times", "lower"),
        seconds(f"calibration, later answers: {name}", later),
    ]


def models(photos: int) -> list[Metric]:
    """60 models, the default ones and up to six rings and strips, of one image after
    another; in turns with every twelfth model by a call of its own."""
    zones = (cal.rings, cal.strips_along_x, cal.strips_along_y)
    divided = [Model(x=kind(number)) for number in range(2, 7) for kind in zones]
    every = [*cal.default_models(), *divided]
    some = every[::12]
    together = lambda image: cal.compare(image, every).figures.sigma0
    alone = lambda image: np.array([cal.calibrate(image, m).sigma0 for m in some])
    first, _ = timed(partial(together, photo(0)))
    apart = np.max(np.abs(together(photo(0))[::12] / alone(photo(0)) - 1))
    demand(apart, 1e-6, "sigma0 of models together and alone")
    times = [
        [timed(partial(call, photo(k)))[0] for call in (together, alone)]
        for k in range(photos)
    ]
    one, fewer = np.median(times, axis=0)
    spent = sum(both[0] for both in times)
    return [
        seconds("calibration, 60 models: compilation", first - one, goal=10),
        seconds(f"calibration, 60 models: {photos} images", spent, goal=10),
        ratio("calibration, 60 models: against one by one", 12 * fewer, one, None),
    ]


def large_network(images: int, points: int, turns: int) -> list[Metric]:
    """Four rays a point: a lens with a field; then two focal lengths, in turns with
    pycolmap."""
    made, true = network(images, points, rays=4)
    known = max(5 * images, points // 50)
    measured = measured_in(made, true, known, bent=True)
    adjust = lambda: cal.calibrate_together(measured, FIELD).check()
    (first, _), (later, found) = timed(adjust), timed(adjust)
    # getrusage tells of a process what its parent had when it began
    status = Path("/proc/self/status").read_text()
    memory = float(status.partition("VmHWM:")[2].split()[0]) / 1e6
    wrong = ((found.points - true) / found.point_deviations)[known:]
    demand(abs(np.mean(wrong**2) - 1), 0.3, "errors of points and their deviations")

    measured, plain = measured_in(made, true, known, bent=False), Model(y=Whole())
    adjust = lambda: cal.calibrate_together(measured, plain).check()
    found = adjust()
    squares = float(sum(np.sum(r**2) for r in found.adjustment.residuals))
    covariances = np.asarray(found.adjustment.covariance("station"))
    turned = covariances[:, :3, :3] / float(found.sigma0) ** 2
    times = []
    for _ in range(turns):
        taken, least, rotations = by_pycolmap(made, true[:known])
        times.append((timed(adjust)[0], taken))
        demand(abs(squares / least - 1), 1e-8, "sums of squares and pycolmap's")
        both = (np.trace(q, axis1=1, axis2=2) for q in (turned, rotations))
        demand(np.max(np.abs(np.divide(*both) - 1)), 1e-3, "covariances and pycolmap's")
    ours, peer = np.median(times, axis=0)
    key = f"calibration, {images} images of {points:,} points"
    return [
        seconds(f"{key}: first call", first, goal=300),
        seconds(f"{key}: later calls", later),
        Metric(f"{key}: largest memory", memory, "GB", "lower"),
        ratio(f"{key}: against pycolmap", peer, ours, None),
    ]


def by_pycolmap(made: Any, known: NDArray) -> tuple[float, float, Any]:
    """What pycolmap takes in one thread from values near the true ones, the first
    points being known; Σ (v/sigma)², and the covariances of rotations."""
    import pycolmap

    noise = pycolmap.SyntheticNoiseOptions(
        rig_from_world_rotation_stddev=0.2, point3D_stddev=0.02
    )
    pycolmap.synthesize_noise(noise, made)
    made.cameras[1].params = [0.98 * FOCAL, 0.98 * FOCAL, *CENTRE]
    config = pycolmap.BundleAdjustmentConfig()
    for image in made.images:
        config.add_image(image)
    for number, true in zip(made.points3D, known, strict=False):
        made.points3D[number].xyz = true
        config.add_constant_point(number)
    ceres = {"solver_options": {"num_threads": 1, "function_tolerance": 1e-9}}
    options = pycolmap.BundleAdjustmentOptions(
        refine_principal_point=True, print_summary=False, ceres=ceres
    )
    adjuster: Any = pycolmap.create_default_ceres_bundle_adjuster(options, config, made)
    wanted = pycolmap.BACovarianceOptions(params="POSES")
    begin = time.process_time()
    cost = adjuster.solve().ceres_summary.final_cost
    found: Any = pycolmap.estimate_ba_covariance(wanted, made, adjuster)
    taken = time.process_time() - begin
    # of half the angles
    halves = [found.get_cam_cov_from_world(k)[:3, :3] for k in sorted(made.images)]
    return taken, 2 * cost / SIGMA**2, 4 * SIGMA**2 * np.array(halves)


def first_answers(size: Size, *names: str) -> list[Metric]:
    """`answers` of some of `CALLS`."""
    bare = [seconds_of([sys.executable, "-c", BARE]) for _ in range(size.processes + 2)]
    calls = [f"answers({n!r}, {median(bare)}, {size.repeats})" for n in names]
    return [metric for call in calls for metric in in_new_process(HERE, call)]


def one_image(size: Size) -> list[Metric]:
    """100 points; and 60 models of 21 images."""
    found = first_answers(size, "calibrate", "choose")
    return [*found, *in_new_process(HERE, f"models({21 if size.robust > 1 else 3})")]


def several_images(size: Size) -> list[Metric]:
    """21 images of 100 targets."""
    return first_answers(size, "calibrate_together", "choose_together")


def many_images(size: Size) -> list[Metric]:
    """60 images of 26,000 points."""
    amount = "60, 26_000, 3" if size.robust > 1 else "8, 400, 1"
    return in_new_process(HERE, f"large_network({amount})")


SUITES: dict[str, Callable[[Size], list[Metric]]] = {
    "calibration": one_image,
    "calibration-together": several_images,
    "calibration-network": many_images,
}
