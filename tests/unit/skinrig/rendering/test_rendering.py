"""Rendering fitted maps: radiance, orientation, shadows, energy, and meshes that moved."""

import dataclasses

import numpy as np
import pytest

from model.brdf import microfacet
from model.brdf import tables as brdf_tables
from model.skin_reflectance import SkinReflectance, transmittance
from rigsim.geometry.atlas import dilate_texture, unwrap
from rigsim.geometry.mesh import build_mesh
from rigsim.render import Caster
from skinrig.rendering import camera as rendering_camera
from skinrig.rendering.camera import RenderingError
from skinrig.rendering.geometry import (
    FittedSurface,
    GeometryError,
    parse_mesh,
    read_mesh,
    read_own_mesh,
)
from skinrig.rendering.interior import Interior, Lighting
from skinrig.rendering.lights import Light
from skinrig.rendering.render import render_light_groups
from skinrig.rendering.render import render_surface as render_laid

FRONT = (0.0, 0.0, 700.0)


def render(model, mesh, *shown, rest=None, **options):
    return render_laid(FittedSurface.of(model, mesh, rest=rest), *shown, **options)


def plane(half_mm=50.0, turned=None):
    corners = np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    vertices = half_mm * corners
    uv = 0.5 * (corners[:, :2] + 1.0)
    if turned is not None:
        vertices = vertices @ turned.T
    return build_mesh(vertices, [[0, 1, 2], [0, 2, 3]], uv)


def dome_mesh(height_mm=60.0, steps=60):
    """Return a cap that bulges towards +z, seen by its own x and y."""
    at = np.linspace(0.0, 1.0, steps)
    u, v = np.meshgrid(at, at)
    x, y = 100.0 * (u - 0.5), 100.0 * (v - 0.5)
    z = height_mm * np.sqrt(np.maximum(1.0 - (x**2 + y**2) / 75.0**2, 0.0))
    index = np.arange(steps**2).reshape(steps, steps)
    a, b, c, d = (
        s.reshape(-1) for s in (index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1])
    )
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    points = np.stack([x, y, z], -1).reshape(-1, 3)
    return build_mesh(points, faces, np.stack([u, v], -1).reshape(-1, 2))


def lobes(alpha=0.3):
    def facets(light, view):
        cos_d = np.sqrt(np.maximum(0.5 + 0.5 * np.sum(light * view, axis=-1), 1e-12))
        cos_h = np.minimum((light[..., 2] + view[..., 2]) / (2.0 * cos_d), 1.0)
        mu = light[..., 2], view[..., 2], cos_h, cos_d
        return microfacet.brdf(*mu, roughness=alpha, eta=1.4)

    return brdf_tables.tabulate({"facets": facets})


@pytest.fixture(scope="module")
def shiny():
    return lobes()


@pytest.fixture(scope="module")
def matt():
    return brdf_tables.tabulate({"none": lambda light, view: np.zeros(light.shape[:-1])})


def model_on(mesh, basis, *, r_d=(1.0, 1.0, 1.0), weight=1.0, size=32):
    atlas = unwrap(mesh, size)
    shape = (size, size)
    layers = dilate_texture(
        np.concatenate([atlas.position_mm, atlas.normal], -1), atlas.covered, steps=size
    )
    normals = layers[..., 3:] / np.linalg.norm(layers[..., 3:], axis=-1, keepdims=True)
    return SkinReflectance(
        r_d=np.broadcast_to(np.float32(r_d), (*shape, 3)).copy(),
        weights=np.full((*shape, basis.size), weight, np.float32),
        lobes=basis,
        translucency_mm=np.full((*shape, 3), 1.0, np.float32),
        normals=normals,
        position_mm=layers[..., :3],
        valid=atlas.covered,
    )


def middle(image):
    return image[image.shape[0] // 2, image.shape[1] // 2]


def front_camera(size=33, fov=6.0):
    return rendering_camera.look_at(FRONT, fov_deg=fov, size_px=(size, size))


def test_white_patch_facing_light_shows_double_boundary_transmittance(matt):
    mesh = plane()
    seen = render(
        model_on(mesh, matt), mesh, front_camera(), Light(name="front", direction=(0, 0, 1))
    )
    passed = transmittance(1.0) ** 2
    np.testing.assert_allclose(middle(seen.radiance), passed, rtol=1e-4)
    assert np.all(seen.surface == 0.0)
    assert seen.covered.all()
    assert seen.lit.all()


def test_patch_irradiance_follows_cosine_and_transmittance(matt):
    mesh = plane()
    light = Light(
        name="aslant", direction=(np.sin(1.0), 0.0, np.cos(1.0)), intensity=(2.0, 1.0, 0.5)
    )
    seen = render(model_on(mesh, matt, r_d=(0.6, 0.4, 0.2)), mesh, front_camera(), light)
    cosine = np.cos(1.0)
    expected = transmittance(cosine) * transmittance(1.0) * cosine * np.array([1.2, 0.4, 0.1])
    np.testing.assert_allclose(middle(seen.radiance), expected, rtol=1e-4)


def test_light_groups_equal_their_own_renderings(shiny):
    mesh = dome_mesh()
    surface = FittedSurface.of(model_on(mesh, shiny), mesh)
    left = Light(name="left", direction=(-1.0, 0.3, 1.0), radius=0.03)
    right = Light(name="right", direction=(1.0, 0.0, 0.5))
    groups = [[left], [right], [left, right]]
    found = render_light_groups(surface, front_camera(), groups)
    for group, one in zip(groups, found, strict=True):
        alone = render_laid(surface, front_camera(), group)
        for name in ("diffuse", "surface", "coverage", "covered", "lit", "uv"):
            np.testing.assert_array_equal(getattr(one, name), getattr(alone, name))
    assert np.abs(found[0].surface - found[1].surface).max() > 0.01
    both = found[0].radiance + found[1].radiance
    np.testing.assert_allclose(found[2].radiance, both, rtol=1e-5, atol=1e-6)
    for groups in ([], [[left], []]):
        with pytest.raises(RenderingError, match="at least one"):
            render_light_groups(surface, front_camera(), groups)


def test_point_light_falls_with_squared_distance(matt):
    mesh = plane()
    near = Light(name="near", position_mm=(0.0, 0.0, 300.0), reference_mm=600.0)
    seen = render(model_on(mesh, matt), mesh, front_camera(), near)
    np.testing.assert_allclose(middle(seen.radiance), 4.0 * transmittance(1.0) ** 2, rtol=1e-4)


def test_surface_term_matches_tables_at_known_pixel(shiny):
    mesh = plane()
    camera = front_camera()
    light = np.array([0.5, 0.2, 0.8])
    seen = render(
        model_on(mesh, shiny, r_d=(0, 0, 0), weight=0.7),
        mesh,
        camera,
        Light(name="a", direction=tuple(light)),
        subpixels=1,
    )
    light /= np.linalg.norm(light)
    row, column = 10, 20
    view = -camera.rays([[column, row]])[0]
    lobe = shiny.evaluate(light, view, [0.0, 0.0, 1.0]) @ [0.7]
    np.testing.assert_allclose(seen.surface[row, column], np.pi * lobe * light[2], rtol=2e-4)
    assert np.all(seen.diffuse == 0.0)


def test_light_from_the_right_brightens_the_right(matt):
    mesh = dome_mesh()
    model = model_on(mesh, matt, size=64)
    camera = front_camera(size=41, fov=9.0)
    for axis, way in ((1, (1.0, 0.0, 0.4)), (0, (0.0, -1.0, 0.4))):  # +x: right; -y: below
        seen = render(model, mesh, camera, Light(name="side", direction=way)).radiance[..., 1]
        low, high = np.split(seen[:40, :40], 2, axis=axis)
        assert high.sum() > 2.0 * low.sum()


def test_card_shadow_is_where_geometry_predicts(matt):
    mesh = plane()
    corners = np.array([[0.0, -80, 40], [80, -80, 40], [80, 80, 40], [0, 80, 40]])
    card = build_mesh(corners, [[0, 1, 2], [0, 2, 3]], np.zeros((4, 2)))
    light = Light(name="aslant", direction=(1.0, 0.0, 1.0))  # shadow 40 mm to the left of the card
    camera = rendering_camera.look_at(FRONT, fov_deg=8.0, size_px=(61, 61))
    seen = render(model_on(mesh, matt), mesh, camera, light, blockers=card)
    column = round(float(camera.project([[-40.0, 0.0, 0.0]])[0, 0]))
    bright = seen.radiance[30, :, 1] > 0.1
    assert bright[2:column].all()
    assert not bright[column + 1 : 60 - column].any()
    assert bright[61 - column : 59].all()
    assert not seen.lit[30, column : 61 - column].any()


def test_wide_light_soft_shadow_matches_geometry(matt):
    mesh = plane()
    corners = np.array([[0.0, -80, 40], [80, -80, 40], [80, 80, 40], [0, 80, 40]])
    card = build_mesh(corners, [[0, 1, 2], [0, 2, 3]], np.zeros((4, 2)))
    camera = rendering_camera.look_at((-100.0, 0.0, 700.0), fov_deg=7.0, size_px=(121, 3))
    light = Light(name="sun", direction=(0.0, 0.0, 1.0), radius=0.1)
    seen = render(
        model_on(mesh, matt), mesh, camera, light, blockers=card, subpixels=3, shadow_samples=16
    )
    x = (seen.uv[1, :, 0] - 0.5) * 100.0
    level = seen.radiance[1, :, 1] / seen.radiance[1, 5:25, 1].mean()
    # half of the disc is hidden below the edge; a disc of 0.1 rad over 40 mm is 8 mm wide
    assert abs(np.interp(0.5, level[::-1], x[::-1])) < 0.4
    assert np.all(level[x < -4.5] > 0.97)
    assert np.all(level[(x > 4.5) & (x < 20)] < 0.03)


def test_two_lights_add_up(shiny):
    mesh = dome_mesh()
    model = model_on(mesh, shiny, r_d=(0.5, 0.4, 0.3), size=64)
    camera = front_camera(size=25, fov=9.0)
    a, b = Light(name="a", direction=(1, 0, 1)), Light(name="b", position_mm=(-300.0, 100.0, 400.0))
    both = render(model, mesh, camera, [a, b])
    apart = [render(model, mesh, camera, light).radiance for light in (a, b)]
    np.testing.assert_allclose(both.radiance, apart[0] + apart[1], atol=1e-6)
    np.testing.assert_allclose(both.radiance, both.diffuse + both.surface)


def test_parts_of_broad_light_sum_to_whole(matt):
    mesh = plane()
    broad = Light(name="broad", direction=(0.3, 0.0, 1.0), radius=0.3)
    assert len(broad.parts()) == 16
    seen = render(model_on(mesh, matt), mesh, front_camera(), broad)
    narrow = render(
        model_on(mesh, matt), mesh, front_camera(), dataclasses.replace(broad, radius=0.0)
    )
    np.testing.assert_allclose(middle(seen.radiance), middle(narrow.radiance), rtol=0.02)


def test_less_light_comes_back_than_arrives(shiny):
    """A white model with a full lobe in a white room shows less than white from any angle."""
    mesh = plane()
    model = model_on(mesh, shiny)
    directions = np.random.default_rng(3).normal(size=(200, 3))
    directions[:, 2] = np.abs(directions[:, 2])
    # radiance 1 from everywhere: each of n directions has 2 pi / n of solid angle, over pi
    room = [Light(name="room", direction=tuple(w), intensity=(2 / 200,) * 3) for w in directions]
    for tilt in (0.0, 1.2):
        place = 700.0 * np.array([np.sin(tilt), 0.0, np.cos(tilt)])
        camera = rendering_camera.look_at(place, fov_deg=1.0, size_px=(3, 3))
        shown = middle(render(model, mesh, camera, room, subpixels=1).radiance)
        assert 0.5 < shown.max() < 1.05  # 200 directions leave 5 % of noise


def rotation():
    a, b = 0.5, -0.3
    turn_y = np.array([[np.cos(a), 0, np.sin(a)], [0, 1, 0], [-np.sin(a), 0, np.cos(a)]])
    turn_x = np.array([[1, 0, 0], [0, np.cos(b), -np.sin(b)], [0, np.sin(b), np.cos(b)]])
    return turn_x @ turn_y


def test_face_rotated_with_light_and_camera_looks_same(shiny):
    mesh = dome_mesh()
    model = model_on(mesh, shiny, r_d=(0.5, 0.4, 0.3), size=64)
    rng = np.random.default_rng(0)
    relief = model.normals + 0.1 * rng.standard_normal(model.normals.shape)
    relief /= np.linalg.norm(relief, axis=-1, keepdims=True)
    model = dataclasses.replace(model, normals=relief.astype(np.float32))
    light = np.array([1.0, 0.5, 1.5])
    still = render(
        model, mesh, front_camera(25, 8.0), Light(name="a", direction=tuple(light)), subpixels=1
    )
    turn = rotation()
    moved = build_mesh(mesh.vertices_mm @ turn.T, mesh.faces, mesh.uv)
    camera = rendering_camera.look_at(
        turn @ FRONT, up=turn @ (0, 1, 0), fov_deg=8.0, size_px=(25, 25)
    )
    lamp = Light(name="a", direction=tuple(turn @ light))
    turned = render(model, moved, camera, lamp, rest=mesh, subpixels=1)
    inner = still.lit & turned.lit
    assert inner.sum() > 300
    gap = np.abs(turned.radiance - still.radiance)[inner] / still.radiance[inner].mean()
    assert np.median(gap) < 1e-3
    # normals that are not carried along are wrong by the whole turn
    fixed = dataclasses.replace(model, position_mm=unwrap(moved, 64).position_mm)
    wrong = render(fixed, moved, camera, lamp, subpixels=1)
    assert np.median(np.abs(wrong.radiance - still.radiance)[inner]) > 0.05


def test_stretched_skin_has_flatter_relief(matt):
    mesh, wide = (
        plane(),
        build_mesh(plane().vertices_mm * [2.0, 1.0, 1.0], plane().faces, plane().uv),
    )
    model = model_on(mesh, matt)
    tilted = np.broadcast_to(np.float32([0.6, 0.0, 0.8]), model.normals.shape)
    model = dataclasses.replace(model, normals=tilted.copy())
    laid = FittedSurface.of(model, wide, rest=mesh)
    normal = laid.normals[16, 16]
    # the slope 0.6 / 0.8 becomes half as steep; heights are kept, the smooth normal is not scaled
    assert laid.is_transferred
    assert normal[0] / normal[2] == pytest.approx(0.375, rel=1e-4)


def test_unmeasured_texels_are_distinguished_from_measured(matt):
    mesh = plane()
    model = model_on(mesh, matt)
    valid = model.valid.copy()
    valid[:, 20:] = False
    r_d = model.r_d.copy()
    r_d[:, 20:] = 0.25
    seen = render(
        dataclasses.replace(model, valid=valid, r_d=r_d),
        mesh,
        front_camera(33, 8.0),
        Light(name="a", direction=(0, 0, 1)),
    )
    right = seen.uv[..., 0] > 22 / 32
    left = (seen.uv[..., 0] < 19 / 32) & (seen.coverage > 0.999)
    assert not seen.covered[right].any()
    assert seen.covered[left].all()
    inner = left & (seen.uv[..., 0] > 0.5)
    np.testing.assert_allclose(seen.radiance[inner], transmittance(1.0) ** 2, rtol=3e-3)


@pytest.mark.parametrize(
    ("place", "says"),
    [((0.0, 0.0, -700.0), "behind the head"), ((0.0, 3000.0, 700.0), "has no view")],
)
def test_camera_missing_face_is_refused(matt, place, says):
    mesh = plane()
    target = (0.0, 0.0, 0.0) if "behind" in says else (0.0, 3000.0, 0.0)
    camera = rendering_camera.look_at(place, target_mm=target, size_px=(16, 16))
    with pytest.raises(RenderingError, match=says):
        render(model_on(mesh, matt), mesh, camera, Light(name="a", direction=(0, 0, 1)))


def test_a_mesh_of_another_layout_is_refused(matt):
    mesh = dome_mesh()
    model = model_on(mesh, matt)
    other = build_mesh(mesh.vertices_mm, mesh.faces, mesh.uv[::-1])
    with pytest.raises(GeometryError, match="texture coordinates"):
        render(model, other, front_camera(), Light(name="a", direction=(0, 0, 1)))
    shifted = build_mesh(mesh.vertices_mm + np.array([0.0, 5.0, 0.0]), mesh.faces, mesh.uv)
    with pytest.raises(GeometryError, match="normals"):
        render(model, shifted, front_camera(), Light(name="a", direction=(0, 0, 1)))


def test_no_light_is_refused(matt):
    mesh = plane()
    with pytest.raises(RenderingError, match="lights: got none"):
        render(model_on(mesh, matt), mesh, front_camera(), [])


def test_meshes_are_read_with_their_texture_coordinates(tmp_path):
    text = "v 0 0 0\nv 9 0 0\nv 0 9 0\nvt 0 0\nvt 1 0\nvt 0 1\nf 1/1 2/2 3/3\n"
    (tmp_path / "a.obj").write_text(text)
    assert read_mesh(tmp_path / "a.obj").uv.max() == 1.0
    ply = (
        "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\n"
        "property float z\nproperty float s\nproperty float t\nelement face 1\n"
        "property list uchar int vertex_indices\nend_header\n0 0 0 0 0\n9 0 0 1 0\n0 9 0 0 1\n"
        "3 0 1 2\n"
    )
    assert parse_mesh(ply.encode(), "a.ply").uv.tolist() == [[0, 0], [1, 0], [0, 1]]
    with pytest.raises(ValueError, match="no texture coordinates"):
        parse_mesh(b"v 0 0 0\nv 9 0 0\nv 0 9 0\nf 1 2 3\n", "bare.obj")
    with pytest.raises(ValueError, match=r"expected \.obj"):
        read_mesh(tmp_path / "a.stl")
    with pytest.raises(OSError, match="missing"):
        read_mesh(tmp_path / "missing.obj")


def test_an_appearance_without_a_mesh_is_refused():
    from model.skin import SkinAppearance

    with pytest.raises(GeometryError, match="skinrig reconstruct"):
        read_own_mesh(SkinAppearance({}, "simulated"))


def test_under_even_light_spreading_changes_nothing(matt):
    mesh = plane()
    model = model_on(mesh, matt, r_d=(0.6, 0.4, 0.2))
    light = Light(name="front", direction=(0.2, 0.1, 1.0))
    spread_out, local = (
        render(model, mesh, front_camera(9), light, subsurface=way, subpixels=1)
        for way in ("dipole", "local")
    )
    np.testing.assert_allclose(spread_out.radiance, local.radiance, rtol=0.01)


@pytest.mark.parametrize("r_d", [0.0, 1e-6, 1.0 - 1e-9, 1.0, 1.5])
@pytest.mark.parametrize("sigma_tr", [1e-3, 1.0, 1e3])
def test_extreme_skin_gives_finite_images_proportional_to_albedo(matt, r_d, sigma_tr):
    """R_d above 1 is an outlier: light stays where it entered, and nothing is clamped."""
    mesh = plane()
    model = model_on(mesh, matt, r_d=(r_d, 0.5, 0.1), size=16)
    depth = np.full_like(model.translucency_mm, 1.0 / sigma_tr)
    model = dataclasses.replace(model, translucency_mm=depth)
    seen = render(
        model,
        mesh,
        front_camera(5),
        Light(name="a", direction=(0, 0, 1)),
        subsurface="dipole",
        subpixels=1,
    )
    passed = transmittance(1.0) ** 2
    expected = np.array([r_d, 0.5, 0.1]) * passed
    np.testing.assert_allclose(middle(seen.radiance), expected, rtol=0.01, atol=1e-9)


def test_a_fully_specular_texel_shows_the_surface_alone(shiny):
    mesh = plane()
    model = model_on(mesh, shiny, r_d=(0.0, 0.0, 0.0), weight=1e4)
    seen = render(model, mesh, front_camera(5), Light(name="a", direction=(0, 0, 1)))
    assert np.isfinite(seen.radiance).all()
    np.testing.assert_array_equal(seen.radiance, seen.surface)
    assert np.all(seen.surface > 100.0)


def test_rough_mesh_does_not_shade_its_elements(matt):
    """Points that left the mesh were below neighbors: 12 % of a scan's light was lost."""
    rng = np.random.default_rng(8)
    smooth = dome_mesh(height_mm=8.0, steps=40)
    vertices = smooth.vertices_mm + rng.normal(0.0, 0.15, smooth.vertices_mm.shape)
    rough = build_mesh(vertices, smooth.faces, smooth.uv)
    surface = FittedSurface.of(model_on(rough, matt), rough)
    interior = Interior.of(surface)
    lamp = Light(name="front", position_mm=FRONT)
    found = interior.compute_entered_flux(Lighting([lamp], Caster(rough), 1))
    towards, unshaded = lamp.directions_and_irradiance(interior.points_mm[:, 0])
    cosine = np.einsum("nk,nk->n", interior.normals.astype(np.float64), towards)
    expected = unshaded * (cosine * transmittance(cosine, surface.model.eta))[:, None]
    assert 0.98 < np.mean(found) / np.mean(expected) < 1.002
