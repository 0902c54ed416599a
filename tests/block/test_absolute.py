"""Absolute orientation of one model against others: the printed digits of 3DCONF, a
dense adjustment in plain NumPy, the bundles of a pair."""

import re

import numpy as np
import oracles
import pytest
from scipy.linalg import block_diag
from scipy.optimize import least_squares
from tiers import seldom

import jaxro
from jaxro.block import absolute
from jaxro.block.absolute_model import model, model_of_pair

# -------------------------------------------------------------------------------------
# 3DCONF of Bon A. Dewitt (public domain), its sample 3DCONF_sample.dat and .out

CONTROL = """
a   390.35  499.63  469.43  607.54  501.63  469.09
b   371.68  630.84   81.25  589.98  632.36   82.81
c   425.65  419.07   82.49  643.65  421.28   83.50
d   410.50  438.31   81.13  628.58  440.51   82.27
e   448.22  295.83   97.79  666.27  298.16   98.29
f   414.60  709.39  101.77  632.59  710.62  103.01
"""
NEW = """
1   611.37  498.98  470.45
2   637.49  323.67  85.67
3   573.32  401.51  84.48
4   647.00  373.97  83.76
5   533.51  285.01  87.13
"""
ELEMENTS = """
scale     0.99674     0.00051
omega      0.0540      0.0295
  phi     -0.1318      0.0404
kappa     -0.0002      0.0417
   Tx     219.620       0.442
   Ty       3.687       0.414
   Tz      -0.060       0.420
"""
RESIDUALS = """
       a    0.083  -0.385   0.112
       b   -0.076   0.032  -0.441
       c    0.044   0.031   0.030
       d    0.017  -0.021  -0.112
       e   -0.115   0.298   0.426
       f    0.047   0.046  -0.016
"""
TRANSFORMED = """
       1    827.919   500.595  470.725  0.266  0.246  0.237
       2    854.835   326.217   87.096  0.204  0.215  0.207
       3    790.878   403.805   85.836  0.156  0.166  0.162
       4    864.319   376.355   85.261  0.187  0.211  0.204
       5    751.191   287.683   88.276  0.200  0.176  0.172
"""
SIGMA0 = 0.24755


def numbers(text):
    return np.array([line.split()[1:] for line in text.strip().splitlines()], float)


def test_all_printed_digits_of_3dconf():
    """Its residuals are place minus given coordinate; the deviations of transformed
    points are those of the seven parameters alone."""
    control, new = numbers(CONTROL), numbers(NEW)
    unknown = np.full_like(new, np.nan)
    measured = model(
        np.concatenate([control[:, :3], new]), np.concatenate([control[:, 3:], unknown])
    )
    found = absolute.orient_model(measured).check()
    to_degrees = np.array([1, *[np.degrees(1)] * 3, 1, 1, 1])
    digits = np.array([5, 4, 4, 4, 3, 3, 3])
    for printed, ours in zip(
        numbers(ELEMENTS).T, (found.values, found.deviations()), strict=True
    ):
        error = np.abs(np.asarray(ours) * to_degrees - printed)
        assert np.all(error <= 0.5 * 10.0**-digits)
    np.testing.assert_allclose(found.residuals[:6], numbers(RESIDUALS), atol=5e-4)
    placed = np.concatenate([found.points, found.point_deviations()], axis=1)[6:]
    np.testing.assert_allclose(placed, numbers(TRANSFORMED), atol=5e-4)
    assert abs(found.sigma0 - SIGMA0) < 5e-6
    assert int(found.degrees_of_freedom) == 11
    np.testing.assert_allclose(np.sum(found.redundancy), 11)
    further, spread = found.transform(new)
    np.testing.assert_allclose(further, found.points[6:], atol=1e-9)
    np.testing.assert_allclose(
        np.sqrt(np.diagonal(spread, axis1=1, axis2=2)), placed[:, 3:], rtol=1e-6
    )


def test_the_numbers_are_those_of_the_files(data):
    """What stands above is what the program read and printed."""
    folder = data / "dewitt_relor"
    read = (folder / "3DCONF_sample.dat").read_text().split("#")
    np.testing.assert_array_equal(numbers(read[0]), numbers(CONTROL))
    np.testing.assert_array_equal(numbers(read[1]), numbers(NEW))
    printed = (folder / "3DCONF_sample.out").read_text()
    final = re.sub(r"(\d)d", r"\1 ", printed.split("Final Results:")[1])
    elements, points = final.split("Transformed Points:")
    np.testing.assert_array_equal(
        numbers("\n".join(elements.strip().splitlines()[1:])), numbers(ELEMENTS)
    )
    np.testing.assert_array_equal(
        numbers("\n".join(points.strip().splitlines()[1:])), numbers(TRANSFORMED)
    )
    residuals = printed.split("Residuals:")[3].split("Standard")[0].strip()
    np.testing.assert_array_equal(
        numbers("\n".join(residuals.splitlines()[1:])), numbers(RESIDUALS)
    )
    assert f"{SIGMA0:.5f}" in printed


# -------------------------------------------------------------------------------------
# a dense adjustment in plain NumPy


def place(elements, points):
    """s R x + T of elements in the order of the result."""
    s, *angles, tx, ty, tz = elements
    return s * points @ oracles.wolf(*angles) + np.array([tx, ty, tz])


def derivative(function, at, step=1e-6):
    """By central differences."""
    columns = []
    for k in range(len(at)):
        d = np.zeros_like(at)
        d[k] = step * max(1.0, abs(at[k]))
        columns.append((function(at + d) - function(at - d)) / (2 * d[k]))
    return np.stack(columns, axis=-1)


def dense(points, ground, variance, covariance, start):
    """Unknowns are the seven elements and the true model coordinates; observed are
    these and the known ground coordinates. Elements, adjusted places, their cofactors,
    sum of squares, and w of the ground coordinates."""
    known = np.isfinite(ground)
    weight = block_diag(np.linalg.inv(covariance), np.diag(1 / variance[known]))
    n = len(points)

    def observed(x):
        true = x[7:].reshape(n, 3)
        return np.concatenate([x[7:], place(x[:7], true)[known]])

    l = np.concatenate([points.ravel(), ground[known]])
    x = np.concatenate([start, points.ravel()])
    for _ in range(8):
        a = derivative(observed, x)
        normal = a.T @ weight @ a
        x = x + np.linalg.solve(normal, a.T @ weight @ (l - observed(x)))
    q, v = np.linalg.inv(normal), observed(x) - l
    places = lambda x: place(x[:7], x[7:].reshape(n, 3)).ravel()
    j = derivative(places, x)
    p_v = weight @ v
    spread = weight - weight @ a @ q @ a.T @ weight
    w = np.zeros_like(ground)
    w[known] = p_v[3 * n :] / np.sqrt(np.diag(spread)[3 * n :])
    return x[:7], q[:7, :7], places(x).reshape(n, 3), j @ q @ j.T, v @ p_v, w


def scene(rng, number=9):
    """A model, its true place on the ground, and elements with large angles."""
    points = rng.uniform([-0.7, -1.2, -1.9], [1.3, 0.8, -1.1], (number, 3))
    elements = np.array([830.0, 2.5, -0.6, 1.9, 5400.0, -3200.0, 260.0])
    return points, elements, place(elements, points)


MIXED = np.array(
    [
        *([1, 1, 1], [1, 1, 0], [0, 0, 1], [0, 0, 1], [1, 1, 1]),
        *([0, 0, 1], [1, 1, 0], [0, 0, 0], [0, 0, 0]),
    ],
    bool,
)


SMALL = 0.01


@pytest.mark.parametrize("joint", seldom([False, True], [False]))
def test_is_the_dense_adjustment(joint):
    """With control of all kinds and accuracies, and errors of the model of each point
    or of all together. The errors drawn are small for their deviations: what is of
    second order in them is in neither covariance in the same way."""
    rng = np.random.default_rng(3)
    points, elements, ground = scene(rng)
    root = rng.normal(size=(27, 27)) * 3e-4
    covariance = root @ root.T + 1e-7 * np.eye(27)
    given = covariance
    if not joint:
        given = np.stack([covariance[k : k + 3, k : k + 3] for k in range(0, 27, 3)])
        covariance = block_diag(*given)
    sigma = rng.uniform(0.2, 0.8, (9, 3))
    of_model = np.linalg.cholesky(np.asarray(covariance)) @ rng.normal(size=27)
    points = points + SMALL * of_model.reshape(9, 3)
    errors = SMALL * sigma * rng.normal(size=(9, 3))
    ground = np.where(MIXED, ground + errors, np.nan)
    measured = model(points, ground, ground_sigma=sigma, covariance=given)
    found = absolute.orient_model(measured).check()
    x, q, places, spread, squares, w = dense(
        points, ground, sigma**2, covariance, elements
    )
    sd = np.sqrt(np.diag(q))
    off = np.asarray(found.values) - x
    off[1:4] = (off[1:4] + np.pi) % (2 * np.pi) - np.pi
    assert np.all(np.abs(off) < 1e-6 * sd)
    np.testing.assert_allclose(
        found.cofactor / np.outer(sd, sd), q / np.outer(sd, sd), atol=1e-4
    )
    freedom = np.sum(MIXED) - 7
    assert int(found.degrees_of_freedom) == freedom
    np.testing.assert_allclose(found.sigma0, np.sqrt(squares / freedom), rtol=1e-6)
    of_points = np.sqrt(np.diag(spread)).reshape(9, 3)
    assert np.max(np.abs(found.points - places) / of_points) < 1e-6
    np.testing.assert_allclose(found.point_deviations(1.0), of_points, rtol=1e-4)
    for i, j in ((0, 0), (0, 7), (8, 7), (2, 4)):
        np.testing.assert_allclose(
            found.covariance_of(i, j, 1.0),
            spread[3 * i : 3 * i + 3, 3 * j : 3 * j + 3],
            atol=1e-4 * np.max(of_points) ** 2,
        )
    np.testing.assert_allclose(found.w(1.0), w, atol=1e-4 * SMALL)


# -------------------------------------------------------------------------------------
# the model of a pair

FOCAL = 153.0
SIGMA = 0.005


def photo(pose, ground):
    """Image coordinates of ground points: omega, phi, kappa and station."""
    seen = (ground - pose[3:]) @ oracles.wolf(*pose[:3]).T
    return -FOCAL * seen[:, :2] / seen[:, 2:]


def bundle(coordinates, ground, sigma, poses, start):
    """Both photos and all ground points at once, by scipy: points and deviations."""
    known = np.isfinite(ground)
    size = len(start)

    def residuals(x):
        places = x[12:].reshape(size, 3)
        seen = [photo(pose, places) for pose in x[:12].reshape(2, 6)]
        of_images = (np.concatenate(seen, axis=1) - coordinates) / SIGMA
        return np.concatenate([of_images.ravel(), ((places - ground) / sigma)[known]])

    x0 = np.concatenate([np.ravel(poses), start.ravel()])
    found = least_squares(residuals, x0, x_scale="jac", xtol=1e-14, ftol=1e-14)
    q = np.linalg.inv(found.jac.T @ found.jac)
    deviations = np.sqrt(np.diag(q))[12:].reshape(size, 3)
    return found.x[12:].reshape(size, 3), deviations, found.fun @ found.fun


@pytest.mark.slow
def test_model_of_a_pair_is_the_bundle_of_its_photos():
    """Places and deviations of control and new points, by the covariance that the image
    coordinates and the five elements give the model."""
    rng = np.random.default_rng(8)
    ground = rng.uniform([0, -900, 0], [900, 900, 120], (16, 3))
    poses = [
        np.array([0.02, -0.03, 0.05, 0, 0, 1550]),
        np.array([-0.03, 0.02, 0.02, 900, 20, 1540]),
    ]
    coordinates = np.concatenate([photo(pose, ground) for pose in poses], axis=1)
    coordinates = coordinates + rng.normal(0, SIGMA, coordinates.shape)
    pair = jaxro.pair(*coordinates.T, focal=FOCAL, sigma=SIGMA)
    oriented = jaxro.orient(pair, start=jaxro.starts.Vertical()).check()
    given = np.where(np.arange(16)[:, None] < 5, ground, np.nan)
    given[:5] += rng.normal(0, 0.05, (5, 3))
    given[3, :2] = np.nan
    given[4, 2] = np.nan
    measured = model_of_pair(pair, oriented, given, ground_sigma=0.05)
    found = absolute.orient_model(measured).check()
    places, deviations, squares = bundle(coordinates, given, 0.05, poses, ground)
    assert np.max(np.abs(found.points - places) / deviations) < 2e-3
    np.testing.assert_allclose(found.point_deviations(1.0), deviations, rtol=2e-3)
    # the pair's own conditions are the rest of the sum of squares
    of_pair = float(oriented.sigma0) ** 2 * int(oriented.degrees_of_freedom)
    ours = float(found.sigma0) ** 2 * int(found.degrees_of_freedom)
    np.testing.assert_allclose(of_pair + ours, squares, rtol=2e-3)
