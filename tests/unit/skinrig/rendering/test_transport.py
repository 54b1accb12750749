"""Light between parts of a surface against closed forms: cavity, plane, black and white skin."""

import numpy as np
import pytest

from model.brdf import tables as brdf_tables
from model.skin_reflectance import SkinReflectance
from rigsim.geometry.atlas import unwrap
from rigsim.geometry.mesh import build_mesh
from rigsim.render import Caster
from skinrig.rendering import camera as rendering_camera
from skinrig.rendering.camera import RenderingError
from skinrig.rendering.geometry import FittedSurface
from skinrig.rendering.lights import Light
from skinrig.rendering.render import render_surface
from skinrig.rendering.transport import SkinExchange

TEXELS = 24


@pytest.fixture(scope="module")
def matt():
    return brdf_tables.tabulate({"none": lambda light, view: np.zeros(light.shape[:-1])})


def grid_mesh(points, normals):
    rows, columns = points.shape[:2]
    index = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = (
        part.reshape(-1)
        for part in (index[:-1, :-1], index[:-1, 1:], index[1:, :-1], index[1:, 1:])
    )
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([b, d, c], 1)])
    u, v = np.meshgrid(np.linspace(0.0, 1.0, columns), np.linspace(0.0, 1.0, rows))
    uv = np.stack([u, v], -1).reshape(-1, 2)
    return build_mesh(points.reshape(-1, 3), faces, uv, normals.reshape(-1, 3))


def cavity(steps=24, radius_mm=50.0):
    """Return a closed sphere, but for two pinholes, whose outside faces its center."""
    polar, turn = np.meshgrid(
        np.linspace(0.02, np.pi - 0.02, steps + 1),
        np.linspace(0.0, 2.0 * np.pi, 2 * steps + 1),
        indexing="ij",
    )
    unit = np.stack(
        [np.sin(polar) * np.cos(turn), np.sin(polar) * np.sin(turn), np.cos(polar)], axis=-1
    )
    return grid_mesh(radius_mm * unit, -unit)


def sheet(side_mm=60.0):
    x, y = np.meshgrid(np.linspace(-0.5, 0.5, 5), np.linspace(-0.5, 0.5, 5))
    points = side_mm * np.stack([x, y, 0.0 * x], axis=-1)
    return grid_mesh(points, np.broadcast_to([0.0, 0.0, 1.0], points.shape))


def exchange_on(mesh, basis, r_d, *, eta=1.0, **options):
    atlas = unwrap(mesh, TEXELS)
    shape = (TEXELS, TEXELS)
    model = SkinReflectance(
        r_d=np.full((*shape, 3), r_d, np.float32),
        weights=np.zeros((*shape, basis.size), np.float32),
        lobes=basis,
        translucency_mm=np.ones((*shape, 3), np.float32),
        normals=np.where(atlas.covered[..., None], atlas.normal, (0.0, 0.0, 1.0)),
        position_mm=atlas.position_mm,
        valid=atlas.covered,
        eta=eta,
    )
    return SkinExchange.of(FittedSurface.of(model, mesh), Caster(mesh), **options)


def returning(exchange):
    return exchange.scatter(np.ones((len(exchange.met), 3)))


@pytest.mark.parametrize("r_d", [0.2, 0.5, 0.8])
def test_cavity_light_is_the_geometric_series(matt, r_d):
    # in an integrating sphere each reflection keeps R_d of the light: R_d / (1 - R_d) in sum
    found = returning(exchange_on(cavity(), matt, r_d))
    assert found.entered.mean() == pytest.approx(r_d / (1.0 - r_d), rel=0.02)
    np.testing.assert_allclose(found.exitance, r_d * (1.0 + found.entered), rtol=1e-6)


def test_flat_sheet_receives_no_light_from_itself(matt):
    exchange = exchange_on(sheet(), matt, 0.9)
    assert np.all(exchange.met == -1)
    assert np.all(returning(exchange).entered == 0.0)


def test_sheet_renders_equal_with_and_without_paths(matt):
    exchange = exchange_on(sheet(), matt, 0.9, eta=1.4)
    camera = rendering_camera.look_at((0.0, 0.0, 700.0), fov_deg=4.0, size_px=(16, 16))
    light = Light(name="front", direction=(0.0, 0.3, 1.0))
    images = [
        render_surface(exchange.surface, camera, light, caster=exchange.caster, exchange=one)
        for one in (None, exchange)
    ]
    np.testing.assert_array_equal(images[0].radiance, images[1].radiance)


def test_black_skin_returns_no_light(matt):
    assert np.all(returning(exchange_on(cavity(), matt, 0.0)).entered == 0.0)


def test_albedo_above_one_does_not_diverge(matt):
    found = returning(exchange_on(cavity(), matt, 1.2))
    assert np.isfinite(found.entered).all()
    # at most as many reflections as are traced, each with all of the light
    assert found.entered.max() <= found.reflections
    assert found.reflections == 50


def test_boundary_keeps_part_of_the_light(matt):
    clear, skin = (
        returning(exchange_on(cavity(), matt, 0.5, eta=eta)).entered.mean() for eta in (1.0, 1.4)
    )
    assert 0.6 * clear < skin < 0.95 * clear


def test_same_seed_gives_same_paths(matt):
    first, again, other = (exchange_on(cavity(), matt, 0.5, seed=s, samples=8) for s in (1, 1, 2))
    np.testing.assert_array_equal(first.way, again.way)
    np.testing.assert_array_equal(first.met, again.met)
    assert not np.array_equal(first.way, other.way)


def test_directions_are_cosine_weighted(matt):
    exchange = exchange_on(sheet(), matt, 0.5, samples=256)
    cosine = exchange.way[..., 2]
    assert cosine.mean() == pytest.approx(2.0 / 3.0, abs=0.002)
    assert np.mean(cosine**2) == pytest.approx(0.5, abs=0.002)


def test_zero_path_samples_are_refused(matt):
    with pytest.raises(RenderingError, match="path samples: got 0, expected 1 or more"):
        exchange_on(sheet(), matt, 0.5, samples=0)
