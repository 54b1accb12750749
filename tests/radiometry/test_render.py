"""Rays, buffers and visibility against closed forms, with both ray tracers."""

import math

import numpy as np
import pytest

from capture.rig import View, load_rig
from rigsim import render
from rigsim.geometry.mesh import Mesh, MeshError, build_mesh
from rigsim.mitsuba import scene_radiance
from rigsim.mitsuba.variant import VariantChoice, choose_variant

pytestmark = pytest.mark.render

EMBREE = VariantChoice("scalar_rgb", "asked for by the test", "")


@pytest.fixture(scope="module", params=["chosen", "embree"])
def choice(request) -> VariantChoice:
    return choose_variant("rgb") if request.param == "chosen" else EMBREE


@pytest.fixture(scope="module")
def view() -> View:
    return load_rig("flash").resized(252).view("cam")


def sphere(radius_mm: float, *, columns: int = 192, rows: int = 96) -> Mesh:
    theta = np.pi * np.arange(rows + 1) / rows
    phi = 2.0 * np.pi * np.arange(columns + 1) / columns
    t, p = np.meshgrid(theta, phi, indexing="ij")
    unit = np.stack([-np.sin(t) * np.sin(p), np.cos(t), -np.sin(t) * np.cos(p)], axis=-1)
    uv = np.stack([p / (2.0 * np.pi), 1.0 - t / np.pi], axis=-1)
    at = np.arange((rows + 1) * (columns + 1)).reshape(rows + 1, columns + 1)
    a, b, c, d = at[:-1, :-1], at[:-1, 1:], at[1:, :-1], at[1:, 1:]
    faces = np.concatenate(
        [np.stack([a, c, b], axis=-1).reshape(-1, 3), np.stack([b, c, d], axis=-1).reshape(-1, 3)]
    )
    flat = unit.reshape(-1, 3)
    return build_mesh(radius_mm * flat, faces, uv.reshape(-1, 2), flat)


def plate(half_mm: float, z_mm: float, *, center: tuple[float, float] = (0.0, 0.0)) -> Mesh:
    x, y = center
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]], np.float64)
    xyz = np.column_stack([corners * half_mm + [x, y], np.full(4, z_mm)])
    return build_mesh(xyz, [[0, 1, 2], [0, 2, 3]], 0.5 * (corners + 1.0))


def joined(*meshes: Mesh) -> Mesh:
    counts = np.cumsum([0] + [len(mesh.vertices_mm) for mesh in meshes[:-1]])
    return build_mesh(
        np.concatenate([mesh.vertices_mm for mesh in meshes]),
        np.concatenate([mesh.faces + n for mesh, n in zip(meshes, counts, strict=True)]),
        np.concatenate([mesh.uv for mesh in meshes]),
    )


def test_positions_and_normals_of_a_sphere_are_exact(choice, view):
    """Expected: points on the sphere, normals radial. Tolerance: sagitta of the 2-degree mesh."""
    buffers = render.g_buffer(render.Caster(sphere(60.0), choice=choice), view)
    radius = np.linalg.norm(buffers.position_mm[buffers.mask], axis=-1)
    sagitta = 60.0 * (1.0 - math.cos(math.pi / 96.0))
    assert radius.min() > 60.0 - 2.0 * sagitta
    assert radius.max() < 60.0 + 1e-3
    radial = buffers.position_mm[buffers.mask] / radius[:, None]
    assert np.abs(buffers.normal[buffers.mask] - radial).max() < 2e-3
    assert (np.sum(buffers.face_normal * buffers.to_camera, axis=-1)[buffers.mask] > 0).all()


def test_visible_sphere_area_is_that_of_tangent_cone(choice, view):
    buffers = render.g_buffer(render.Caster(sphere(60.0), choice=choice), view, subpixels=2)
    distance, radius = 1000.0, 60.0
    tangent = radius / math.sqrt(distance**2 - radius**2)
    expected = math.pi * (tangent * view.focal_px) ** 2 * 4
    assert buffers.mask.sum() == pytest.approx(expected, rel=2e-3)


def test_row_0_is_top_and_x_runs_right(choice, view):
    caster = render.Caster(plate(40.0, 0.0, center=(50.0, 30.0)), choice=choice)
    buffers = render.g_buffer(caster, view)
    rows, columns = np.nonzero(buffers.mask)
    assert rows.mean() < view.height_px / 2 - 10
    assert columns.mean() > view.width_px / 2 + 10
    assert buffers.position_mm[rows.min(), columns[0], 1] > 60.0
    assert buffers.uv[rows.min(), columns.max(), 1] > 0.9


def test_subject_pixel_size_is_field_over_image_width(choice, view):
    buffers = render.g_buffer(render.Caster(plate(200.0, 0.0), choice=choice), view)
    assert buffers.mask.all()
    step = np.diff(buffers.position_mm[:, :, 0], axis=1)
    np.testing.assert_allclose(step, view.field_mm[0] / view.width_px, rtol=1e-3)
    middle = buffers.position_mm[..., :2].reshape(-1, 2).mean(axis=0)
    np.testing.assert_allclose(middle, 0.0, atol=1e-3)


def test_plate_shadow_matches_geometry(choice):
    """A light at height 500 over a plate at height 50 magnifies its shadow by 500 / 450."""
    screen, blocker = plate(200.0, 0.0), plate(20.0, 50.0)
    caster = render.Caster(joined(screen, blocker), choice=choice)
    x = np.linspace(-60.0, 60.0, 241, dtype=np.float32)
    points = np.column_stack([x, np.zeros_like(x), np.zeros_like(x)])
    normals = np.tile(np.array([0.0, 0.0, 1.0], np.float32), (len(x), 1))
    seen = render.visibility(caster, points, normals, (0.0, 0.0, 500.0))
    edge = 20.0 * 500.0 / 450.0
    np.testing.assert_array_equal(seen, np.where(np.abs(x) < edge, 0.0, 1.0))


def test_round_light_penumbra_width_matches_geometry(choice):
    """Expected width: disc diameter times 50 / 450, and half the light at the edge."""
    screen, blocker = plate(200.0, 0.0), plate(20.0, 50.0)
    caster = render.Caster(joined(screen, blocker), choice=choice)
    x = np.linspace(0.0, 60.0, 601, dtype=np.float32)
    points = np.column_stack([x, np.zeros_like(x), np.zeros_like(x)])
    normals = np.tile(np.array([0.0, 0.0, 1.0], np.float32), (len(x), 1))
    seen = render.visibility(
        caster, points, normals, (0.0, 0.0, 500.0), radius_mm=40.0, samples=256
    )
    edge, half_width = 20.0 * 500.0 / 450.0, 40.0 * 50.0 / 450.0
    assert (seen[x < edge - half_width - 0.2] == 0.0).all()
    assert (seen[x > edge + half_width + 0.2] == 1.0).all()
    assert np.interp(edge, x, seen) == pytest.approx(0.5, abs=0.03)


def test_surfaces_that_face_away_see_no_light(choice):
    caster = render.Caster(sphere(60.0), choice=choice)
    normals = np.array([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]], np.float32)
    seen = render.visibility(caster, 60.0 * normals, normals, (0.0, 0.0, 500.0))
    np.testing.assert_array_equal(seen, [1.0, 0.0])


def test_both_ray_tracers_agree(view):
    chosen = choose_variant("rgb")
    if not chosen.is_vectorized:
        pytest.skip(f"only one ray tracer here: {chosen.why}")
    one, other = (
        render.g_buffer(render.Caster(sphere(60.0), choice=choice), view)
        for choice in (chosen, EMBREE)
    )
    assert np.mean(one.prim != other.prim) < 1e-3  # ties on shared edges
    both = one.mask & other.mask
    assert np.abs(one.position_mm - other.position_mm)[both].max() < 5e-3


@pytest.mark.long
def test_rays_never_slip_between_closed_surface_triangles(choice, view):
    fine = render.g_buffer(
        render.Caster(sphere(60.0, columns=720, rows=360), choice=choice), view, subpixels=4
    )
    hit = np.pad(fine.mask, 1).astype(int)
    rows, columns = fine.mask.shape
    around = sum(hit[y : y + rows, x : x + columns] for y in range(3) for x in range(3))
    assert not ((around == 8) & ~fine.mask).any()


def test_radiance_of_large_seeds_differs_by_seed():
    """Dr.Jit takes 31 bits; three samples add the distance of an image's parts to a seed."""
    scene = {
        "type": "scene",
        "integrator": {"type": "direct", "emitter_samples": 0, "bsdf_samples": 1},
        "sensor": {
            "type": "orthographic",
            "film": {"type": "hdrfilm", "width": 2, "height": 2, "rfilter": {"type": "box"}},
        },
        "light": {"type": "sphere", "center": [1.0, 0.0, 1.0], "emitter": {"type": "area"}},
        "plate": {"type": "rectangle", "to_world": np.diag([9.0, 9.0, -1.0, 1.0])},
    }
    scene["plate"]["to_world"][2, 3] = 3.0
    first, same, other = (
        scene_radiance.radiance(scene, kind="rgb", samples=3, seed=seed)
        for seed in (2**31 - 1, 2**32 - 1, 2**40)
    )
    np.testing.assert_array_equal(first, same)
    assert (first != other).any()


def test_white_plate_under_constant_light_renders_albedo():
    """Mitsuba itself, by a described scene: radiance = albedo times the sky's radiance."""
    image = scene_radiance.radiance(
        {
            "type": "scene",
            "integrator": {"type": "path", "max_depth": 2},
            "sensor": {
                "type": "perspective",
                "fov": 10.0,
                "film": {"type": "hdrfilm", "width": 8, "height": 8, "rfilter": {"type": "box"}},
            },
            "sky": {"type": "constant", "radiance": {"type": "uniform", "value": 2.0}},
            "plate": {
                "type": "sphere",
                "center": [0.0, 0.0, 50.0],
                "radius": 20.0,
                "bsdf": {"type": "diffuse", "reflectance": {"type": "uniform", "value": 0.5}},
            },
        },
        kind="rgb",
        samples=16,
    )
    assert image.shape[:2] == (8, 8)
    np.testing.assert_allclose(image.mean(), 1.0, rtol=0.02)


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"faces": [[0, 1, 7]]}, "faces: got indices"),
        ({"uv": np.full((4, 2), 1.5)}, "uv: got"),
        ({"vertices_mm": np.full((4, 3), np.nan)}, "not finite"),
        ({"vertices_mm": 1e-3 * np.eye(4, 3)}, "scale the mesh to millimeters"),
    ],
)
def test_a_wrong_mesh_is_named(change, word):
    good = {"vertices_mm": 50.0 * np.eye(4, 3), "faces": [[0, 1, 2]], "uv": np.zeros((4, 2))}
    with pytest.raises(MeshError, match=word):
        build_mesh(**(good | change))
