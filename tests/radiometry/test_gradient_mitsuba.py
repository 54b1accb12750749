"""The gradient rig's Mitsuba scene and its integrator `ledmoments` against independent sums."""

import numpy as np
import pytest

from capture.rig import load_rig
from rigsim.as_built.sphere import build_sphere
from rigsim.light.lobe_moments import MicrofacetSurface, sum_led_moments
from rigsim.mitsuba.led_array import led_table
from rigsim.mitsuba.rig_camera import describe_camera
from rigsim.mitsuba.scene_radiance import load_description
from rigsim.mitsuba.startup import load_mitsuba
from rigsim.mitsuba.variant import choose_variant
from rigsim.scenes.gradient.lighting import lit_leds
from rigsim.scenes.gradient.reference import (
    NEUTRAL_GRIP,
    compare_with_reference,
    plain_scene,
    plain_skin,
    scene_pixels,
    trace_pixels,
)
from rigsim.scenes.gradient.rendering import TracedLight, describe_relief
from rigsim.tissue.skin_layers import ETA

pytestmark = pytest.mark.render

WIDTH = 48


@pytest.fixture(scope="module", autouse=True)
def choice():
    choice = choose_variant("rgb")
    if not choice.is_vectorized:
        pytest.skip("no LLVM: ledmoments needs a vectorized variant")
    return choice


@pytest.fixture(scope="module")
def skin():
    return plain_skin(WIDTH * 0.006 + 0.9)


@pytest.fixture(scope="module")
def pixels():
    return np.sort(np.random.default_rng(0).choice(WIDTH**2, 300, replace=False))


@pytest.fixture(scope="module")
def reference(skin, pixels):
    return trace_pixels(plain_scene(skin, width_px=WIDTH), pixels, subpixels=4)[0]


def traced(skin, pixels, **settings):
    scene = plain_scene(skin, width_px=WIDTH, renderer="mitsuba", **settings)
    assert scene.variant.renderer == "mitsuba"
    return scene_pixels(scene, pixels)


@pytest.mark.long
def test_mitsuba_moments_match_shadow_rays(skin, pixels, reference):
    """Tolerance: 0.3 % of the mean, by 4 instead of 16 samples per pixel; the mean within 0.1 %."""
    found = traced(skin, pixels)
    error = np.sqrt(np.mean((found - reference) ** 2, axis=0)) / reference[:, 0].mean()
    assert error.max() < 0.003
    np.testing.assert_allclose(found[:, [0, 3]].mean(0), reference[:, [0, 3]].mean(0), rtol=1e-3)


@pytest.mark.long
def test_mitsuba_error_falls_with_samples(skin, pixels, reference):
    """With the reference's own samples only rounding and penumbras of nearly no size are left."""
    errors = [
        compare_with_reference(traced(skin, pixels, subpixels=n), reference, 0.0).error
        for n in (1, 2, 4)
    ]
    assert errors[0] > 2.0 * errors[1] > 8.0 * errors[2]
    assert errors[2] < 2e-4


@pytest.mark.long
def test_fast_renderer_agrees_with_mitsuba(skin, pixels):
    """Bounds: horizons in 32 directions and the table err by less than 0.5 % of the mean."""
    fast = scene_pixels(plain_scene(skin, width_px=WIDTH), pixels)
    way = compare_with_reference(fast, traced(skin, pixels), 0.0)
    assert way.error < 0.005
    assert abs(way.mean_ratio - 1.0) < 0.002


@pytest.mark.long
def test_unshadowed_relief_breaks_both_bounds(skin, pixels, reference):
    way = compare_with_reference(traced(skin, pixels, shadows=False), reference, 0.0)
    assert way.error > 0.01
    assert way.mean_ratio - 1.0 > 0.01


@pytest.mark.long
@pytest.mark.parametrize("extinction", [np.inf, 300.0, 3.0])
def test_all_stokes_channels_match_exact_sums(skin, choice, extinction):
    """Expected: the sums of `lobe_moments` at each sample. Tolerance: 1e-3 of the mean light
    at the worst pixel, since the camera aims a thousandth of a sample beside each of them."""
    rig = load_rig("gradient").cropped(WIDTH)
    view = rig.views[0]
    sphere = build_sphere(rig, seed=2)
    surface = MicrofacetSurface(0.25, ETA, view.position_mm, view.axes[0], extinction)
    patch = plain_scene(skin, width_px=WIDTH).surface(NEUTRAL_GRIP, subpixels=1, border_px=2)
    leds = tuple(range(len(sphere.intensity)))
    light = TracedLight(sphere, surface, leds, False, view, choice)
    found = light.packed(patch, margin=2, pitch_um=6.0).reshape(16, -1)
    inner = patch.crop(2)
    x, y = inner.x_mm.ravel(), inner.y_mm.ravel()
    places = np.column_stack([x, y, inner.height_mm.ravel()])
    expected = sum_led_moments(inner.normals.reshape(-1, 3), places, sphere, surface)
    expected = expected.packed().T
    scale = np.repeat([expected[0].mean(), expected[12].mean()], (12, 4))
    assert np.abs((found - expected) / scale[:, None]).max() < 1e-3
    assert np.abs(expected[[1, 2]]).max() > 0.1 * expected[0].mean()  # polarized indeed


@pytest.mark.long
def test_scene_of_relief_renders_by_path(skin, choice):
    """The same scene by Mitsuba's own path tracer, under polarizers that transmit everything.
    Tolerance: 4 standard errors of its mean over blocks of pixels."""
    mi = load_mitsuba(choice)
    scene = plain_scene(skin, width_px=WIDTH, renderer="mitsuba", subpixels=1)
    patch = scene.surface(NEUTRAL_GRIP, subpixels=1, border_px=40)
    up = lit_leds(scene.sphere, shadows=True)
    light = TracedLight(
        scene.sphere, scene.optical_surface(0.25), up, True, scene.rig.views[0], choice
    )
    described = describe_relief(patch, light.led_rows(list(up)))
    camera = load_description(mi, light.camera((WIDTH, WIDTH), 6.0))
    path = mi.load_dict({"type": "path", "max_depth": 2})
    image = mi.render(load_description(mi, described), integrator=path, sensor=camera, spp=512)
    image = np.array(image.numpy())[..., 0].astype(np.float64)
    ours = scene.stokes(NEUTRAL_GRIP)[0, 0] / scene.unit
    way = compare_with_reference(image.reshape(-1), ours.reshape(-1).astype(np.float64), 0.0)
    assert way.mean_ratio_stderr < 0.005
    assert abs(way.mean_ratio - 1.0) < 4.0 * way.mean_ratio_stderr


@pytest.mark.long
def test_subpixels_are_means_of_a_finer_image(skin, choice):
    """`mi.render` of 2 x 2 rays per pixel; tolerance: rounding, and rays at edges of triangles."""
    mi = load_mitsuba(choice)
    scene = plain_scene(skin, width_px=WIDTH)
    patch = scene.surface(NEUTRAL_GRIP, subpixels=1, border_px=40)
    light = TracedLight(
        scene.sphere, scene.optical_surface(0.25), (), True, scene.rig.views[0], choice
    )
    up = list(lit_leds(scene.sphere, shadows=True))[:5]
    table = scene.sphere.weights[up]
    described = load_description(mi, describe_relief(patch, light.led_rows(up)))
    coarse, fine = (
        np.array(
            mi.render(
                described,
                integrator=load_description(
                    mi, {"type": "ledmoments", "table": table, "offset_mm": 1e-4, "subpixels": n}
                ),
                sensor=load_description(mi, light.camera((side, side), 6.0 * WIDTH / side)),
            )
        )
        for n, side in ((2, WIDTH), (1, 2 * WIDTH))
    )
    mean = fine.reshape(WIDTH, 2, WIDTH, 2, 16).mean(axis=(1, 3))
    assert np.abs(coarse - mean).max() < 1e-3 * mean.max()
    assert np.ptp(mean[..., 0]) > 0.1 * mean[..., 0].mean()


@pytest.mark.long
def test_wrong_scenes_of_ledmoments_are_refused(choice):
    mi = load_mitsuba(choice)
    integrator = load_description(mi, {"type": "ledmoments", "table": np.ones((1, 4))})
    ground = {"type": "rectangle", "bsdf": {"type": "diffuse"}}
    leds = {
        "type": "ledarray",
        "table": led_table([[0, 0, 9], [1, 0, 9]], [[0, 0, -1], [0, 0, -1]]),
    }
    one = leds | {"table": leds["table"][:1]}
    view = load_rig("gradient").cropped(WIDTH).views[0]
    sphere = build_sphere(load_rig("gradient"), seed=0)
    surface = MicrofacetSurface(0.25, ETA, view.position_mm, view.axes[0], 300.0)
    light = TracedLight(sphere, surface, (), True, view, choice)
    camera = load_description(mi, light.camera((4, 4), 6.0))
    for emitters, message in ((leds, "got 2 LEDs of a ledarray, expected 1"), (one, "a skincoat")):
        scene = load_description(mi, {"type": "scene", "ground": ground, "leds": emitters})
        with pytest.raises(ValueError, match=message):
            integrator.image(scene, camera)
    with pytest.raises(Exception, match="expected finite"):
        load_description(mi, {"type": "ledmoments", "table": np.ones((2, 5))})


@pytest.mark.long
def test_coated_skin_agrees_with_olat(choice):
    """Rationale: `olat` has the unpolarized formulas of hair, coating and diffuse term. Expected:
    S0 and the entering light, led out, add up to its image. Tolerance: rounding of float32."""
    mi = load_mitsuba(choice)
    coat = {"type": "skincoat", "r_d": 0.5, "oil": 0.3, "vellus": 0.005, "bare": 0.9}
    coat |= {"film": 0.5, "film_alpha": 0.2, "film_ior": 1.5, "powder": 0.2}
    place = np.array([[0.0, 100.0, 600.0], [-400.0, 0.0, 300.0]])
    axis = -place / np.linalg.norm(place, axis=1, keepdims=True)
    bare = {"type": "ledarray", "table": led_table(place, axis, intensity=[3e5, 1e5, 2e5])}
    film = led_table(place, axis, intensity=2e5, absorbs=[[0, 0, 1]] * 2, leak=1.0)
    camera = load_description(mi, describe_camera(load_rig("flash").resized(24).views[0]))
    images = []
    for leds, integrator in (
        (bare, {"type": "olat"}),
        (bare | {"table": film}, {"type": "ledmoments", "table": [[1.0, 0.0, 0.5, 0.0]] * 2}),
    ):
        ball = {"type": "sphere", "radius": 90.0, "bsdf": coat}
        scene = load_description(mi, {"type": "scene", "ball": ball, "leds": leds})
        table = {"table": np.array(integrator["table"])} if "table" in integrator else {}
        how = load_description(mi, integrator | table | {"subpixels": 1})
        images.append(np.array(mi.render(scene, integrator=how, sensor=camera)))
        hits = how.trace(scene, camera)
        (leaving,) = how.leaving_stokes(hits, [1.0, 0.0, 0.0])
    expected, moments = images
    out = np.zeros(expected.shape[:2])
    out.flat[hits.bands[0].pixel] = np.array(leaving[0])
    total = moments[..., 0] + moments[..., 12] * out * 0.5 / np.pi
    np.testing.assert_allclose(total, expected.mean(axis=-1), atol=1e-5 * expected.max())
    np.testing.assert_array_equal(moments[..., 6], 0.5 * moments[..., 0])
    assert (moments[..., 0] > 0.3 * expected.mean(axis=-1)).any()
    assert not moments[..., 3].any()


def test_skipped_shadow_rays_change_no_pixel(monkeypatch):
    """Skin whose grooves hide LEDs: most rays are skipped, and no image changes."""
    skin = plain_skin(WIDTH * 0.006 + 0.9)
    scene = plain_scene(skin, width_px=WIDTH, renderer="mitsuba")
    surface = scene.surface(NEUTRAL_GRIP, border_px=40)
    direct, pitch_um = scene.lighting().direct, scene.lens.pixel_on_subject_um
    fewer = direct.packed(surface, margin=40, pitch_um=pitch_um)
    hidable = direct._hidable(surface, direct.leds, 40, pitch_um)
    kept = np.mean([hidable(k).mean() for k in range(len(direct.leds))])
    assert 0.05 < kept < 0.6
    monkeypatch.setattr(TracedLight, "_hidable", lambda *_: None)
    every = direct.packed(surface, margin=40, pitch_um=pitch_um)
    assert np.abs(fewer - every).max() <= 1e-6 * np.abs(every).max()
