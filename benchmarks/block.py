"""The suites of blocks: strips and blocks of a thousand models and more, and a network
beside pycolmap. Every workload runs in a new process, without any compiled program at
hand."""

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from jaxro import block
from jaxro.block.adjust_chained import start_from
from jaxro.block.network import Start

from .calibration import CENTRE, FOCAL, SIGMA, demand, measured_in, network, seconds
from .common import Size, ratio
from .metrics import Metric
from .processes import in_new_process

EXACT = 1e-6
"""Standard deviation of points that the other program holds fixed."""


def memory() -> float:
    """The largest memory of this process until now, MB."""
    # getrusage tells of a process what its parent had when it began
    status = Path("/proc/self/status").read_text()
    return float(status.partition("VmHWM:")[2].split()[0]) / 1e3


def walled(call: Callable[[], Any]) -> tuple[float, Any]:
    """Time on the clock of a call, and what it returns."""
    begin = time.perf_counter()
    answer = call()
    return time.perf_counter() - begin, answer


def adjusted(strips: int, models: int, goal: float, most: float) -> list[Metric]:
    """A block from its chain to the deviations of all points: first and later calls,
    with goals in s and MB."""
    mock = block.mock_block(1, block.Flight(strips=strips, models=models))
    start = start_from(mock.block, mock.photos)
    jax.block_until_ready(jnp.ones(3) + 1)
    before = memory()

    def call() -> Any:
        found = block.adjust_block(mock.block, start, mock.ground).check()
        return found, found.deviations

    (first, (found, deviations)), (later, _) = walled(call), walled(call)
    wrong = (found.coordinates - mock.points) / deviations
    demand(abs(np.nanmean(wrong**2) - 1), 0.6, "errors of points and their deviations")
    used = memory() - before
    key = f"block, {strips} x {models} models"
    return [
        seconds(f"{key}: first call", first, goal=goal),
        seconds(f"{key}: later calls", later),
        Metric(f"{key}: memory", used, "MB", "lower", goal=most),
    ]


def grown(turns: int) -> list[Metric]:
    """The time of a model in a strip of 10,000 over that in a strip of 1,000, and of
    this over that in a strip of 100."""
    times = []
    for models in (100, 1_000, 10_000):
        mock = block.mock_block(2, block.Flight(models=models))
        start = start_from(mock.block, mock.photos)
        call = lambda mock=mock, start=start: block.adjust_block(
            mock.block, start, mock.ground
        ).check()
        call()
        times.append(np.median([walled(call)[0] for _ in range(turns)]) / models)
    of = lambda models, factor: Metric(
        f"block, a model of a strip: {models}", factor, "times", "lower", goal=1.5
    )
    few, some, many = times
    return [
        of("of 1,000 against one of 100", some / few),
        of("of 10,000 against one of 1,000", many / some),
    ]


def beside_pycolmap(images: int, points: int, turns: int) -> list[Metric]:
    """Four rays a point, the camera known, some points fixed; estimates and covariances
    of all stations, in turns with pycolmap in one thread."""
    made, true = network(images, points, rays=4)
    known = max(5 * images, points // 50)
    places = measured_in(made, true, known, bent=False)
    measured, ground = as_block(places, true[:known])
    times = []
    for _ in range(turns):
        start = from_reconstruction(made, true[:known])
        taken, least, rotations = by_pycolmap(made, true[:known])
        own, found = walled(lambda start=start: turned(measured, start, ground))
        times.append((own, taken))
        squares = sum(float(np.sum(r**2)) for r in found[0].adjustment.residuals)
        demand(abs(squares / least - 1), 1e-5, "sums of squares and pycolmap's")
        both = (np.trace(q, axis1=1, axis2=2) for q in (found[1], rotations))
        demand(np.max(np.abs(np.divide(*both) - 1)), 1e-3, "covariances and pycolmap's")
    ours, peer = np.median(times, axis=0)
    key = f"block, {images} images of {points:,} points"
    return [ratio(f"{key}: against pycolmap", peer, ours, None)]


def turned(measured: Any, start: Start, ground: Any) -> tuple[Any, NDArray]:
    """The adjustment, and the cofactors of the rotation vectors of its stations."""
    found = block.adjust_block(measured, start, ground).check()
    return found, np.asarray(found.adjustment.cofactors["photo"])[:, :3, :3]


def as_block(places: Any, known: NDArray) -> tuple[Any, Any]:
    """The places of a network as a block, and its fixed points."""
    x, y = (np.asarray(places.places) - CENTRE).T
    image, point = np.asarray(places.image), np.asarray(places.point)
    names = lambda number: tuple(str(k) for k in range(number))
    measured = block.MeasuredBlock(
        photos=names(int(image.max()) + 1),
        points=names(int(point.max()) + 1),
        photo=image,
        point=point,
        x=x,
        y=-y,
        sigma=np.full(len(x), SIGMA),
        focal=np.full(int(image.max()) + 1, FOCAL),
    )
    return measured, block.ground(names(len(known)), known, EXACT)


def from_reconstruction(made: Any, known: NDArray) -> Start:
    """Where pycolmap begins: near the true values, fixed points where they are."""
    disturb(made, known)
    poses = [made.images[k].cam_from_world() for k in sorted(made.images)]
    quaternions = np.array([pose.rotation.quat for pose in poses])
    centres = np.array([-(p.rotation.matrix().T @ p.translation) for p in poses])
    points = np.array([point.xyz for point in made.points3D.values()])
    return Start(quaternions[:, [3, 0, 1, 2]], centres, points)


def disturb(made: Any, known: NDArray) -> None:
    """Stations and points of a network with errors, some of which are put back."""
    import pycolmap

    noise = pycolmap.SyntheticNoiseOptions(
        rig_from_world_rotation_stddev=0.2, point3D_stddev=0.02
    )
    pycolmap.synthesize_noise(noise, made)
    for number, true in zip(made.points3D, known, strict=False):
        made.points3D[number].xyz = true


def by_pycolmap(made: Any, known: NDArray) -> tuple[float, float, NDArray]:
    """What pycolmap takes in one thread, the first points being fixed; Σ (v/sigma)²,
    and the cofactors of rotation vectors."""
    import pycolmap

    config = pycolmap.BundleAdjustmentConfig()
    for image in made.images:
        config.add_image(image)
    for number, _ in zip(made.points3D, known, strict=False):
        config.add_constant_point(number)
    ceres = {"solver_options": {"num_threads": 1, "function_tolerance": 1e-9}}
    options = pycolmap.BundleAdjustmentOptions(
        refine_focal_length=False, print_summary=False, ceres=ceres
    )
    adjuster: Any = pycolmap.create_default_ceres_bundle_adjuster(options, config, made)
    wanted = pycolmap.BACovarianceOptions(params="POSES")

    def call() -> tuple[Any, Any]:
        cost = adjuster.solve().ceres_summary.final_cost
        return cost, pycolmap.estimate_ba_covariance(wanted, made, adjuster)

    taken, (cost, found) = walled(call)
    # of half the angles
    halves = [found.get_cam_cov_from_world(k)[:3, :3] for k in sorted(made.images)]
    return taken, 2 * cost / SIGMA**2, 4 * SIGMA**2 * np.array(halves)


def suite(size: Size) -> list[Metric]:
    """Blocks and strips of 1,000 models; growth to 10,000; a network beside
    pycolmap."""
    full = size.robust > 1
    calls = ["adjusted(25, 40, 5, 600)", "adjusted(1, 1_000, 5, 600)"] if full else []
    calls += ["adjusted(80, 125, 60, 8_000)"] if full else ["adjusted(2, 10, 5, 600)"]
    calls += [f"grown({size.repeats})"] if full else []
    calls += [f"beside_pycolmap({'60, 26_000, 3' if full else '8, 400, 1'})"]
    return [m for call in calls for m in in_new_process("block", call)]


SUITES: dict[str, Callable[[Size], list[Metric]]] = {"block": suite}
