"""The minimal and linear starts against the geometry itself and textbook NumPy that
shares nothing with them."""

import time
from itertools import combinations_with_replacement

import jax
import jax.numpy as jnp
import numpy as np
import problems
import pytest

import jaxro
from jaxro.adjustment.null_space import null_space
from jaxro.geometry import coplanarity, rotations as rot
from jaxro.geometry.elements import IndependentElements, vertical
from jaxro.orientation.starts import SixPoints, decomposition, six_points
from jaxro.orientation.starts.base import FirstOrder, approach
from jaxro.orientation.starts.eight_point import eight_point
from jaxro.orientation.starts.five_point import five_point

BATCH = 2048
five_points = jax.jit(jax.vmap(five_point))


def scenes(seed: int, count: int, points: int):
    """Unit-base scenes: any rotation, any base direction, depth 2 to 10 bases; p1, p2
    (any length), R, b, E."""
    rng = np.random.default_rng(seed)
    q, upper = np.linalg.qr(rng.normal(size=(count, 3, 3)))
    q = q * np.sign(np.einsum("nii->ni", upper))[:, None]
    rotation = q * np.linalg.det(q)[:, None, None]
    base = rng.normal(size=(count, 3))
    base /= np.linalg.norm(base, axis=1, keepdims=True)
    p1 = np.concatenate(
        [rng.uniform(-0.7, 0.7, (count, points, 2)), -np.ones((count, points, 1))],
        axis=2,
    )
    p2 = (p1 * rng.uniform(2, 10, (count, points, 1)) - base[:, None]) @ rotation
    p2 /= np.linalg.norm(p2, axis=2, keepdims=True)
    essential = -np.cross(base[:, :, None], rotation, axis=1)
    return p1, p2, rotation, base, essential


def distance(a, b):
    """Largest difference of matrices that are known but for their sign."""
    return np.minimum(np.abs(a - b).max((-2, -1)), np.abs(a + b).max((-2, -1)))


def count_real(p1: np.ndarray, p2: np.ndarray) -> int:
    """Number of real solutions by singular value decomposition and the eigenvalues of
    an action matrix.

    The cubics are fitted to their values at random places, not multiplied out
    (Stewénius 2006 for the last step).
    """
    basis = np.linalg.svd(np.einsum("ki,kj->kij", p1, p2).reshape(5, 9))[2][5:].reshape(
        4, 3, 3
    )
    powers = [
        m for d in (3, 2, 1, 0) for m in combinations_with_replacement(range(3), d)
    ]
    xyz = np.random.default_rng(0).normal(size=(60, 3))
    e = np.einsum("sk,kij->sij", np.c_[xyz, np.ones(60)], basis)
    outer = e @ e.transpose(0, 2, 1)
    cubics = 2 * outer @ e - np.trace(outer, axis1=1, axis2=2)[:, None, None] * e
    values = np.c_[cubics.reshape(60, 9), np.linalg.det(e)]
    monomials = np.stack([np.prod(xyz[:, list(m)], axis=1) for m in powers], axis=1)
    equations = np.linalg.lstsq(monomials, values, rcond=None)[0].T
    reduced = np.linalg.solve(equations[:, :10], equations[:, 10:])
    action = np.zeros((10, 10))
    for row, m in enumerate(powers[10:]):
        place = powers.index(tuple(sorted((*m, 2))))
        action[row] = -reduced[place] if place < 10 else np.eye(10)[place - 10]
    z = np.linalg.eigvals(action)
    return int(np.sum(np.abs(z.imag) < 1e-7 * (1 + np.abs(z))))


def test_five_points_hold_the_truth():
    """In every random scene the true E is among the solutions, and every solution
    solves the equations."""
    found = residual = 0
    for seed in range(4):
        p1, p2, _, _, truth = scenes(seed, BATCH, 5)
        essentials, real = (
            np.asarray(a) for a in five_points(jnp.asarray(p1), jnp.asarray(p2))
        )
        assert np.isfinite(essentials).all()
        error = np.where(real, distance(essentials, truth[:, None]), np.inf).min(1)
        found += np.sum(error < 1e-8)
        outer = essentials @ essentials.swapaxes(-1, -2)
        assert np.einsum("nsii->ns", outer) == pytest.approx(2.0, abs=1e-12)
        condition = np.einsum("nki,nsij,nkj->nsk", p1, essentials, p2)
        assert np.abs(condition).max() < 1e-13
        cubic = np.abs(outer @ essentials - essentials).max((2, 3))  # tr(E Eᵀ)/2 = 1
        residual += np.sum(cubic[real] > 1e-12) / np.sum(real) / 4
        assert np.median(error) < 1e-13
    assert found / (4 * BATCH) >= 0.9995
    assert residual < 2e-3


def test_five_points_find_every_real_solution():
    p1, p2, *_ = scenes(10, BATCH, 5)
    real = np.asarray(five_points(jnp.asarray(p1), jnp.asarray(p2))[1]).sum(1)
    counts = np.array([count_real(a, b) for a, b in zip(p1, p2, strict=True)])
    # the oracle's own digits decide nearly double roots differently now and then
    assert np.mean(real == counts) > 0.998
    assert np.all(real % 2 == 0)


def test_five_points_agree_with_poselib():
    poselib = pytest.importorskip("poselib")
    p1, p2, *_ = scenes(11, 200, 5)
    padded = [np.concatenate([p, np.zeros((BATCH - 200, 5, 3))]) for p in (p1, p2)]
    essentials, real = (np.asarray(a) for a in five_points(*map(jnp.asarray, padded)))
    total = agreeing = 0
    for i in range(200):
        bearings = p1[i] / np.linalg.norm(p1[i], axis=1, keepdims=True)
        for pose in poselib.relpose_5pt(bearings, p2[i]):
            other = np.cross(pose.t[:, None], pose.R, axis=0).T * np.sqrt(
                1 / (pose.t @ pose.t)
            )
            if (
                np.abs(np.einsum("ki,ij,kj->k", p1[i], other, p2[i])).max() < 1e-10
            ):  # unrefined, some are rough
                total += 1
                agreeing += (
                    distance(essentials[i][real[i]], other).min(initial=np.inf) < 1e-6
                )
    assert total >= 200
    assert agreeing / total > 0.998


def test_five_points_agree_with_opencv():
    cv2 = pytest.importorskip("cv2")
    p1, p2, *_ = scenes(12, 400, 5)
    seen = np.all(p2[..., 2] < -0.2, axis=1)
    p2 = np.where(
        seen[:, None, None], -p2 / np.where(seen[:, None, None], p2[..., 2:], 1.0), p2
    )
    padded = [np.concatenate([p, np.zeros((BATCH - 400, 5, 3))]) for p in (p1, p2)]
    essentials, real = (np.asarray(a) for a in five_points(*map(jnp.asarray, padded)))
    flip = np.diag([1.0, 1.0, -1.0])  # it takes (x, y, 1) and p2ᵀ E p1 = 0
    total = agreeing = 0
    for i in np.flatnonzero(seen):
        stacked, _ = cv2.findEssentialMat(
            p1[i, :, :2].copy(), p2[i, :, :2].copy(), np.eye(3)
        )
        for other in [] if stacked is None else stacked.reshape(-1, 3, 3):
            e = flip @ other.T @ flip
            e = e * np.sqrt(2 / np.sum(e * e))
            total += 1
            agreeing += distance(essentials[i][real[i]], e).min(initial=np.inf) < 1e-5
    assert total >= 20
    assert agreeing / total > 0.99


def test_five_points_survive_degenerate_input():
    """Zeros, one point five times, equal photos, points on a line: finite numbers, and
    neighbours untouched."""
    p1, p2, *_ = scenes(13, BATCH, 5)
    clean = five_points(jnp.asarray(p1), jnp.asarray(p2))
    p1[0], p2[0] = 0.0, 0.0
    p1[1], p2[1] = p1[1, :1], p2[1, :1]
    p2[2] = p1[2]
    p1[3, :, 1] = 0.0
    spoilt = five_points(jnp.asarray(p1), jnp.asarray(p2))
    assert np.isfinite(np.asarray(spoilt[0])).all()
    for a, b in zip(clean, spoilt, strict=True):
        assert np.array_equal(np.asarray(a)[4:], np.asarray(b)[4:])


@pytest.mark.slow
def test_vmap_is_a_loop():
    """Nested vmap, one vmap and single calls give the same numbers; so does a vmap over
    one argument."""
    p1, p2, *_ = scenes(14, BATCH, 5)
    left, right = jnp.asarray(p1), jnp.asarray(p2)
    once = five_points(left, right)
    fold = lambda a: a.reshape(256, BATCH // 256, *a.shape[1:])
    twice = jax.jit(jax.vmap(jax.vmap(five_point)))(fold(left), fold(right))
    for a, b in zip(once, twice, strict=True):
        np.testing.assert_allclose(a, b.reshape(a.shape), atol=1e-9)
    single = jax.jit(five_point)
    for i in range(3):
        np.testing.assert_allclose(
            single(left[i], right[i])[0][once[1][i]], once[0][i][once[1][i]], atol=1e-9
        )
    shared = jax.jit(jax.vmap(five_point, (None, 0)))(left[0], right)
    repeated = five_points(jnp.broadcast_to(left[:1], left.shape), right)
    np.testing.assert_array_equal(shared[1], repeated[1])


def test_no_lapack_and_no_gather():
    arguments = [jnp.zeros((4, 5, 3))] * 2
    eights = [jnp.zeros((4, 8, 3)), jnp.zeros((4, 8, 3)), jnp.zeros((4, 8))]
    poses = [jnp.zeros((4, 3, 3)), *eights[:2], jnp.zeros((4, 8), bool)]
    for function, inputs in (
        (five_point, arguments),
        (eight_point, eights),
        (decomposition.best_pose, poses),
    ):
        text = jax.jit(jax.vmap(function)).lower(*inputs).as_text()
        assert "lapack" not in text
        assert "stablehlo.gather" not in text


@pytest.mark.slow
def test_speed_of_five_points(capsys):
    p1, p2, *_ = scenes(15, 4096, 5)
    function = jax.jit(
        lambda a, b: jax.lax.map(lambda p: five_point(*p), (a, b), batch_size=64)
    )
    arguments = [jnp.asarray(p1), jnp.asarray(p2)]
    begin = time.process_time()
    jax.block_until_ready(function(*arguments))
    compiled = time.process_time() - begin
    times = []
    for _ in range(3):
        begin = time.perf_counter()
        jax.block_until_ready(function(*arguments))
        times.append(time.perf_counter() - begin)
    with capsys.disabled():
        print(
            f"\nfive_point: {min(times) / 4096 * 1e6:.1f} us a problem (chunks of 64), "
            f"first call {compiled:.1f} s"
        )


def test_eight_points_recover_the_truth():
    p1, p2, _, _, truth = scenes(20, BATCH, 9)
    seen = np.all(p2[..., 2] < -0.3, axis=1)
    p1, p2, truth = p1[seen], p2[seen], truth[seen]
    p2 = -p2 / p2[..., 2:]
    # the last place is not used, whatever stands there
    p2[:, 8] = 7.0
    weights = np.ones(p1.shape[:2])
    weights[:, 8] = 0.0
    for n in (9, 8):  # by the sums, and exactly
        e = np.asarray(
            jax.jit(jax.vmap(eight_point))(
                *map(jnp.asarray, (p1[:, :n], p2[:, :n], weights[:, :n]))
            )
        )
        error = distance(e, truth / np.sqrt(2))
        assert np.quantile(error, 0.9) < (1e-9 if n == 9 else 1e-11)
        assert np.isfinite(e).all()


def test_dependent_rows_leave_vectors_at_right_angles():
    rows = np.random.default_rng(4).normal(size=(6, 9, BATCH))
    rows[5], rows[4] = rows[0] + rows[1], 0.0
    found = np.asarray(jax.jit(null_space)(rows))
    np.testing.assert_allclose(np.einsum("rcp,kcp->rkp", rows, found), 0.0, atol=1e-13)
    np.testing.assert_allclose(
        np.einsum("jcp,kcp->pjk", found, found),
        np.broadcast_to(np.eye(3), (BATCH, 3, 3)),
        atol=1e-13,
    )


def test_eight_points_minimise_as_singular_values_do():
    rng = np.random.default_rng(0)
    p1, p2, *_ = scenes(21, BATCH, 12)
    seen = np.all(p2[..., 2] < -0.3, axis=1)
    p1, p2 = p1[seen], -p2[seen] / p2[seen][..., 2:]
    flat = np.array([1.0, 1.0, 0.0])
    p1, p2 = (p + 1e-3 * flat * rng.normal(size=p.shape) for p in (p1, p2))
    weights = rng.uniform(0.1, 1, p1.shape[:2])
    e = np.asarray(jax.jit(jax.vmap(eight_point))(*map(jnp.asarray, (p1, p2, weights))))
    for i in range(0, len(e), 5):
        transforms = []
        for p in (p1[i], p2[i]):
            w = weights[i] / weights[i].sum()
            centre = w @ p[:, :2]
            s = np.sqrt(2 / (w @ np.sum((p[:, :2] - centre) ** 2, axis=1)))
            transforms.append(
                np.array([[s, 0, s * centre[0]], [0, s, s * centre[1]], [0, 0, 1]])
            )
        first, second = transforms
        rows = np.einsum("ki,kj->kij", p1[i] @ first.T, p2[i] @ second.T).reshape(-1, 9)
        best = np.linalg.svd(np.sqrt(weights[i])[:, None] * rows)[2][8].reshape(3, 3)
        best = first.T @ best @ second
        assert distance(e[i], best / np.linalg.norm(best)) < 1e-8


@pytest.mark.parametrize("scale", [1.0, -3.0, 1e-4])
def test_decomposition_gives_the_orientation_back(scale):
    p1, p2, rotation, base, essential = scenes(30, 500, 6)
    mask = np.ones((500, 6), bool)
    mask[:, 5] = False
    p2[:, 5] = -p2[:, 5]  # behind, but not asked
    pose, count = jax.jit(jax.vmap(decomposition.best_pose))(
        *map(jnp.asarray, (scale * essential, p1, p2, mask))
    )
    assert np.all(np.asarray(count) == 5)
    np.testing.assert_allclose(pose.base, base, atol=1e-12)
    turned = jax.vmap(lambda one: rot.as_array(one.relative()[0]))(pose)
    np.testing.assert_allclose(turned, rotation, atol=1e-12)


def test_decomposition_of_a_measured_matrix_is_that_of_singular_values():
    rng = np.random.default_rng(1)
    *_, essential = scenes(31, 500, 1)
    noisy = essential + 0.05 * rng.normal(size=essential.shape)
    rotations, base = (
        np.asarray(a)
        for a in jax.jit(jax.vmap(decomposition.decompose))(jnp.asarray(noisy))
    )
    u, _, vt = np.linalg.svd(noisy)
    u, vt = (m * np.linalg.det(m)[:, None, None] for m in (u, vt))
    assert np.abs(np.sum(u[:, :, 2] * base, axis=1)) == pytest.approx(1.0, abs=1e-12)
    w = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    for expected in (u @ w @ vt, u @ w.T @ vt):
        nearest = np.abs(rotations - expected[:, None]).max((2, 3)).min(1)
        assert nearest.max() < 1e-10


def test_decomposition_survives_what_is_no_essential_matrix():
    for matrix in (np.zeros((3, 3)), np.eye(3), np.outer([1.0, 2, 3], [0.0, 1, 0])):
        rotations, base = decomposition.decompose(jnp.asarray(matrix))
        assert np.isfinite(np.asarray(rotations)).all()
        assert np.isfinite(np.asarray(base)).all()


def standard_pair(
    elements: np.ndarray, y: float, base: float, focal: float
) -> np.ndarray:
    """q = y_left - y_right of a flat pair in the six zones, photos turned by (alpha,
    chi, omega', alpha', chi')."""
    alpha, chi, omega2, alpha2, chi2 = elements

    def rotation(a, o, c):
        ra = np.array(
            [[np.cos(a), 0, -np.sin(a)], [0, 1, 0], [np.sin(a), 0, np.cos(a)]]
        )
        ro = np.array(
            [[1, 0, 0], [0, np.cos(o), -np.sin(o)], [0, np.sin(o), np.cos(o)]]
        )
        rc = np.array(
            [[np.cos(c), -np.sin(c), 0], [np.sin(c), np.cos(c), 0], [0, 0, 1]]
        )
        return ra @ ro @ rc

    ground = np.array(
        [[0, 0], [base, 0], [0, y], [base, y], [0, -y], [base, -y]], float
    )
    points = np.c_[ground, -focal * np.ones(6)]
    left = points @ rotation(alpha, 0, chi)
    right = (points - [base, 0, 0]) @ rotation(alpha2, omega2, chi2)
    return -focal * (left[:, 1] / left[:, 2] - right[:, 1] / right[:, 2])


@pytest.mark.parametrize(
    "shape", [(70.0, 70.0, 70.0), (63.0, 64.0, 150.0), (90.0, 60.0, 100.0)]
)
def test_six_points_are_right_to_first_order(shape):
    """Halving the angles quarters the error of the closed form."""
    rng = np.random.default_rng(2)
    for elements in 0.02 * rng.normal(size=(5, 5)):
        errors = []
        for factor in (1.0, 0.5, 0.25):
            q = standard_pair(factor * elements, *shape)
            start = six_points.six_points(jnp.asarray(q), *shape)
            assert isinstance(start, IndependentElements)
            errors.append(np.linalg.norm(np.array(start.values()) - factor * elements))
        assert errors[0] < 0.2 * np.linalg.norm(elements)
        assert errors[1] / errors[0] == pytest.approx(0.25, abs=0.1)
        assert errors[2] / errors[1] == pytest.approx(0.25, abs=0.06)


@pytest.mark.slow
def test_the_start_from_six_points_is_right_to_first_order():
    """On the 1971 geometry, padding and errors of ten minutes' size included; the
    adjustment ends where others end."""
    begun = problems.jit(lambda pair: SixPoints()(pair).pose)
    for given in (problems.table_2(), problems.dewitt()):
        pair = jaxro.pad(given, 12)
        solved = problems.orient(pair)
        for pose in (begun(given), begun(pair)):
            apart = problems.difference(pose, *problems.rotation_base(solved.pose))
            assert 1e-5 < max(apart) < 0.02
        other = problems.orient(pair, start=SixPoints())
        np.testing.assert_allclose(other.pose.values(), solved.pose.values(), atol=1e-9)
        assert other.result == solved.result


def test_first_order_equations_are_the_condition_at_zero_elements():
    """g / (f1 f2) and its slopes there, two focal lengths; the pose they lead to is
    right to first order."""
    pair = problems.tilted()
    wide = jaxro.pair(
        pair.x_left,
        pair.y_left,
        1.5 * pair.x_right,
        1.5 * pair.y_right,
        focal=(100.0, 150.0),
    )
    focals = wide.focal_left, wide.focal_right

    def condition(x):
        f = coplanarity.fundamental_matrix(
            *vertical(focals[0]).move(x).relative(), *focals
        )
        return jax.vmap(lambda point: coplanarity.condition(f, point))(
            wide.coordinates
        ) / (focals[0] * focals[1])

    zero = (jnp.zeros(()),) * 5
    (g,), slopes, _ = FirstOrder(wide).columns(zero)
    np.testing.assert_allclose(g, condition(zero), rtol=0, atol=1e-14)
    np.testing.assert_allclose(
        [s[0] for s in slopes],
        problems.jit(jax.jacfwd(condition))(zero),
        rtol=0,
        atol=1e-14,
    )
    truth = jaxro.orient(pair).pose.quaternion
    vertical_error, first, second = (
        float(np.max(np.abs(pose.quaternion - truth)))
        for pose in problems.jit(lambda pair: [approach(pair, k) for k in range(3)])(
            pair
        )
    )
    assert first < vertical_error**2 and second < 1e-4 * vertical_error


def test_first_order_design_is_the_derivative_of_the_parallax():
    shape = (63.0, 64.0, 150.0)
    steps = 1e-5 * np.eye(5)
    slopes = np.stack(
        [(standard_pair(s, *shape) - standard_pair(-s, *shape)) / 2e-5 for s in steps],
        axis=1,
    )
    np.testing.assert_allclose(
        six_points.first_order_design((1, 2, 3, 4, 5, 6), *shape), -slopes, atol=1e-5
    )


@pytest.mark.parametrize("focal", [70.0, 150.0, 300.0])
def test_first_order_residuals(focal):
    """The 36ths of exact least squares, whatever the focal length; NumPy agrees on any
    layout."""
    seven = six_points.first_order_residuals(
        six_points.SEVEN_ZONES, 36 * jnp.eye(7)[6], 70.0, 70.0, focal
    )
    eight = six_points.first_order_residuals(
        six_points.EIGHT_ZONES, 36 * jnp.eye(8)[6], 70.0, 70.0, focal
    )
    np.testing.assert_allclose(
        seven, [3.13, -3.13, -1.57, -17.22, -1.57, 1.57, 18.78], atol=0.006
    )
    np.testing.assert_allclose(
        eight, [-3.27, 3.27, -17.18, -0.82, 1.64, -1.64, 18.82, -0.82], atol=0.006
    )
    zones = (1, 2, 3, 4, 5, 6, 3, 3, 6, 1)
    errors = np.random.default_rng(3).normal(size=10)
    design = np.asarray(six_points.first_order_design(zones, 60.0, 80.0, focal))
    expected = errors - design @ np.linalg.lstsq(design, errors, rcond=None)[0]
    ours = six_points.first_order_residuals(
        zones, jnp.asarray(errors), 60.0, 80.0, focal
    )
    np.testing.assert_allclose(ours, expected, atol=1e-10)
    assert (
        np.abs(six_points.first_order_residuals((1, 2, 3), jnp.ones(3))).max() < 1e-12
    )


def test_printed_residuals():
    """The paper's averaged residuals: near the exact ones, and symmetric in left and
    right as the layout is."""
    seven, eight = (
        six_points.printed_residuals_seven(36.0),
        six_points.printed_residuals_eight(36.0, 0.0),
    )
    np.testing.assert_allclose(seven, [0, 4, -6, -17, 6, 1, 19])
    np.testing.assert_allclose(eight, [-3, 3, -16.5, -1.5, 1.5, -1.5, 19.5, -1.5])
    exact = six_points.first_order_residuals(six_points.EIGHT_ZONES, 36 * jnp.eye(8)[6])
    assert np.abs(eight - exact).max() < 0.7
    both = six_points.printed_residuals_eight(24.0, 24.0)
    np.testing.assert_allclose(both, [0, 0, -12, -12, 0, 0, 12, 12], atol=1e-12)
