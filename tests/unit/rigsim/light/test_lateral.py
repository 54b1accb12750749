"""Light that spreads sideways: widths, conservation, stretch, borders."""

import numpy as np
import pytest

from rigsim.geometry.atlas import Atlas, unwrap
from rigsim.geometry.mesh import build_mesh
from rigsim.light.lateral import HeatFlow, LateralError, edge_width_mm, scatter_laterally

SIZE = 256


def plate(width_mm: float, height_mm: float) -> Atlas:
    corners = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    vertices = np.column_stack([corners * [width_mm, height_mm], np.zeros(4)])
    return unwrap(build_mesh(vertices, [[0, 1, 2], [0, 2, 3]], corners), SIZE)


def point(channels: int = 1) -> np.ndarray:
    field = np.zeros((SIZE, SIZE, channels), np.float32)
    field[SIZE // 2, SIZE // 2] = 1.0
    return field


@pytest.mark.parametrize("sigma_mm", [0.5, 1.5, 4.0])
def test_point_spreads_to_stated_gaussian_width_both_ways(sigma_mm):
    """The texture is twice as fine along v: the width in mm must not depend on it."""
    atlas = plate(64.0, 32.0)
    out = scatter_laterally(point(), atlas, [sigma_mm], [[1.0]])[..., 0]
    step = np.arange(SIZE) - SIZE // 2
    for axis, texel_mm in ((0, 64.0 / SIZE), (1, 32.0 / SIZE)):
        profile = out.sum(axis=axis)
        sigma = np.sqrt(np.sum(profile * step**2) / profile.sum()) * texel_mm
        assert sigma == pytest.approx(sigma_mm, rel=0.02)


def test_lateral_scattering_conserves_light_and_uniform_fields():
    atlas = plate(64.0, 32.0)
    sigmas, weights = [0.3, 1.0, 5.0], [[0.2, 0.5, 0.3], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]]
    rng = np.random.default_rng(12345)
    field = rng.uniform(0.0, 1.0, (SIZE, SIZE, 3)).astype(np.float32)
    before = field.copy()
    out = scatter_laterally(field, atlas, sigmas, weights)
    np.testing.assert_allclose(out.sum(axis=(0, 1)), field.sum(axis=(0, 1)), rtol=1e-4)
    np.testing.assert_array_equal(field, before)
    assert out.min() >= 0.0
    even = scatter_laterally(np.ones_like(field), atlas, sigmas, weights)
    np.testing.assert_allclose(even, 1.0, rtol=1e-4)


def test_light_is_conserved_on_a_stretched_texture():
    """Where texels are larger, they hold more: the integral over the surface counts."""
    u = np.linspace(0.0, 1.0, 65)
    x = 40.0 * u**2 + 10.0 * u
    grid_u, grid_v = np.meshgrid(u, [0.0, 1.0])
    vertices = np.column_stack([np.tile(x, 2), 50.0 * grid_v.ravel(), np.zeros(130)])
    k = np.arange(64)
    faces = np.concatenate(
        [np.column_stack([k, k + 1, k + 66]), np.column_stack([k, k + 66, k + 65])]
    )
    atlas = unwrap(
        build_mesh(vertices, faces, np.column_stack([grid_u.ravel(), grid_v.ravel()])), SIZE
    )
    along_u, along_v = atlas.texel_mm()
    area = (along_u * along_v)[..., None]
    out = scatter_laterally(point(), atlas, [3.0], [[1.0]])
    assert float((out * area).sum()) == pytest.approx(float((point() * area).sum()), rel=1e-3)
    np.testing.assert_allclose(
        scatter_laterally(np.ones((SIZE, SIZE, 1), np.float32), atlas, [3.0], [[1.0]]),
        1.0,
        rtol=1e-3,
    )


def test_channels_spread_by_their_own_weights():
    out = scatter_laterally(point(2), plate(64.0, 64.0), [0.5, 4.0], [[1.0, 0.0], [0.0, 1.0]])
    assert out[SIZE // 2, SIZE // 2, 0] > 10.0 * out[SIZE // 2, SIZE // 2, 1]


def test_kernels_far_below_texel_keep_field_unchanged():
    out = scatter_laterally(point(), plate(256.0, 256.0), [0.05], [[1.0]])
    np.testing.assert_array_equal(out, point())


def test_gaussian_edge_width_is_2_56_sigma():
    np.testing.assert_allclose(edge_width_mm([0.7], [[1.0]]), [2 * 1.2815516 * 0.7], rtol=1e-4)


@pytest.mark.parametrize(
    ("sigmas", "weights", "word"),
    [
        ([1.0, 0.5], [[0.5, 0.5]], "sigmas_mm"),
        ([1.0], [[0.9]], "got sums"),
        ([1.0], [[0.5], [0.5]], "weights: got shape"),
    ],
)
def test_wrong_kernels_are_named(sigmas, weights, word):
    with pytest.raises(LateralError, match=word):
        scatter_laterally(point(), plate(10.0, 10.0), sigmas, weights)


def test_minor_width_takes_fewer_steps_at_same_variance():
    """A width of 1 % in each channel: its variance is exact for any number of steps."""
    atlas = plate(64.0, 64.0)
    flow = HeatFlow(atlas, [0.5, 3.0], [[0.99, 0.01]])
    step = (np.arange(SIZE) - SIZE // 2) * 64.0 / SIZE
    profile = flow.scatter(point())[..., 0].sum(axis=0)
    variance = float(np.sum(profile * step**2) / profile.sum())
    assert variance == pytest.approx(0.99 * 0.5**2 + 0.01 * 3.0**2, rel=0.03)


def test_one_flow_scatters_several_fields_alike():
    atlas, rng = plate(64.0, 32.0), np.random.default_rng(4)
    flow = HeatFlow(atlas, [0.5, 2.0], [[0.3, 0.7]])
    for _ in range(2):
        field = rng.uniform(0.0, 1.0, (SIZE, SIZE, 1)).astype(np.float32)
        alone = scatter_laterally(field, atlas, [0.5, 2.0], [[0.3, 0.7]])
        np.testing.assert_array_equal(flow.scatter(field), alone)
