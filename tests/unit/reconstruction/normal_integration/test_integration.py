"""Height from normals: against closed forms, a sparse direct solve, and what could go wrong."""

import numpy as np
import pytest
from scipy import sparse
from scipy.sparse.linalg import spsolve

from reconstruction.normal_integration import slope_fields
from reconstruction.normal_integration.discontinuities import (
    BilateralSettings,
    integrate_with_discontinuities,
)
from reconstruction.normal_integration.integration import (
    ConvergenceError,
    IntegrationSettings,
    integrate,
    integrate_map,
)
from reconstruction.normal_integration.slope_fields import Perspective
from reconstruction.normal_integration.weighted_poisson import (
    IntegrationError,
    MultigridHierarchy,
    solve_poisson,
)
from reconstruction.normal_maps import NormalMaps


def crooked_surface(rows, columns, steepness=1.0):
    """Return height in px and normals (y up) of a surface without any symmetry."""
    y, x = np.mgrid[0:rows, 0:columns].astype(float)
    height = steepness * (3.0 * np.sin(x / 9.0 + 0.3) + 2.0 * np.cos(y / 7.0) + 0.002 * x * y)
    right = steepness * (np.cos(x / 9.0 + 0.3) / 3.0 + 0.002 * y)
    down = steepness * (-2.0 / 7.0 * np.sin(y / 7.0) + 0.002 * x)
    return height, normals_of(right, down)


def normals_of(right, down):
    """Return unit normals, y up, of slopes to the right and down."""
    n = np.stack([-right, down, np.ones_like(right)], axis=-1)
    return n / np.linalg.norm(n, axis=-1, keepdims=True)


def centered(values, mask):
    return np.where(mask, values - values[mask].mean(), 0.0)


def disc(rows, columns):
    y, x = np.mgrid[0:rows, 0:columns]
    return ((y - rows / 2) / rows) ** 2 + ((x - columns / 2.2) / columns) ** 2 < 0.17


def direct(ax, ay, dx, dy):
    """Solve the same least squares by an assembled matrix and a direct solver, part by part."""
    shape = ax.shape
    number = np.arange(ax.size).reshape(shape)
    begin = np.concatenate([number[:, :-1].ravel(), number[:-1].ravel()])
    end = np.concatenate([number[:, 1:].ravel(), number[1:].ravel()])
    weight = np.concatenate([ax[:, :-1].ravel(), ay[:-1].ravel()]).astype(float)
    wanted = np.concatenate([dx[:, :-1].ravel(), dy[:-1].ravel()])
    used = weight > 0
    begin, end, weight, wanted = begin[used], end[used], weight[used], wanted[used]
    edges = np.arange(begin.size)
    D = sparse.csr_matrix(
        (
            np.concatenate([-np.ones_like(weight), np.ones_like(weight)]),
            (np.concatenate([edges, edges]), np.concatenate([begin, end])),
        ),
        shape=(begin.size, ax.size),
    )
    A = D.T @ sparse.diags(weight) @ D
    count, part = sparse.csgraph.connected_components(A, directed=False)
    pins = np.unique(part, return_index=True)[1]
    extra = sparse.csr_matrix((np.ones(count), (pins, pins)), shape=A.shape)
    x = spsolve((A + extra).tocsc(), D.T @ (weight * wanted))
    means = np.bincount(part, weights=x) / np.bincount(part)
    return (x - means[part]).reshape(shape)


@pytest.mark.parametrize("method", ["dct", "multigrid"])
def test_asymmetric_surface_returns_correctly_oriented(method):
    truth, normals = crooked_surface(70, 90)
    height = integrate(
        normals, pixel=6.0, method=method, settings=IntegrationSettings(tolerance=1e-9)
    )
    error = height / 6.0 - centered(truth, np.ones(truth.shape, bool))
    # waves of 1/9 and 1/7 rad a pixel: third order at the border's edges
    assert np.abs(error).max() < 2e-3
    mirrored = integrate(normals, pixel=6.0, method=method, y_up=False)
    assert np.abs(mirrored / 6.0 - centered(truth, np.ones(truth.shape, bool))).max() > 1.0


def test_normals_with_y_down_need_y_up_false():
    _, normals = crooked_surface(40, 50)
    flipped = normals * [1.0, -1.0, 1.0]
    np.testing.assert_allclose(integrate(flipped, y_up=False), integrate(normals), atol=1e-12)


def test_plane_is_exact_for_any_order_and_scale(rng):
    y, x = np.mgrid[0:13, 0:17]
    normals = np.broadcast_to(normals_of(np.array(0.4), np.array(-1.1)), (13, 17, 3))
    truth = 0.4 * x - 1.1 * y
    for order in (2, 4):
        height = integrate(normals * 7.0, pixel=2.5, settings=IntegrationSettings(order=order))
        np.testing.assert_allclose(height, 2.5 * (truth - truth.mean()), atol=1e-10)


def test_fourth_order_leaves_thirtieth_of_second_order_error():
    x = np.mgrid[0:96, 0:96][1]
    theta = 2 * np.pi * 8 / 96
    truth = np.cos(theta * (x + 0.5))  # even at both borders
    normals = normals_of(-theta * np.sin(theta * (x + 0.5)), np.zeros((96, 96)))
    inner = slice(20, -20)
    error = {
        order: np.abs(integrate(normals, settings=IntegrationSettings(order=order)) - truth)[
            :, inner
        ].max()
        for order in (2, 4)
    }
    assert error[2] == pytest.approx(theta**2 / 12, rel=0.2)
    assert error[4] < 1.5 * 11 / 720 * theta**4 + 2e-3 < error[2] / 5


@pytest.mark.parametrize("weighted", [False, True])
@pytest.mark.parametrize(
    "mask", ["disc", "parts", "pepper", "checkerboard", "necks", "odd rows", "one pixel", "spiral"]
)
def test_multigrid_matches_direct_solver(mask, weighted, rng):
    rows, columns = 45, 62
    _, normals = crooked_surface(rows, columns)
    y, x = np.mgrid[0:rows, 0:columns]
    valid = {
        "disc": disc(rows, columns),
        "parts": disc(rows, columns) & (x != 30) & (abs(x - y) > 1),
        "pepper": rng.random((rows, columns)) > 0.35,
        "checkerboard": (x + y) % 2 == 0,
        "necks": ((x % 13) < 9) | (y == 21),
        "odd rows": (y % 2 == 1) | ((x == 0) & (y > 9)),
        "one pixel": (x == 7) & (y == 5),
        "spiral": (y % 4 != 3) | ((x == 0) & (y % 8 == 3)) | ((x == columns - 1) & (y % 8 == 7)),
    }[mask]
    stderr = rng.uniform(0.005, 0.05, (rows, columns)) if weighted else None
    noisy = normals + 0.1 * rng.standard_normal(normals.shape) * [1, 1, 0]
    slopes = slope_fields.from_normals(noisy, valid=valid, stderr_rad=stderr)
    ax, ay, dx, dy = slope_fields.edges(slopes)
    expected = direct(ax, ay, dx, dy)[1:-1, 1:-1]
    settings = IntegrationSettings(tolerance=1e-10)
    found = integrate_map(
        noisy, valid=valid, stderr_rad=stderr, method="multigrid", settings=settings
    )
    assert found.convergence.converged
    np.testing.assert_array_equal(found.valid, valid)
    np.testing.assert_allclose(found.height, np.where(valid, expected, 0.0), atol=1e-6)
    for number in range(1, found.part.max() + 1):
        assert abs(found.height[found.part == number].mean()) < 1e-9


def test_cosines_and_multigrid_solve_the_same_equations(rng):
    _, normals = crooked_surface(41, 58)
    noisy = normals + 0.05 * rng.standard_normal(normals.shape)
    tight = IntegrationSettings(tolerance=1e-11)
    a = integrate(noisy, method="dct", settings=tight)
    b = integrate(noisy, method="multigrid", settings=tight)
    np.testing.assert_allclose(a, b, atol=1e-8)


def test_a_cycle_is_a_symmetric_positive_preconditioner(rng):
    _, normals = crooked_surface(37, 29)
    valid = rng.random((37, 29)) > 0.2
    ax, ay, *_ = slope_fields.edges(slope_fields.from_normals(normals, valid=valid))
    hierarchy = MultigridHierarchy(ax, ay)
    inside = np.pad(valid, 1)

    def cycle(b):
        x = np.zeros_like(ax)
        hierarchy.cycle(b, x)
        return x.astype(float)

    a, b = (
        (np.where(inside, rng.standard_normal(ax.shape), 0.0)).astype(np.float32) for _ in range(2)
    )
    left, right = np.vdot(cycle(a), b), np.vdot(a, cycle(b))
    assert left == pytest.approx(
        right, abs=2e-5 * np.sqrt(np.vdot(cycle(a), a) * np.vdot(cycle(b), b))
    )
    assert np.vdot(cycle(a), a) > 0


def test_iterations_barely_grow_with_image_size():
    counts = []
    for side in (64, 256):
        _, normals = crooked_surface(side, side)
        found = integrate_map(normals, valid=disc(side, side))
        counts.append(found.convergence.iterations)
        assert found.convergence.residual <= 1e-5
    assert max(counts) <= 9


def test_the_result_does_not_depend_on_threads():
    numba = pytest.importorskip("numba")
    _, normals = crooked_surface(80, 130)
    before = numba.get_num_threads()
    heights = []
    try:
        for threads in {1, before}:
            numba.set_num_threads(threads)
            heights.append(integrate(normals, valid=disc(80, 130), stderr_rad=0.02))
    finally:
        numba.set_num_threads(before)
    for height in heights:
        np.testing.assert_array_equal(height, heights[0])


def test_weights_protect_height_from_noisy_region(rng):
    truth, normals = crooked_surface(96, 96)
    stderr = np.full((96, 96), 0.01)
    stderr[30:60, 30:60] = 1.0
    noisy = normals + stderr[..., None] / np.sqrt(2) * rng.standard_normal(normals.shape) * [
        1,
        1,
        0,
    ]
    good = np.ones((96, 96), bool)
    good[25:65, 25:65] = False
    weighed = integrate(noisy, stderr_rad=stderr)
    alike = integrate(noisy)

    def rms(height):
        error = (height - truth)[good]
        return np.std(error)

    assert rms(weighed) < 0.15
    assert rms(alike) > 3.0 * rms(weighed)


def test_weights_over_twelve_decades_are_solved(rng):
    _, normals = crooked_surface(48, 48)
    stderr = 10.0 ** rng.uniform(-4.0, 2.0, (48, 48))
    slopes = slope_fields.from_normals(normals, stderr_rad=stderr)
    found = integrate_map(normals, stderr_rad=stderr, settings=IntegrationSettings(tolerance=1e-8))
    assert found.convergence.converged
    ax = slope_fields.edges(slopes)[0]
    assert ax[ax > 0].max() > 1e6 * ax[ax > 0].min()
    truth, _ = crooked_surface(48, 48)
    assert np.std(found.height - truth) < 0.05


@pytest.mark.parametrize("focal_px", [50_000.0, 400.0])
def test_perspective_finds_sphere_depth_from_pinhole_view(focal_px):
    # Rays meet a sphere of radius 0.3 of the distance; all in closed form.
    side, pixel = 81, 0.006
    distance = focal_px * pixel
    center = (37.0, 43.5)
    radius = 3.0 * side * pixel
    column, row = np.meshgrid(np.arange(side), np.arange(side))
    ray = np.stack(
        [(column - center[0]) / focal_px, (center[1] - row) / focal_px, -np.ones((side, side))], -1
    )
    middle = np.array([0.02, -0.03, -radius])
    eye = np.array([0.0, 0.0, distance])
    a = np.sum(ray * ray, -1)
    b = np.sum(ray * (eye - middle), -1)
    c = np.sum((eye - middle) ** 2) - radius**2
    depth = (-b - np.sqrt(b * b - a * c)) / a
    points = eye + depth[..., None] * ray
    normals = (points - middle) / radius
    truth = points[..., 2]
    camera = Perspective(focal_px, center)
    # the mean distance is what `pixel` says: hand it that of the truth
    size = np.mean(distance - truth) / focal_px
    height = integrate(normals, pixel=size, camera=camera)
    error = height - (truth - truth.mean())
    assert np.abs(error).max() < 2e-5 * np.ptp(truth)
    plain = integrate(normals, pixel=size)
    assert np.abs(plain - (truth - truth.mean())).max() > 10 * np.abs(error).max()


def test_a_surface_of_75_degrees_is_integrated():
    x = np.mgrid[0:120, 0:120][1]
    height = 40.0 * np.sin(x / 10.7)  # slopes up to 3.74
    normals = normals_of(40.0 / 10.7 * np.cos(x / 10.7), np.zeros((120, 120)))
    assert normals[..., 2].min() < np.cos(np.radians(74.9))
    error = integrate(normals) - (height - height.mean())
    assert np.std(error) < 1e-3 * np.std(height)


def test_a_flat_patch_is_flat():
    flat = np.broadcast_to([0.0, 0.0, 1.0], (9, 12, 3))
    for method in ("dct", "multigrid"):
        np.testing.assert_array_equal(integrate(flat, method=method), 0.0)


@pytest.mark.parametrize("shape", [(1, 1), (1, 23), (23, 1), (2, 2), (1, 2), (3, 200)])
@pytest.mark.parametrize("method", ["dct", "multigrid"])
def test_narrow_images_are_integrated(shape, method):
    truth, normals = crooked_surface(*shape)
    height = integrate(normals, method=method, settings=IntegrationSettings(tolerance=1e-9))
    assert np.abs(height - (truth - truth.mean())).max() < 5e-3


def test_undetermined_height_is_zero_and_invalid():
    truth, normals = crooked_surface(30, 30)
    normals[3, 4] = np.nan
    normals[10, 11] = 0.0
    normals[20, 21] = [0.6, 0.0, -0.8]
    normals[25, 25] = np.inf
    found = integrate_map(normals)
    bad = np.zeros((30, 30), bool)
    bad[[3, 10, 20, 25], [4, 11, 21, 25]] = True
    np.testing.assert_array_equal(found.valid, ~bad)
    assert np.isfinite(found.height).all()
    np.testing.assert_array_equal(found.height[bad], 0.0)
    assert np.std((found.height - truth)[~bad]) < 1e-2


def test_a_field_with_curl_is_projected_onto_heights():
    # slopes turned by 90 degrees from those of a bump that ends before the border: no height
    y, x = np.mgrid[0:61, 0:61] - 30.0
    bump = 4.0 * np.exp(-(x * x + y * y) / 50.0)
    right, down = -bump * x / 25.0, -bump * y / 25.0
    assert np.ptp(integrate(normals_of(right, down))) > 3.5
    swirl = integrate(normals_of(-down, right))
    assert np.abs(swirl).max() < 0.01
    truth, normals = crooked_surface(61, 61)
    slope_x, slope_y = -normals[..., 0] / normals[..., 2], normals[..., 1] / normals[..., 2]
    both = integrate(normals_of(slope_x - down, slope_y + right))
    np.testing.assert_allclose(both, truth - truth.mean(), atol=0.015)


def test_normal_maps_bring_their_mask_and_standard_errors(rng):
    _, normals = crooked_surface(20, 24)
    valid = rng.random((20, 24)) > 0.1
    stderr = rng.uniform(0.01, 0.1, (20, 24))
    empty = np.zeros((20, 24))
    maps = NormalMaps(normals, empty, empty, valid, stderr, empty)
    np.testing.assert_array_equal(
        integrate(maps), integrate(normals, valid=valid, stderr_rad=stderr)
    )


def test_inputs_are_unmodified_and_type_is_kept():
    _, normals = crooked_surface(16, 16)
    single = normals.astype(np.float32)
    mask, before = disc(16, 16), single.copy()
    single[8, 8] = before[8, 8] = [0.0, 0.0, -1.0]
    height = integrate(single, valid=mask)
    assert height.dtype == np.float32
    np.testing.assert_array_equal(single, before)
    np.testing.assert_array_equal(mask, disc(16, 16))
    assert integrate(normals).dtype == np.float64


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"normals": np.zeros((4, 4))}, "normals: got shape"),
        ({"valid": np.zeros((4, 5), bool)}, "valid: got shape"),
        ({"valid": np.zeros((4, 4), bool)}, "no pixel"),
        ({"pixel": 0.0}, "pixel: got 0"),
        ({"stderr_rad": -1.0}, "stderr_rad"),
        ({"stderr_rad": np.ones(3)}, "stderr_rad: got shape"),
        ({"stderr_rad": 0.1, "method": "dct"}, "dct"),
        ({"method": "magic"}, "magic"),
    ],
)
def test_invalid_integration_input_is_refused_by_name(change, message):
    given = {"normals": np.broadcast_to([0.0, 0.0, 1.0], (4, 4, 3)), **change}
    with pytest.raises(IntegrationError, match=message):
        integrate(given.pop("normals"), **given)


@pytest.mark.parametrize("kind", [np.float32, np.float64])
def test_stacked_normals_are_integrated_independently(rng, kind):
    n = (rng.normal(size=(2, 3, 9, 10, 3)) * 0.2 + [0.0, 0.0, 1.0]).astype(kind)
    valid = rng.random((9, 10)) > 0.1
    errors = rng.uniform(0.01, 0.02, (3, 9, 10))
    for given in (
        {},
        {"valid": valid},
        {"stderr_rad": errors, "valid": valid},
        {"stderr_rad": 0.1},
    ):
        found = integrate(n, pixel=2.0, **given)
        assert found.dtype == kind
        for i, j in np.ndindex(2, 3):
            own = {k: v[j] if np.ndim(v) == 3 else v for k, v in given.items()}
            np.testing.assert_array_equal(found[i, j], integrate(n[i, j], pixel=2.0, **own))
    assert integrate(n[:0]).shape == (0, 3, 9, 10)
    with pytest.raises(IntegrationError, match=r"valid: got shape \(4, 9, 10\)"):
        integrate(n, valid=np.ones((4, 9, 10), bool))


def test_settings_and_cameras_out_of_range_are_named():
    for make in (
        lambda: IntegrationSettings(tolerance=0.0),
        lambda: IntegrationSettings(iterations=0),
        lambda: IntegrationSettings(order=3),
        lambda: Perspective(0.0, (1.0, 1.0)),
        lambda: Perspective(100.0, (np.nan, 1.0)),
    ):
        with pytest.raises(IntegrationError, match=r"got .* expected"):
            make()


def test_least_ray_cosine_keeps_grazing_slopes():
    """A slope of 200 has the cosine 0.005: exact by default, omitted above."""
    right = np.zeros((6, 9))
    right[:, 4] = -200.0
    normals = normals_of(right, np.zeros((6, 9)))
    cut = integrate_map(normals, settings=IntegrationSettings(min_ray_cosine=0.02))
    np.testing.assert_array_equal(cut.valid, right == 0.0)
    assert cut.part.max() == 2
    kept = integrate_map(normals, settings=IntegrationSettings(order=2))
    assert kept.valid.all()
    steps = np.diff(kept.height, axis=1)
    np.testing.assert_allclose(steps[:, 3:5], -100.0, rtol=1e-6)
    np.testing.assert_allclose(steps[:, [0, 1, 2, 5, 6, 7]], 0.0, atol=1e-3)
    assert integrate_with_discontinuities(normals).valid.all()
    for settings in (IntegrationSettings, BilateralSettings):
        with pytest.raises(IntegrationError, match="min_ray_cosine"):
            settings(min_ray_cosine=0.0)


def test_too_few_iterations_raise_not_converged(rng):
    _, normals = crooked_surface(64, 64)
    noisy = normals + 0.1 * rng.standard_normal(normals.shape)
    with pytest.raises(ConvergenceError, match="after 1"):
        integrate(noisy, valid=disc(64, 64), settings=IntegrationSettings(iterations=1))


def test_a_solution_at_hand_needs_no_iteration(rng):
    _, normals = crooked_surface(33, 35)
    ax, ay, dx, dy = slope_fields.edges(slope_fields.from_normals(normals, valid=disc(33, 35)))
    x = np.zeros(dx.shape)
    hierarchy = MultigridHierarchy(ax, ay)
    first = solve_poisson(hierarchy, dx, dy, x, tolerance=1e-7)
    again = solve_poisson(hierarchy, dx, dy, x, tolerance=1e-7)
    assert first.iterations > 2
    assert again.iterations == 0
    assert again.residual == first.residual
