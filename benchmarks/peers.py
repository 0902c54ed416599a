"""The peers: PoseLib and OpenCV in processes of their own, and the stock optimistix
Gauss-Newton under vmap.

PoseLib's image vector is (x, y, 1), ours (x, y, -f): with both coordinates negated they
are parallel, so that its R and t are Rᵀ and -Rᵀ b of ours.
"""

import multiprocessing
from collections.abc import Callable, Sequence
from multiprocessing.connection import Connection
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .workload import FOCAL

Coordinates = Sequence[NDArray[np.float64]]
ORDINARY = {"loss_type": "TRIVIAL"}
TIGHT = {
    "loss_type": "TRIVIAL",
    "max_iterations": 100,
    "gradient_tol": 1e-16,
    "step_tol": 1e-13,
}


Work = Callable[[dict], list]
"""All pairs of a process once, with the options given, as the peer answers."""


def _camera():
    import poselib

    return poselib.Camera("SIMPLE_PINHOLE", [FOCAL, 0.0, 0.0], 300, 300)


def _normal_case():
    """No rotation, base along x."""
    import poselib

    start = poselib.CameraPose()
    start.t = np.array([-1.0, 0.0, 0.0])
    return start


def refinement(left: NDArray, right: NDArray) -> Work:
    """PoseLib's refinement of every pair from the normal case, by its quickest call."""
    import poselib

    camera, start = _camera(), _normal_case()
    return lambda options: [
        poselib.refine_relative_pose(one, other, start, camera, camera, options)[0]
        for one, other in zip(left, right, strict=True)
    ]


def omissions(left: NDArray, right: NDArray) -> Work:
    """The same, and from that solution once more for every point left out, the points
    copied beforehand."""
    import poselib

    camera, start = _camera(), _normal_case()
    every = range(left.shape[1])
    without = [
        [(np.delete(a, i, 0), np.delete(b, i, 0)) for i in every]
        for a, b in zip(left, right, strict=True)
    ]

    def run(options: dict) -> list:
        found = []
        for one, other, rest in zip(left, right, without, strict=True):
            full = poselib.refine_relative_pose(
                one, other, start, camera, camera, options
            )[0]
            found.append(
                [
                    poselib.refine_relative_pose(a, b, full, camera, camera, options)[0]
                    for a, b in rest
                ]
            )
        return found

    return run


def ransac(left: NDArray, right: NDArray) -> Work:
    """PoseLib's LO-RANSAC of every pair."""
    import poselib

    camera = _camera()

    def run(options: dict) -> list:
        return [
            poselib.estimate_relative_pose(one, other, camera, camera, options, {})
            for one, other in zip(left, right, strict=True)
        ]

    return run


def opencv(left: NDArray, right: NDArray) -> Work:
    """OpenCV's essential matrix by the method named, decomposed."""
    import cv2

    cv2.setNumThreads(1)
    k = np.diag([FOCAL, FOCAL, 1.0])
    nothing = np.full((3, 3), np.nan), np.full(3, np.nan)

    def one(a: NDArray, b: NDArray, options: dict) -> tuple:
        method, threshold = getattr(cv2, options["method"]), options["threshold"]
        e, mask = cv2.findEssentialMat(
            a, b, k, method=method, prob=0.999, threshold=threshold
        )
        if e is None or e.shape != (3, 3):
            return *nothing, np.zeros(len(a), bool)
        _, r, t, _ = cv2.recoverPose(e, a, b, k, mask=mask.copy())
        return r, t.ravel(), mask.ravel().astype(bool)

    return lambda options: [
        one(a, b, options) for a, b in zip(left, right, strict=True)
    ]


def _ours(answer) -> Any:
    """(R, b) of a refinement, which does not look at the sign of the base; (R, b,
    agreeing points) of a search."""
    if isinstance(answer, list):
        return [_ours(one) for one in answer]
    if isinstance(answer, tuple):
        r, t, *mask = (
            (answer[0].R, answer[0].t, answer[1]["inliers"])
            if len(answer) == 2
            else answer
        )
        rotation = np.array(r).T
        return rotation, rotation @ np.array(t), *(np.array(m, bool) for m in mask)
    rotation = np.array(answer.R).T
    return rotation, -rotation @ np.array(answer.t)


def _serve(
    connection: Connection,
    coordinates: Coordinates,
    task: Callable[[NDArray, NDArray], Work],
) -> None:
    """Does all its pairs each time it is told to; sends the answers back where they are
    wanted."""
    work = task(
        -np.stack(coordinates[:2], axis=-1), -np.stack(coordinates[2:], axis=-1)
    )
    connection.send(None)
    while (order := connection.recv()) is not None:
        options, wanted = order
        answers = work(options)
        connection.send(_ours(answers) if wanted else None)


class Peer:
    """A peer in several processes, each with its own share of the pairs, waiting
    between the runs."""

    def __init__(
        self,
        task: Callable[[NDArray, NDArray], Work],
        coordinates: Coordinates,
        processes: int,
    ):
        context = multiprocessing.get_context("spawn")
        self.pairs = len(coordinates[0])
        self._connections, self._workers = [], []
        for share in np.array_split(np.arange(self.pairs), processes):
            ours, theirs = context.Pipe()
            arguments = theirs, [c[share] for c in coordinates], task
            worker = context.Process(target=_serve, args=arguments, daemon=True)
            worker.start()
            self._connections.append(ours)
            self._workers.append(worker)
        for connection in self._connections:
            connection.recv()

    def run(self, options: dict | None = None) -> None:
        """All pairs once; a refinement with the wheel's default tolerances if no
        options are given."""
        self._all(ORDINARY if options is None else options, wanted=False)

    def answers(self, options: dict) -> list:
        """The answers of all pairs."""
        return [answer for share in self._all(options, wanted=True) for answer in share]

    def refined(self) -> tuple[NDArray, NDArray]:
        """R (pairs, 3, 3) and unit base (pairs, 3) in our convention, iterated to the
        end."""
        return stacked(self.answers(TIGHT))

    def _all(self, options: dict, wanted: bool) -> list:
        for connection in self._connections:
            connection.send((options, wanted))
        return [connection.recv() for connection in self._connections]

    def __enter__(self) -> "Peer":
        return self

    def __exit__(self, *_: object) -> None:
        for connection, worker in zip(self._connections, self._workers, strict=True):
            connection.send(None)
            worker.join()


def stacked(poses: Sequence[tuple]) -> tuple[NDArray, NDArray]:
    """R (pairs, 3, 3) and unit base (pairs, 3) of (R, b, ...)."""
    rotation, base = (np.stack([pose[k] for pose in poses]) for k in (0, 1))
    return rotation, base / np.linalg.norm(base, axis=-1, keepdims=True)


def stock_optimistix() -> Callable:
    """jit(vmap) of optimistix's own GaussNewton on the same residual, as its
    documentation would have one write it.

    Minimises the sum of g² / |dg/dl|² (coplanarity g = b . (p1 x R p2)) over by, bz,
    omega, phi, kappa with bx = 1. Returns by, bz and R (p1 ~ R p2) of every pair.
    """
    import jax
    import jax.numpy as jnp
    import optimistix as optx

    def rotation(omega, phi, kappa):
        (so, co), (sp, cp), (sk, ck) = (
            (jnp.sin(angle), jnp.cos(angle)) for angle in (omega, phi, kappa)
        )
        return (
            (cp * ck, -cp * sk, sp),
            (co * sk + so * sp * ck, co * ck - so * sp * sk, -so * cp),
            (so * sk - co * sp * ck, so * ck + co * sp * sk, co * cp),
        )

    def condition(measured, by, bz, r):
        x1, y1, x2, y2 = measured
        x, y, z = (row[0] * x2 + row[1] * y2 - row[2] * FOCAL for row in r)
        return (
            (y1 * z + FOCAL * y) + by * (-FOCAL * x - x1 * z) + bz * (x1 * y - y1 * x)
        )

    def residuals(elements, measured):
        by, bz, *angles = elements
        r = rotation(*angles)
        g, slope = jax.vmap(jax.value_and_grad(condition), (0, None, None, None))(
            measured, by, bz, r
        )
        return g / jnp.sqrt(sum(s**2 for s in slope))

    solver = optx.GaussNewton(rtol=1e-9, atol=1e-9)

    def orient(*measured):
        start = (jnp.zeros(()),) * 5
        by, bz, *angles = optx.least_squares(
            residuals, solver, start, measured, max_steps=20, throw=False
        ).value
        return by, bz, jnp.stack([jnp.stack(row) for row in rotation(*angles)])

    return jax.jit(jax.vmap(orient))


def as_poses(answer: tuple) -> tuple[NDArray, NDArray]:
    """R and unit base from (by, bz, R) of bx = 1."""
    by, bz, rotation = (np.asarray(part) for part in answer)
    base = np.stack([np.ones_like(by), by, bz], axis=-1)
    return rotation, base / np.linalg.norm(base, axis=-1, keepdims=True)


def scipy_parallax(coordinates: Coordinates) -> tuple[NDArray, NDArray]:
    """R and unit base that minimise the strict y-parallax, one pair after the other by
    SciPy.

    q = -f (Y1/Z1 - Y2/Z2) of the photos turned parallel to the base, independent
    elements (Dorozhinsky 1971).
    """
    from scipy.optimize import least_squares

    def turned(alpha: float, omega: float, chi: float) -> NDArray:
        (ca, co, cc), (sa, so, sc) = (
            np.cos([alpha, omega, chi]),
            np.sin([alpha, omega, chi]),
        )
        r_alpha = np.array([[ca, 0, -sa], [0, 1, 0], [sa, 0, ca]])
        r_omega = np.array([[1, 0, 0], [0, co, -so], [0, so, co]])
        return r_alpha @ r_omega @ np.array([[cc, -sc, 0], [sc, cc, 0], [0, 0, 1]])

    def q(elements: NDArray, left: NDArray, right: NDArray) -> NDArray:
        phi1, kappa1, omega2, phi2, kappa2 = elements
        first, second = (
            turned(phi1, 0.0, kappa1) @ left,
            turned(phi2, omega2, kappa2) @ right,
        )
        return -FOCAL * (first[1] / first[2] - second[1] / second[2])

    rotations, bases = [], []
    for x1, y1, x2, y2 in zip(*coordinates, strict=True):
        f = np.full_like(x1, -FOCAL)
        measured = np.stack([x1, y1, f]), np.stack([x2, y2, f])
        found = least_squares(
            q,
            np.zeros(5),
            args=measured,
            method="lm",
            xtol=1e-15,
            ftol=1e-15,
            gtol=1e-15,
        ).x
        left, right = (
            turned(found[0], 0.0, found[1]),
            turned(found[3], found[2], found[4]),
        )
        rotations.append(left.T @ right)
        bases.append(left[0])
    return np.stack(rotations), np.stack(bases)
