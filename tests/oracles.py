"""An independent judge in plain NumPy: slow, textbook, and without one line of the
package.

Photo vectors are p = (x, y, -f); derivatives are complex steps, Im f(x + ih) / h, exact
to the last digit for the polynomials and sines used here, so nothing is differentiated
by hand or by JAX.
"""

from typing import NamedTuple

import numpy as np

STEP = 1e-30


def jacobian(function, x):
    """d function / d x, columns by complex step."""
    columns = []
    for i in range(len(x)):
        moved = np.asarray(x, complex)
        moved[i] += 1j * STEP
        columns.append(np.asarray(function(moved)).imag / STEP)
    return np.stack(columns, axis=-1)


def r1(a):
    """Object-to-image rotation about x (Wolf)."""
    c, s = np.cos(a), np.sin(a)
    return np.array([[1, 0, 0], [0, c, s], [0, -s, c]])


def r2(a):
    """Object-to-image rotation about y (Wolf)."""
    c, s = np.cos(a), np.sin(a)
    return np.array([[c, 0, -s], [0, 1, 0], [s, 0, c]])


def r3(a):
    """Object-to-image rotation about z (Wolf)."""
    c, s = np.cos(a), np.sin(a)
    return np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])


def wolf(omega, phi, kappa):
    """M = R3(kappa) R2(phi) R1(omega)."""
    return r3(kappa) @ r2(phi) @ r1(omega)


def papers(alpha, omega, chi):
    """R = R_alpha R_omega R_chi, image to model, as written out for the 1971 paper."""
    ca, sa, co, so, cc, sc = (
        np.cos(alpha),
        np.sin(alpha),
        np.cos(omega),
        np.sin(omega),
        np.cos(chi),
        np.sin(chi),
    )
    r_alpha = np.array([[ca, 0, -sa], [0, 1, 0], [sa, 0, ca]])
    r_omega = np.array([[1, 0, 0], [0, co, -so], [0, so, co]])
    r_chi = np.array([[cc, -sc, 0], [sc, cc, 0], [0, 0, 1]])
    return r_alpha @ r_omega @ r_chi


def dependent(bx):
    """Elements (by, bz, omega, phi, kappa) as a function to (left rotation, right
    rotation, base)."""

    def placed(e):
        return np.eye(3), wolf(e[2], e[3], e[4]).T, np.array([bx, e[0], e[1]])

    return placed


def independent(e):
    """Elements (alpha, chi, omega', alpha', chi') to (left rotation, right rotation,
    base)."""
    return papers(e[0], 0.0, e[1]), papers(e[3], e[2], e[4]), np.array([1.0, 0.0, 0.0])


def vectors(x, y, focal):
    """(point, 3) image vectors."""
    return np.stack([x, y, np.broadcast_to(-focal, np.shape(x))], axis=-1)


def condition(placed, elements, coordinates, focal):
    """det(b, R1 p1, R2 p2) of every point. coordinates: (4, point); focal: (left,
    right)."""
    left, right, base = placed(elements)
    ray1 = vectors(coordinates[0], coordinates[1], focal[0]) @ left.T
    ray2 = vectors(coordinates[2], coordinates[3], focal[1]) @ right.T
    return np.cross(ray1, ray2) @ base


class Adjustment(NamedTuple):
    """Elements, their standard deviations and cofactor, sigma0, corrections (4, point),
    redundancy numbers."""

    elements: np.ndarray
    deviations: np.ndarray
    cofactor: np.ndarray
    sigma0: float
    corrections: np.ndarray
    redundancy: np.ndarray


def gauss_helmert(coordinates, focal, placed, start, sigma=1.0):
    """Minimise sum (v / sigma)² subject to condition(elements, l + v) = 0 exactly, by
    the Gauss-Helmert iteration.

    Linearised at the adjusted measurements in every step (not at the measured ones), so
    that at the end the corrected rays do intersect. `sigma`: one value or one per
    point.
    """
    measured = np.asarray(coordinates, float)
    focal = (focal, focal) if np.ndim(focal) == 0 else focal
    q = np.broadcast_to(np.asarray(sigma, float) ** 2, measured.shape[1:])
    elements, v = np.array(start, float), np.zeros_like(measured)
    for _ in range(100):
        adjusted = measured + v
        a = jacobian(
            lambda e, fixed=adjusted: condition(placed, e, fixed, focal), elements
        )
        b = np.stack(
            [
                condition(
                    placed,
                    elements,
                    adjusted + 1j * STEP * np.eye(4)[i][:, None],
                    focal,
                ).imag
                / STEP
                for i in range(4)
            ]
        )
        misclosure = condition(placed, elements, adjusted, focal) - np.sum(
            b * v, axis=0
        )
        w = np.sum(b * b, axis=0) * q
        normal = (a / w[:, None]).T @ a
        step = -np.linalg.solve(normal, a.T @ (misclosure / w))
        v = -q * b * ((a @ step + misclosure) / w)
        elements = elements + step
        if np.max(np.abs(step)) < 1e-14 * (1 + np.max(np.abs(elements))):
            break
    cofactor = np.linalg.inv(normal)
    freedom = measured.shape[1] - 5
    sigma0 = np.sqrt(np.sum(v * v / q) / freedom) if freedom else np.nan
    # the diagonal of Q_vv P, the four coordinates of a point added up
    redundancy = 1 - np.sum((a @ cofactor) * a, axis=1) / w
    return Adjustment(
        elements, sigma0 * np.sqrt(np.diag(cofactor)), cofactor, sigma0, v, redundancy
    )


def y_parallax(elements, coordinates, focal):
    """q = -f (Y1/Z1 - Y2/Z2) of the photos turned parallel to the base, elements of the
    independent system."""
    left, right, _ = independent(elements)
    ray1 = vectors(coordinates[0], coordinates[1], focal) @ left.T
    ray2 = vectors(coordinates[2], coordinates[3], focal) @ right.T
    return -focal * (ray1[:, 1] / ray1[:, 2] - ray2[:, 1] / ray2[:, 2])


def gauss_newton(coordinates, focal, iterations, start=(0.0,) * 5):
    """Minimise sum q² from `start`: parallaxes before each iteration and elements after
    it, as table 2 prints them."""
    elements, parallaxes, results = np.array(start, float), [], []
    for _ in range(iterations):
        q = y_parallax(elements, coordinates, focal)
        a = jacobian(lambda e: y_parallax(e, coordinates, focal), elements)
        elements = elements - np.linalg.lstsq(a, q, rcond=None)[0]
        parallaxes.append(q)
        results.append(elements)
    return np.array(parallaxes), np.array(results)


def m_q(q):
    """sqrt([qq] / (n - 5)), equation (2) of the 1971 paper."""
    return np.sqrt(np.sum(np.square(q)) / (len(q) - 5))


def intersect(coordinates, focal, placed, elements):
    """(point, 3): the midpoint of the shortest distance between the two rays, in the
    frame of the elements."""
    focal = (focal, focal) if np.ndim(focal) == 0 else focal
    left, right, base = placed(np.asarray(elements))
    ray1 = vectors(coordinates[0], coordinates[1], focal[0]) @ left.T
    ray2 = vectors(coordinates[2], coordinates[3], focal[1]) @ right.T
    points = []
    for p, q in zip(ray1, ray2, strict=True):
        (s, t), *_ = np.linalg.lstsq(np.stack([p, -q], axis=1), base, rcond=None)
        points.append((s * p + base + t * q) / 2)
    return np.array(points)


ZONES = {1: (0, 0), 2: (1, 0), 3: (0, 1), 4: (1, 1), 5: (0, -1), 6: (1, -1)}


def first_order(zones):
    """Coefficients of (alpha, chi, omega', alpha', chi') in the 1971 paper's equations
    (5) and (7), f = b = y = 1."""
    return np.array(
        [
            (x * y, x, -(1 + y * y), (1 - x) * y, 1 - x)
            for x, y in (ZONES[z] for z in zones)
        ],
        float,
    )


def angle(m):
    """The angle of a rotation matrix, accurate near zero."""
    m = np.asarray(m)
    half = np.sqrt(max(0.0, np.sum((m - np.eye(3)) ** 2) / 8))
    return 2 * np.arcsin(min(1.0, half))


def angle_between(a, b):
    """The angle between two vectors, accurate near zero."""
    a, b = np.asarray(a) / np.linalg.norm(a), np.asarray(b) / np.linalg.norm(b)
    return 2 * np.arctan2(np.linalg.norm(a - b), np.linalg.norm(a + b))
