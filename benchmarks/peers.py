"""The peers: PoseLib in processes of its own, and the stock optimistix Gauss-Newton under vmap.

PoseLib's image vector is (x, y, 1), ours (x, y, -f): with both coordinates negated they are parallel, so that its
R and t are Rᵀ and -Rᵀ b of ours.
"""

import multiprocessing
from collections.abc import Callable, Sequence
from multiprocessing.connection import Connection

import numpy as np
from numpy.typing import NDArray

from .workload import FOCAL

Coordinates = Sequence[NDArray[np.float64]]
TIGHT = {"loss_type": "TRIVIAL", "max_iterations": 100, "gradient_tol": 1e-16, "step_tol": 1e-13}


def _refine(left: NDArray, right: NDArray, options: dict) -> list:
    """PoseLib's refinement of every pair from the normal case (no rotation, base along x), by its quickest call."""
    import poselib

    camera = poselib.Camera("SIMPLE_PINHOLE", [FOCAL, 0.0, 0.0], 300, 300)
    start = poselib.CameraPose()
    start.t = np.array([-1.0, 0.0, 0.0])
    return [
        poselib.refine_relative_pose(one, other, start, camera, camera, options)[0]
        for one, other in zip(left, right, strict=True)
    ]


def _serve(connection: Connection, coordinates: Coordinates) -> None:
    """Refines all its pairs each time it is told to; sends the poses back where they are wanted."""
    left = -np.stack(coordinates[:2], axis=-1)
    right = -np.stack(coordinates[2:], axis=-1)
    while (order := connection.recv()) is not None:
        options, wanted = order
        poses = _refine(left, right, options)
        connection.send([(np.array(pose.R).T, np.array(pose.t)) for pose in poses] if wanted else None)


class PoseLib:
    """PoseLib's Python wheel in several processes, each with its own share of the pairs, waiting between the runs."""

    def __init__(self, coordinates: Coordinates, processes: int):
        context = multiprocessing.get_context("spawn")
        self.pairs = len(coordinates[0])
        self._connections, self._workers = [], []
        for share in np.array_split(np.arange(self.pairs), processes):
            ours, theirs = context.Pipe()
            worker = context.Process(target=_serve, args=(theirs, [c[share] for c in coordinates]), daemon=True)
            worker.start()
            self._connections.append(ours)
            self._workers.append(worker)

    def refine(self) -> None:
        """All pairs once, with the wheel's default tolerances."""
        self._all({"loss_type": "TRIVIAL"}, wanted=False)

    def refined(self) -> tuple[NDArray, NDArray]:
        """R (pairs, 3, 3) and unit base (pairs, 3) in our convention, iterated to the end."""
        answers = [pose for share in self._all(TIGHT, wanted=True) for pose in share]
        rotation = np.stack([r for r, _ in answers])
        base = -np.einsum("pij,pj->pi", rotation, np.stack([t for _, t in answers]))
        return rotation, base / np.linalg.norm(base, axis=-1, keepdims=True)

    def _all(self, options: dict, wanted: bool) -> list:
        for connection in self._connections:
            connection.send((options, wanted))
        return [connection.recv() for connection in self._connections]

    def __enter__(self) -> "PoseLib":
        return self

    def __exit__(self, *_: object) -> None:
        for connection, worker in zip(self._connections, self._workers, strict=True):
            connection.send(None)
            worker.join()


def stock_optimistix() -> Callable:
    """jit(vmap) of optimistix's own GaussNewton on the same residual, as its documentation would have one write it.

    Minimises the sum of g² / |dg/dl|² (coplanarity g = b . (p1 x R p2)) over by, bz, omega, phi, kappa with bx = 1.
    Returns by, bz and R (p1 ~ R p2) of every pair.
    """
    import jax
    import jax.numpy as jnp
    import optimistix as optx

    def rotation(omega, phi, kappa):
        (so, co), (sp, cp), (sk, ck) = ((jnp.sin(angle), jnp.cos(angle)) for angle in (omega, phi, kappa))
        return (
            (cp * ck, -cp * sk, sp),
            (co * sk + so * sp * ck, co * ck - so * sp * sk, -so * cp),
            (so * sk - co * sp * ck, so * ck + co * sp * sk, co * cp),
        )

    def condition(measured, by, bz, r):
        x1, y1, x2, y2 = measured
        x, y, z = (row[0] * x2 + row[1] * y2 - row[2] * FOCAL for row in r)
        return (y1 * z + FOCAL * y) + by * (-FOCAL * x - x1 * z) + bz * (x1 * y - y1 * x)

    def residuals(elements, measured):
        by, bz, *angles = elements
        r = rotation(*angles)
        g, slope = jax.vmap(jax.value_and_grad(condition), (0, None, None, None))(measured, by, bz, r)
        return g / jnp.sqrt(sum(s**2 for s in slope))

    solver = optx.GaussNewton(rtol=1e-9, atol=1e-9)

    def orient(*measured):
        start = (jnp.zeros(()),) * 5
        by, bz, *angles = optx.least_squares(residuals, solver, start, measured, max_steps=20, throw=False).value
        return by, bz, jnp.stack([jnp.stack(row) for row in rotation(*angles)])

    return jax.jit(jax.vmap(orient))


def as_poses(answer: tuple) -> tuple[NDArray, NDArray]:
    """R and unit base from (by, bz, R) of bx = 1."""
    by, bz, rotation = (np.asarray(part) for part in answer)
    base = np.stack([np.ones_like(by), by, bz], axis=-1)
    return rotation, base / np.linalg.norm(base, axis=-1, keepdims=True)


def scipy_parallax(coordinates: Coordinates) -> tuple[NDArray, NDArray]:
    """R and unit base that minimise the strict y-parallax, one pair after the other by SciPy.

    q = -f (Y1/Z1 - Y2/Z2) of the photos turned parallel to the base, independent elements (Dorozhinsky 1971).
    """
    from scipy.optimize import least_squares

    def turned(alpha: float, omega: float, chi: float) -> NDArray:
        (ca, co, cc), (sa, so, sc) = np.cos([alpha, omega, chi]), np.sin([alpha, omega, chi])
        r_alpha = np.array([[ca, 0, -sa], [0, 1, 0], [sa, 0, ca]])
        r_omega = np.array([[1, 0, 0], [0, co, -so], [0, so, co]])
        return r_alpha @ r_omega @ np.array([[cc, -sc, 0], [sc, cc, 0], [0, 0, 1]])

    def q(elements: NDArray, left: NDArray, right: NDArray) -> NDArray:
        phi1, kappa1, omega2, phi2, kappa2 = elements
        first, second = turned(phi1, 0.0, kappa1) @ left, turned(phi2, omega2, kappa2) @ right
        return -FOCAL * (first[1] / first[2] - second[1] / second[2])

    rotations, bases = [], []
    for x1, y1, x2, y2 in zip(*coordinates, strict=True):
        f = np.full_like(x1, -FOCAL)
        measured = np.stack([x1, y1, f]), np.stack([x2, y2, f])
        found = least_squares(q, np.zeros(5), args=measured, method="lm", xtol=1e-15, ftol=1e-15, gtol=1e-15).x
        left, right = turned(found[0], 0.0, found[1]), turned(found[3], found[2], found[4])
        rotations.append(left.T @ right)
        bases.append(left[0])
    return np.stack(rotations), np.stack(bases)
