"""Shadows of the key light against rays; heads of a crowd against each face drawn alone."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage

pytestmark = pytest.mark.long

EDGE_PX = 3
"""Pixels beside a shadow's edge are not compared: there the page filters and a ray does not."""
FLAT = {"relief": 0, "wrinkles": 0, "microstructure": 0, "detail": 0}


def _direction(azimuth_deg, elevation_deg):
    a, e = np.radians([azimuth_deg, elevation_deg])
    return np.array([np.sin(a) * np.cos(e), np.sin(e), np.cos(a) * np.cos(e)])


def _points(viewer, params):
    """Return points, mm, unit normals and where there is skin; of a camera without pitch."""
    normal = viewer.read("normal").astype(np.float64)
    depth = normal[..., 3]
    size = depth.shape[0]
    yaw = params["camera_yaw_deg"]
    back, right = _direction(yaw, 0.0), _direction(yaw + 90.0, 0.0)
    up = np.array([0.0, 1.0, 0.0])
    focal = 0.5 * size / np.tan(0.5 * np.radians(params["camera_fov_deg"]))
    at = (np.arange(size) + 0.5 - 0.5 * size) / focal
    way = at[None, :, None] * right - at[:, None, None] * up - back
    eye = np.array(params["camera_target_mm"]) + params["camera_distance_mm"] * back
    return eye + depth[..., None] * way, normal[..., :3], depth > 0.0


def _blocked(positions, faces, origins, light):
    """Return whether a ray towards the light meets the mesh, exact for each point."""
    right = np.cross([0.0, 1.0, 0.0], light)
    right /= np.linalg.norm(right)
    up = np.cross(light, right)
    frame = np.stack([right, up, light])
    corners = (positions.astype(np.float64) @ frame.T)[faces]
    low, high = corners.min(axis=1), corners.max(axis=1)
    points = origins @ frame.T
    out = np.zeros(len(points), bool)
    for k, (x, y, z) in enumerate(points):
        near = np.flatnonzero(
            (low[:, 0] <= x)
            & (high[:, 0] >= x)
            & (low[:, 1] <= y)
            & (high[:, 1] >= y)
            & (high[:, 2] > z)
        )
        a, b, c = np.moveaxis(corners[near], 1, 0)
        area = _turn(a, b, c)
        good = np.abs(area) > 1e-12
        s, t = _turn(a, (x, y), c)[good] / area[good], _turn(a, b, (x, y))[good] / area[good]
        inside = (s >= 0.0) & (t >= 0.0) & (s + t <= 1.0)
        height = a[good, 2] + s * (b - a)[good, 2] + t * (c - a)[good, 2]
        out[k] = bool((inside & (height > z)).any())
    return out


def _turn(a, b, c):
    ax, ay = np.asarray(a)[..., 0], np.asarray(a)[..., 1]
    bx, by = np.asarray(b)[..., 0], np.asarray(b)[..., 1]
    cx, cy = np.asarray(c)[..., 0], np.asarray(c)[..., 1]
    return (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)


@pytest.mark.parametrize(
    ("azimuth", "elevation", "weights"),
    [(35.0, 30.0, {}), (-60.0, 10.0, {"surprise": 1.0}), (5.0, 70.0, {})],
)
def test_shadows_cover_points_with_blocked_light_rays(
    viewer, procedural_scene, azimuth, elevation, weights
):
    params = viewer.set(
        **FLAT, light_azimuth_deg=azimuth, light_elevation_deg=elevation, weights=weights
    )
    lit = viewer.read("lit")[..., 0]
    points, normal, on = _points(viewer, params)
    light = _direction(azimuth, elevation)
    facing = on & (normal @ light > 0.15)
    away = ~ndimage.binary_dilation(
        on & (lit > 0.02) & (lit < 0.98), iterations=EDGE_PX
    ) & ndimage.binary_erosion(facing, iterations=1)
    rng = np.random.default_rng(3)
    chosen = np.argwhere(away)
    chosen = chosen[rng.choice(len(chosen), min(1500, len(chosen)), replace=False)]
    i, j = chosen.T
    positions, _ = viewer.mesh()
    # off the surface by what the map's bias forgives
    origins = points[i, j] + 0.6 * normal[i, j]
    blocked = _blocked(positions, procedural_scene.mesh.faces, origins, light)
    assert blocked.mean() > 0.01
    agree = (lit[i, j] < 0.5) == blocked
    assert agree.mean() > 0.985, agree.mean()
    # no shadow at all would agree less
    assert (~blocked).mean() < agree.mean()
    # and most of what is compared is neither left out nor trivial
    assert away.sum() > 0.6 * facing.sum()


def test_shadows_dim_light_and_specular_and_are_switchable(viewer):
    viewer.set(**FLAT, ambient=0.0, light_elevation_deg=50.0)
    lit = viewer.read("lit")[..., 0]
    dim = {name: viewer.read(name)[..., 0] for name in ("irradiance", "specular")}
    viewer.set(shadows=0)
    assert set(np.unique(viewer.read("lit"))) <= {0.0, 1.0}
    for name, under in dim.items():
        plain = viewer.read(name)[..., 0]
        np.testing.assert_allclose(under, lit * plain, atol=2e-3 * plain.max())
        assert under.sum() < 0.995 * plain.sum()
        assert (plain - under).max() > 0.05 * plain.max()
    assert "shadow_depth" not in viewer.buffers()


def test_depth_pass_runs_when_mesh_or_light_changes(viewer):
    def drawn(**change):
        before = viewer.draws().get("shadow", 0)
        viewer.set(**change)
        return viewer.draws()["shadow"] - before

    viewer.set(light_azimuth_deg=20.0)
    assert drawn(camera_yaw_deg=12.0) == 0
    assert drawn(melanin_gain=1.4) == 0
    assert drawn(light_intensity=2.0) == 0
    assert drawn(light_azimuth_deg=21.0) == 1
    assert drawn(weights={"anger": 0.4}) == 1
    assert drawn(exposure=1.1) == 0


def _bilinear(values, uv):
    height, width = values.shape
    x = np.clip(uv[:, 0] * width - 0.5, 0.0, width - 1.0)
    y = np.clip((1.0 - uv[:, 1]) * height - 0.5, 0.0, height - 1.0)
    return ndimage.map_coordinates(values.astype(np.float64), [y, x], order=1)


def test_crowd_heads_have_blood_of_own_expression(viewer, procedural_scene):
    table = ("happiness", None, "anger and surprise")
    zero = dict.fromkeys(procedural_scene.params["weights"], 0.0)
    blood = []
    for name in table:
        weights = {} if name is None else procedural_scene.presets[name]["weights"]
        viewer.set(weights={**zero, **weights}, heads=1)
        blood.append(viewer.read("chromophores")[..., 1])
    viewer.set(weights=zero, heads=3, camera_distance_mm=1300)
    inspect = viewer.read("inspect")
    on = viewer.read("normal")[..., 3] > 0
    thirds = np.arange(256)[None, :] * 3 // 256
    for k in range(3):
        here = on & (thirds == k)
        uv, got = inspect[here][:, :2], inspect[here][:, 3]
        errors = [np.percentile(np.abs(_bilinear(one, uv) / got - 1.0), 90.0) for one in blood]
        assert int(np.argmin(errors)) == k
        assert errors[k] < 1e-2
        assert sorted(errors)[1] > 5.0 * errors[k]
    # all alike where that is asked for
    viewer.set(crowd=0)
    alike = viewer.read("inspect")
    here = on & (thirds == 0) & (viewer.read("normal")[..., 3] > 0)
    wanted = _bilinear(blood[1], alike[here][:, :2])
    assert np.median(np.abs(alike[here][:, 3] / wanted - 1.0)) < 5e-3


def test_crowd_costs_sum_heads_and_reuse_unchanged_passes(viewer):
    one = viewer.bench(1)
    viewer.set(heads=5, camera_distance_mm=1600)
    five = viewer.bench(1)
    for name in ("hemoglobin_rig", "wrinkles", "strain", "shadow"):
        assert five["passes"][name]["bytes"] == 5 * one["passes"][name]["bytes"], name
        if name != "hemoglobin_rig":
            assert five["passes"][name]["taps"] == 5 * one["passes"][name]["taps"], name
    # states with a weight: neutral, happiness, two mixtures with a negative neutral part, exercise
    reads = [states + 1 for states in (1, 1, 3, 3, 1)]
    assert five["passes"]["hemoglobin_rig"]["taps"] == sum(reads) * 256**2
    assert one["passes"]["hemoglobin_rig"]["taps"] == reads[0] * 256**2
    assert five["passes"]["scatter_3_x"] == one["passes"]["scatter_3_x"]
    assert five["draws"] > one["draws"]
    before = viewer.draws()
    viewer.set(light_azimuth_deg=11.0)
    after = viewer.draws()
    assert after["shadow"] - before["shadow"] == 5
    assert after["hemoglobin_rig"] == before["hemoglobin_rig"]
    assert after["surface"] - before["surface"] == 1
    viewer.set(heads=1)
    assert viewer.problems == []
