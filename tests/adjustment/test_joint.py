"""Several kinds of conditions between many blocks of parameters, against dense normal
equations in plain NumPy."""

from concurrent.futures import ThreadPoolExecutor

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import problems
import pytest

import jaxro
from jaxro import losses
from jaxro.adjustment import RESULTS, Term, adjust, symmetric

# -------------------------------------------------------------------------------------
# a levelling net

NODES = 300


@pytest.fixture(scope="module")
def net():
    """Legs of a chain of nodes and of many ties: start, end, variance, rise."""
    rng = np.random.default_rng(0)
    start = np.concatenate([np.arange(NODES - 1), rng.integers(0, NODES, 600)])
    end = np.concatenate([np.arange(1, NODES), rng.integers(0, NODES, 600)])
    apart = start != end
    start, end = start[apart], end[apart]
    variance, height = rng.uniform(0.5, 2, len(start)), rng.normal(size=NODES)
    return (
        start,
        end,
        variance,
        height[end] - height[start] + rng.normal(size=len(start)) * np.sqrt(variance),
    )


def legs(net, mask=None):
    start, end, variance, rise = net
    return Term(
        lambda a, b, rise: b - a - rise,
        rise,
        variance,
        touches=[("height", start), ("height", end)],
        mask=mask,
    )


KNOWN = Term(
    lambda height, known: height - known,
    np.array([1.5]),
    0.01,
    touches=[("height", np.array([0]))],
)
solve = eqx.filter_jit(lambda term: adjust([term, KNOWN], {"height": jnp.zeros(NODES)}))


def dense(net):
    """The matrix of all legs and of the known height, the weights and what is
    measured."""
    start, end, variance, rise = net
    a = np.zeros((len(start) + 1, NODES))
    a[np.arange(len(start)), end] = 1
    a[np.arange(len(start)), start] -= 1
    a[-1, 0] = 1
    return a, np.append(1 / variance, 100.0), np.append(rise, 1.5)


def test_three_hundred_heights_from_two_threads(net):
    a, w, measured = dense(net)
    n = a.T @ (w[:, None] * a)
    q = np.linalg.inv(n)
    heights = q @ (a.T @ (w * measured))
    v = a @ heights - measured
    with ThreadPoolExecutor(2) as pool:
        both = list(pool.map(lambda _: solve(legs(net)), range(8)))
    for found in both:
        assert found.result == RESULTS.successful
        np.testing.assert_allclose(found.parameters["height"], heights, atol=1e-12)
        np.testing.assert_allclose(found.cofactor, q, atol=1e-12)
        np.testing.assert_allclose(
            found.covariance("height", 1.0)[:, 0, 0], np.diag(q), atol=1e-12
        )
        redundancy = 1 - np.einsum("gi,ij,gj->g", a, q, a) * w
        np.testing.assert_allclose(
            np.concatenate([r[:, 0] for r in found.redundancy]), redundancy, atol=1e-11
        )
        np.testing.assert_allclose(
            found.sigma0**2, np.sum(w * v**2) / (len(w) - NODES), rtol=1e-11
        )
        assert found.degrees_of_freedom == len(w) - NODES


@pytest.mark.parametrize("eliminate", [None, "far"])
@pytest.mark.parametrize("solver", [None, jaxro.adjustment.LevenbergMarquardt()])
def test_what_is_held_is_known(eliminate, solver):
    """Points of a plane by distances from two stations, one of which has a known
    coordinate; the last point is known: as if their columns were not there."""
    rng = np.random.default_rng(3)
    near = np.array([[0.0, 0], [9, 1], [4, -7]])
    far = rng.uniform(-4, 12, (4, 2))
    station, point = (grid.ravel() for grid in np.indices((3, 4)))
    apart = np.linalg.norm(near[station] - far[point], axis=1)
    term = Term(
        lambda a, b, length: jnp.sqrt(jnp.sum((a - b) ** 2)) - length,
        apart + 0.01 * rng.normal(size=apart.shape),
        1e-4,
        touches=[("near", station), ("far", point)],
    )
    held = {
        "near": np.array([[True, True], [False, True], [False, False]]),
        "far": np.arange(4) == 3,
    }
    start = {"near": near, "far": far}
    found = adjust(term, start, held=held, eliminate=eliminate, solver=solver)
    moved = {name: np.asarray(found.parameters[name]) for name in start}
    np.testing.assert_array_equal(moved["near"][held["near"]], near[held["near"]])
    np.testing.assert_array_equal(moved["far"][3], far[3])

    away = moved["near"][station] - moved["far"][point]
    slope = away / np.linalg.norm(away, axis=1)[:, None] / 0.01
    design = np.zeros((len(apart), 14))
    for k in range(2):
        design[np.arange(len(apart)), 2 * station + k] = slope[:, k]
        design[np.arange(len(apart)), 6 + 2 * point + k] = -slope[:, k]
    free = ~np.concatenate([held["near"].ravel(), np.repeat(held["far"], 2)])
    q = np.zeros((14, 14))
    q[np.ix_(free, free)] = np.linalg.inv(design[:, free].T @ design[:, free])
    for name, begin in (("near", 0), ("far", 6)):
        for k, own in enumerate(np.asarray(found.cofactors(name))):
            places = slice(begin + 2 * k, begin + 2 * k + 2)
            np.testing.assert_allclose(own, q[places, places], atol=1e-9)
    redundancy = 1 - np.einsum("gi,ij,gj->g", design, q, design)
    np.testing.assert_allclose(found.redundancy[0][:, 0], redundancy, atol=1e-7)
    assert found.degrees_of_freedom == len(apart) - np.sum(free)
    misfit = np.asarray(found.residuals[0][:, 0])
    np.testing.assert_allclose(design[:, free].T @ misfit, 0, atol=1e-6)
    if eliminate is solver is None:
        mild = adjust(term, start, held=held, loss=losses.Huber(1e3))
        np.testing.assert_allclose(mild.sigma0, found.sigma0, rtol=1e-6)


def test_a_net_without_a_known_height_needs_a_constraint(net):
    """Its mean as datum gives the pseudoinverse; without one that is told."""
    start = {"height": jnp.zeros(NODES)}
    a, w, measured = (entry[:-1] for entry in dense(net))
    q = np.linalg.pinv(a.T @ (w[:, None] * a))
    datum = lambda p: jnp.sum(p["height"])

    @eqx.filter_jit
    def with_and_without(term):
        return adjust([term], start, constraints=datum), adjust(term, start).result

    found, free = with_and_without(legs(net))
    np.testing.assert_allclose(
        found.parameters["height"], q @ (a.T @ (w * measured)), atol=1e-11
    )
    np.testing.assert_allclose(found.cofactor, q, atol=1e-11)
    assert (
        found.result == RESULTS.successful
        and found.degrees_of_freedom == len(w) - NODES + 1
    )
    assert free == RESULTS.rank_deficient


def test_masked_groups_do_not_count_and_a_loss_fades_outliers(net):
    start, end, variance, rise = net
    use = np.arange(len(rise)) % 7 > 0
    part = solve(legs((start, end, variance, np.where(use, rise, 1e3)), use))
    left = eqx.filter_jit(
        lambda term: adjust([term, KNOWN], {"height": jnp.zeros(NODES)})
    )(legs(tuple(column[use] for column in net)))
    np.testing.assert_allclose(
        part.parameters["height"], left.parameters["height"], atol=1e-11
    )
    np.testing.assert_allclose(part.sigma0, left.sigma0, rtol=1e-11)
    loss = losses.Huber()
    robust = lambda term: adjust(
        [term, KNOWN], {"height": jnp.zeros(NODES)}, loss=loss, max_steps=200
    )
    wrong = rise.copy()
    wrong[400] += 1000.0
    found = eqx.filter_jit(robust)(legs((start, end, variance, wrong)))
    a, w, _ = dense(net)
    r = np.sqrt(w) * (a @ found.parameters["height"] - np.append(wrong, 1.5))
    faded = np.asarray(loss.weight(jnp.asarray(r**2)))
    np.testing.assert_allclose(
        a.T @ (np.sqrt(w) * faded * r), np.zeros(NODES), atol=1e-7
    )
    assert found.result == RESULTS.successful and faded[400] < 0.01


def test_derivatives_are_those_of_the_solution(net):
    """Of a height by every rise: the row of Q Aᵀ P."""
    a, w, _ = dense(net)
    row = np.linalg.inv(a.T @ (w[:, None] * a))[17] @ (a.T * w)
    start, end, variance, rise = net
    height = lambda rise: solve(legs((start, end, variance, rise))).parameters[
        "height"
    ][17]
    np.testing.assert_allclose(
        jax.grad(height)(jnp.asarray(rise)), row[:-1], atol=1e-10
    )


# ------------------------------------------------------------------------------------
# a bundle

CAMERAS, POINTS, RAYS, CONTROL = 10, 120, 5, 12
FOCAL, IMAGE_SIGMA, GROUND_SIGMA = 100.0, 0.005, 0.02


def photo(xp, camera, point):
    """Photo coordinates by the collinearity equations; the rotation by (1, w/2) as a
    quaternion, not normalised."""
    a, b, c = camera[0] / 2, camera[1] / 2, camera[2] / 2
    x, y, z = point[0] - camera[3], point[1] - camera[4], point[2] - camera[5]
    s = 1 + a * a + b * b + c * c
    u = (
        (1 + a * a - b * b - c * c) * x + 2 * (a * b - c) * y + 2 * (a * c + b) * z
    ) / s
    v = (
        2 * (a * b + c) * x + (1 - a * a + b * b - c * c) * y + 2 * (b * c - a) * z
    ) / s
    w = (
        2 * (a * c - b) * x + 2 * (b * c + a) * y + (1 - a * a - b * b + c * c) * z
    ) / s
    return xp.stack([-FOCAL * u / w, -FOCAL * v / w])


@pytest.fixture(scope="module")
def bundle():
    """Photos over hilly ground, each point on some of them, some points known: what is
    measured, and a start."""
    rng = np.random.default_rng(1)
    cameras = np.concatenate(
        [
            rng.normal(0, 0.1, (CAMERAS, 3)),
            rng.uniform(-300, 300, (CAMERAS, 2)),
            rng.uniform(900, 1100, (CAMERAS, 1)),
        ],
        axis=1,
    )
    points = np.concatenate(
        [rng.uniform(-400, 400, (POINTS, 2)), rng.uniform(0, 150, (POINTS, 1))], axis=1
    )
    camera = np.concatenate([rng.permutation(CAMERAS)[:RAYS] for _ in range(POINTS)])
    point = np.repeat(np.arange(POINTS), RAYS)
    rays = photo(np, cameras[camera].T, points[point].T).T + rng.normal(
        0, IMAGE_SIGMA, (POINTS * RAYS, 2)
    )
    ground = points[:CONTROL] + rng.normal(0, GROUND_SIGMA, (CONTROL, 3))
    near = (
        cameras + rng.normal(0, 1, cameras.shape) * [0.01, 0.01, 0.01, 5, 5, 5],
        points + rng.normal(0, 5, points.shape),
    )
    return camera, point, rays, ground, near


def terms_of(bundle):
    camera, point, rays, ground, _ = bundle
    image = lambda camera, point, measured: photo(jnp, camera, point) - measured
    return [
        Term(
            image, rays, IMAGE_SIGMA**2, touches=[("camera", camera), ("point", point)]
        ),
        Term(
            lambda point, known: point - known,
            ground,
            GROUND_SIGMA**2,
            touches=[("point", np.arange(CONTROL))],
        ),
    ]


def oracle(bundle):
    """Gauss-Newton on all 420 parameters at once, derivatives by complex steps:
    cameras, points, Q, Σ r²."""
    camera, point, rays, ground, (cameras, points) = bundle
    rows, count = 2 * len(camera), 6 * CAMERAS
    for _ in range(8):
        j, step = np.zeros((rows + 3 * CONTROL, count + 3 * POINTS)), 1e-30
        place = np.arange(rows).reshape(-1, 2)
        for k in range(9):
            c, p = cameras[camera].astype(complex), points[point].astype(complex)
            (c if k < 6 else p)[:, k if k < 6 else k - 6] += 1j * step
            column = 6 * camera + k if k < 6 else count + 3 * point + k - 6
            j[place, column[:, None]] = photo(np, c.T, p.T).T.imag / step / IMAGE_SIGMA
        j[rows + np.arange(3 * CONTROL), count + np.arange(3 * CONTROL)] = (
            1 / GROUND_SIGMA
        )
        r = np.concatenate(
            [
                (
                    (photo(np, cameras[camera].T, points[point].T).T - rays)
                    / IMAGE_SIGMA
                ).ravel(),
                ((points[:CONTROL] - ground) / GROUND_SIGMA).ravel(),
            ]
        )
        n = j.T @ j
        delta = np.linalg.solve(n, j.T @ r)
        cameras, points = (
            cameras - delta[:count].reshape(-1, 6),
            points - delta[count:].reshape(-1, 3),
        )
    q = np.linalg.inv(n)
    return cameras, points, q, np.sum(r**2), 1 - np.sum((j @ q) * j, axis=1)


def test_a_bundle_with_its_points_eliminated(bundle):
    cameras, points, q, squares, redundancy = oracle(bundle)
    start = {"camera": jnp.asarray(bundle[-1][0]), "point": jnp.asarray(bundle[-1][1])}
    found = jax.jit(lambda start: adjust(terms_of(bundle), start, eliminate="point"))(
        start
    )
    assert found.result == RESULTS.successful
    count = 6 * CAMERAS
    deviations = np.sqrt(np.diag(q))
    unit = deviations[:, None] * deviations[None, :]
    np.testing.assert_allclose(
        (found.parameters["camera"] - cameras).ravel() / deviations[:count],
        np.zeros(count),
        atol=1e-8,
    )
    np.testing.assert_allclose(
        (found.parameters["point"] - points).ravel() / deviations[count:],
        np.zeros(3 * POINTS),
        atol=1e-8,
    )
    np.testing.assert_allclose(
        found.cofactor / unit[:count, :count], (q / unit)[:count, :count], atol=1e-9
    )
    of_points = np.stack(
        [q[k : k + 3, k : k + 3] for k in range(count, count + 3 * POINTS, 3)]
    )
    variance = np.stack(
        [unit[k : k + 3, k : k + 3] for k in range(count, count + 3 * POINTS, 3)]
    )
    np.testing.assert_allclose(
        found.cofactors("point") / variance, of_points / variance, atol=1e-9
    )
    np.testing.assert_allclose(
        np.concatenate([r.ravel() for r in found.redundancy]), redundancy, atol=1e-9
    )
    np.testing.assert_allclose(
        found.sigma0**2 * int(found.degrees_of_freedom), squares, rtol=1e-9
    )
    assert (
        found.degrees_of_freedom == 2 * POINTS * RAYS + 3 * CONTROL - count - 3 * POINTS
    )
    assert 0.9 < found.sigma0 < 1.1


def test_a_bundle_without_control_is_told(bundle):
    start = {"camera": jnp.asarray(bundle[-1][0]), "point": jnp.asarray(bundle[-1][1])}
    free = jax.jit(
        lambda start: adjust(terms_of(bundle)[:1], start, eliminate="point")
    )(start)
    assert free.result != RESULTS.successful


@pytest.mark.slow
def test_a_pair_as_one_of_several_terms_is_the_pair():
    """Elements that move in their own way, as a family of two: two pairs at once are
    each of them alone."""
    cases = [problems.CASES[name] for name in ("near-vertical", "convergent")]
    pairs, poses = [case.measure() for case in cases], [case.pose for case in cases]
    alone = [
        problems.orient(
            pair, elements=jaxro.RelativePose, start=pose, base=jnp.ones(())
        )
        for pair, pose in zip(pairs, poses, strict=True)
    ]
    alone = jax.tree.map(lambda *a: jnp.stack(a), *alone)
    flat = tuple(
        jnp.concatenate(c) for c in zip(*(p.coordinates for p in pairs), strict=True)
    )
    count, focal = len(pairs[0].x_left), cases[0].focal

    def condition(pose, point):
        x1, y1, x2, y2 = point
        rotation, base = pose.relative()
        left, right = (
            jnp.stack([x1, y1, -focal]),
            jnp.stack([jnp.stack(row) for row in rotation]),
        )
        return jnp.dot(
            jnp.stack(base), jnp.cross(left, right @ jnp.stack([x2, y2, -focal]))
        )

    number = np.repeat(np.arange(2), count)
    term = Term(condition, flat, 1.0, touches=[("pose", number)])
    off = tuple(jnp.array([0.02, -0.01, 0.01, 0.02, -0.02]))
    near = jax.jit(jax.vmap(lambda pose: pose.move(off).normalise()))(alone.pose)
    found = eqx.filter_jit(adjust)(term, {"pose": near})
    for one, other in zip(
        jax.tree.leaves(found.parameters["pose"]),
        jax.tree.leaves(alone.pose),
        strict=True,
    ):
        np.testing.assert_allclose(one, other, atol=1e-9)
    unit = np.sqrt(np.einsum("kii->ki", np.asarray(alone.cofactor)))
    unit = unit[:, :, None] * unit[:, None, :]
    np.testing.assert_allclose(
        found.cofactors("pose") / unit, alone.cofactor / unit, atol=1e-6
    )


# ------------------------------------------------------------------------------------
# the parts


@pytest.mark.parametrize("size", [1, 13, 32, 75])
def test_inverse_of_a_badly_scaled_matrix(size):
    rng = np.random.default_rng(size)
    a = rng.normal(size=(2 * size, size)) * np.exp(rng.normal(0, 3, size))
    inverse = np.linalg.inv(a.T @ a)
    deviation = np.sqrt(np.diag(inverse))
    found = jax.jit(symmetric.inverse)(jnp.asarray(a.T @ a))
    unit = deviation[:, None] * deviation
    np.testing.assert_allclose(found.matrix / unit, inverse / unit, atol=1e-12)
    # the last pivot is what all others leave of its row
    np.testing.assert_allclose(
        found.pivots[-1], 1 / (inverse[-1, -1] * (a.T @ a)[-1, -1]), rtol=1e-9
    )


@pytest.mark.parametrize(
    ("start", "eliminate", "said"),
    [
        ({"heights": jnp.zeros(NODES)}, None, "there are no parameters"),
        (
            {"height": jnp.zeros(NODES), "point": jnp.zeros((4, 3))},
            None,
            "no condition touches",
        ),
        ({"height": jnp.zeros(NODES)}, "height", "joins two blocks"),
    ],
)
def test_what_cannot_be_adjusted_is_told(net, start, eliminate, said):
    with pytest.raises(ValueError, match=said):
        adjust([legs(net)], start, eliminate=eliminate)


def test_a_member_that_is_not_there_is_told():
    """JAX itself would take the last one."""
    beyond = Term(
        lambda height, known: height - known,
        np.array([1.5]),
        0.01,
        touches=[("height", np.array([3]))],
    )
    with pytest.raises(ValueError, match="not there"):
        adjust(beyond, {"height": jnp.zeros(3)})


def test_the_engine_knows_no_photo():
    """Its imports stay within it and the compiler's seam, and it asks for no kind of
    elements."""
    import ast
    from pathlib import Path

    seam = {"xla.kernels", "xla.passes", "xla.programs", "xla.settings"}
    for file in Path(jaxro.adjustment.__file__).parent.glob("*.py"):
        text = file.read_text(encoding="utf-8")
        above = {
            n.module or ""
            for n in ast.walk(ast.parse(text))
            if isinstance(n, ast.ImportFrom) and n.level > 1
        }
        assert above <= seam, file.name
        assert "lements)" not in text, file.name


def circle_by_gauss_and_helmert(x, y, variance_x, variance_y, start):
    """x0, y0, r and their cofactors in plain NumPy, linearised anew at the adjusted
    points in every turn."""
    parameters, measured = np.array(start), np.stack([x, y])
    q = np.stack([variance_x, variance_y])
    points, inverse = measured.copy(), np.eye(3)
    for _ in range(60):
        away = points - parameters[:2, None]
        by_point = 2 * away
        by_parameter = np.stack(
            [-2 * away[0], -2 * away[1], -2 * parameters[2] + 0 * x]
        )
        g = np.sum(away**2, axis=0) - parameters[2] ** 2
        w = g + np.sum(by_point * (measured - points), axis=0)
        weight = 1 / np.sum(by_point**2 * q, axis=0)
        inverse = np.linalg.inv((by_parameter * weight) @ by_parameter.T)
        step = -inverse @ ((by_parameter * weight) @ w)
        correlates = weight * (w + step @ by_parameter)
        parameters = parameters + step
        points = measured - q * by_point * correlates
    return parameters, inverse


def test_conditions_linear_in_the_measurement_give_the_exact_minimum():
    """A circle with an angle for each point, as docs/extending.md shows it."""
    random = np.random.default_rng(3)
    angle = np.linspace(0.2, 4.5, 12)
    x, y = 7 + 4 * np.cos(angle), 5 + 4 * np.sin(angle)
    sigma = np.stack([random.uniform(0.001, 0.05, 12), random.uniform(0.001, 0.05, 12)])
    x, y = np.stack([x, y]) + sigma * random.normal(size=(2, 12))

    def on_circle(circle, point, measured):
        (x0, y0, radius), (angle,) = circle, point
        x = x0 + radius * jnp.cos(angle) - measured[0]
        return jnp.stack([x, y0 + radius * jnp.sin(angle) - measured[1]])

    number = np.arange(12)
    touches = [("circle", 0 * number), ("point", number)]
    measured = jnp.asarray(x), jnp.asarray(y)
    term = Term(on_circle, measured, tuple(jnp.asarray(sigma**2)), touches=touches)
    start = {
        "circle": (np.array([7]), np.array([5]), np.array([4])),
        "point": (np.arctan2(y - 5, x - 7),),
    }
    found = eqx.filter_jit(adjust)(term, start, eliminate="point")
    expected, cofactor = circle_by_gauss_and_helmert(x, y, *sigma**2, (7.0, 5.0, 4.0))
    ours = np.stack(found.parameters["circle"])[:, 0]
    np.testing.assert_allclose(ours, expected, atol=1e-9)
    np.testing.assert_allclose(
        found.covariance("circle", sigma0=1)[0], cofactor, rtol=1e-9, atol=1e-15
    )


def test_a_start_and_a_condition_of_the_wrong_form_are_told():
    term = Term(
        lambda a, l: a[0] - l, jnp.ones(3), 1.0, touches=[("a", np.zeros(3, int))]
    )
    with pytest.raises(ValueError, match="array over all blocks"):
        adjust(term, {"a": (8,)})
    several = Term(lambda a, l: (a[0] - l, a[0]), jnp.ones(3), 1.0)
    with pytest.raises(ValueError, match=r"returned a tuple.*jnp\.stack"):
        adjust(several, (8,))
