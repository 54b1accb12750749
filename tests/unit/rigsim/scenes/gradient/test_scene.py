"""The gradient rig's pictures: unit of light, orientation, polarization, states, noise."""

import dataclasses
import math

import numpy as np
import pytest

from capture.rig import load_rig
from rigsim.as_built.polarizers import IDEAL_POLARIZERS
from rigsim.as_built.sphere import PATTERN_WEIGHTS, ActualSphere, build_sphere
from rigsim.boxes.gradient_sphere import PatternLight
from rigsim.mitsuba.variant import choose_renderer
from rigsim.needs.sampled_patch import SampledPatch
from rigsim.scenes.exposing import SceneError
from rigsim.scenes.gradient.resolution import SineRelief, make_sine_relief_scene
from rigsim.scenes.gradient.scene import GRADIENT_METER_RATE_PER_S, GradientScene
from rigsim.scenes.gradient.target import FLAT_REFLECTANCE
from rigsim.scenes.gradient.truth import gradient_truth as ground_truth
from rigsim.scenes.gradient.truth import scene_surface
from rigsim.sensor import fixed_pattern
from rigsim.skin_patch.microrelief import MicroSkin, make_micro_skin
from rigsim.skin_patch.motion import PatchMotion
from rigsim.world.taped_skin import GripState

NEUTRAL = GripState(0.0, 0, 8.0, 1.0, True, False)
SIDE = 64


@dataclasses.dataclass(frozen=True)
class Light:
    pattern: str
    level: float = 1.0
    t_on_s: float = 0.0
    t_off_s: float = 0.018
    analyzer_deg: float = 0.0
    led_shares: tuple[float, ...] = ()


@pytest.fixture(scope="module")
def rig():
    return load_rig("gradient").cropped(SIDE)


def key_of(value):
    """Return a key that differs where any field of a window or of its sphere does."""
    if isinstance(value, SampledPatch | ActualSphere):
        return tuple(key_of(getattr(value, field.name)) for field in dataclasses.fields(value))
    if isinstance(value, MicroSkin):
        return id(value)
    return (value.shape, value.tobytes()) if isinstance(value, np.ndarray) else value


@pytest.fixture(scope="module", autouse=True)
def patches_sized_once():
    """Compute the effects' sizes once for scenes that are equal in all that the sizes depend on."""
    sized = {}
    compute = SampledPatch.changes_over_noise

    def look_up(window, white, noise, built):
        asked = (*key_of(window), white, noise, *built.items())
        if asked not in sized:  # the patch is kept, so that no other has its id
            sized[asked] = window.patch, compute(window, white, noise, built)
        return sized[asked][1]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(SampledPatch, "changes_over_noise", look_up)
        yield


@pytest.fixture(scope="module")
def skin():
    return make_micro_skin("cheek", seed=3, size_mm=1.2)


@pytest.fixture(scope="module")
def flat_skin(skin):
    even = np.full_like(skin.height_um, 0.0)
    return dataclasses.replace(
        skin, height_um=even, albedo=even + np.float32(0.3), alpha=even + np.float32(0.25)
    )


@pytest.fixture(scope="module", params=["mitsuba", "fast"])
def scene(request, rig, skin):
    """The patch by each renderer; without LLVM both are the fast one."""
    if request.param == "fast":
        return GradientScene(rig, skin, table_size=33)
    return GradientScene(rig, skin)


def test_diffuser_gets_its_meter_rate_behind_any_analyzer(rig):
    """Tolerance: the corner of the field, and what the sphere as drawn is off its unit (none)."""
    flat = GradientScene(rig, "flat", films=IDEAL_POLARIZERS)
    for reading in (0.0, 90.0, 37.0):
        image = flat.radiance("full", analyzer_deg=reading)
        np.testing.assert_allclose(image, FLAT_REFLECTANCE * GRADIENT_METER_RATE_PER_S, rtol=1e-4)


def test_every_pattern_is_the_sum_of_its_leds(rig, flat_skin):
    """Lit by a sphere of one LED, a pattern is that LED's own weight times full."""
    sphere = build_sphere(rig, seed=1)
    for led in (3, 40):
        one = np.zeros(len(sphere.intensity))
        one[led] = 1.0
        alone = GradientScene(rig, flat_skin, sphere=dataclasses.replace(sphere, intensity=one))
        full = alone.radiance("full", grip=NEUTRAL)
        assert full.min() > 0.0
        for pattern, weights in PATTERN_WEIGHTS.items():
            share = float(np.dot(weights, sphere.weights[led]))
            got = alone.radiance(pattern, grip=NEUTRAL)
            np.testing.assert_allclose(got, share * full, rtol=1e-3, atol=1e-4 * full.max())


@pytest.mark.long
def test_a_pattern_and_its_complement_make_full(scene):
    full = scene.radiance("full", grip=NEUTRAL)
    for axis in "xyz":
        both = scene.radiance(axis, grip=NEUTRAL) + scene.radiance(f"-{axis}", grip=NEUTRAL)
        np.testing.assert_allclose(both, full, rtol=1e-5)
    assert not scene.radiance("dark", grip=NEUTRAL).any()


def test_slopes_right_and_up_brighten_x_y_patterns(scene):
    """The surface's reflection, which crossing removes, leans with the normal."""
    normals = scene.surface(NEUTRAL).normals
    moments = scene.moments(NEUTRAL)
    specular = moments["parallel"] - moments["crossed"]
    inner = (slice(6, -6), slice(6, -6))
    for axis in (0, 1):
        ratio = (specular[1 + axis] / specular[0])[inner].ravel()
        tilt = normals[..., axis][inner].ravel()
        assert np.corrcoef(ratio, tilt)[0, 1] > 0.9
        assert abs(np.corrcoef(ratio, normals[..., 1 - axis][inner].ravel())[0, 1]) < 0.5


@pytest.mark.parametrize("table_size", [None, 33], ids=["mitsuba", "fast"])
def test_crossed_polarizers_remove_specular_of_flat_patch(rig, flat_skin, table_size):
    """Black skin, ideal films: what is left in the middle is what is off the central view."""
    black = dataclasses.replace(flat_skin, albedo=np.zeros_like(flat_skin.albedo))
    scene = GradientScene(rig, black, films=IDEAL_POLARIZERS, table_size=table_size)
    moments = scene.moments(NEUTRAL)
    leak = moments["crossed"][0] / moments["parallel"][0]
    assert leak.max() < 0.02
    turned = scene.radiance("full", grip=NEUTRAL, analyzer_deg=80.0)
    # Malus: sin^2(10 degrees) = 3 %
    extra = (turned / moments["parallel"][0]).mean() - leak.mean()
    assert extra == pytest.approx(np.sin(np.radians(10.0)) ** 2, abs=0.01)


def test_crossed_images_show_pigment(scene):
    surface = scene.surface(NEUTRAL)
    crossed = scene.moments(NEUTRAL)["crossed"][0]
    inner = (slice(6, -6), slice(6, -6))
    assert np.corrcoef(crossed[inner].ravel(), surface.albedo[inner].ravel())[0, 1] > 0.8


@pytest.mark.parametrize("table_size", [None, 33], ids=["mitsuba", "fast"])
def test_jaws_are_dark_and_end_at_the_aperture(rig, flat_skin, table_size):
    narrow = GripState(90.0, -4, 0.24, 1.0, True, False)
    image = GradientScene(rig, flat_skin, table_size=table_size).radiance("full", grip=narrow)
    pixel_mm = 0.006
    y = -(np.arange(SIDE) - 0.5 * (SIDE - 1)) * pixel_mm
    jaw, between = np.abs(y) > 0.12 + 0.03, np.abs(y) < 0.12 - 0.03
    assert image[jaw].max() < 0.4 * image[between].min()


def test_exposures_have_only_sensor_noise(scene):
    """Two exposures of the same state differ by shot and read noise alone (chi-square, 1e-6)."""
    frames = [
        scene.exposure("cam", pops=[Light("full")], exposure_s=0.04, seed=k, grip=NEUTRAL)
        for k in (1, 2)
    ]
    sensor = scene.sensor()
    response = fixed_pattern(sensor, frames[0].shape).response
    light = scene.radiance("full", grip=NEUTRAL) * 0.018 * response
    slope, offset = sensor.noise_profile(0.04)
    span = sensor.white - sensor.black
    # energies differ by 0.1 % each; a common gain is fitted out
    a, b = ((f.astype(float) - sensor.black) / span for f in frames)
    gain = float((a * b).sum() / (b * b).sum())
    assert abs(gain - 1.0) < 0.01
    chi2 = float(((a - gain * b) ** 2 / (2.0 * (slope * light + offset))).sum())
    freedom = a.size - 1
    assert abs(chi2 - freedom) < 5.0 * np.sqrt(2.0 * freedom)


def test_no_light_gives_a_dark_frame(scene):
    dark = scene.exposure("cam", pops=[], exposure_s=0.04, seed=1, grip=NEUTRAL)
    assert dark.mean() == pytest.approx(scene.sensor().black, abs=0.5)


def test_jump_of_20_pixels_moves_image_20_pixels(rig, skin):
    still = PatchMotion(
        0,
        angle_um=0.0,
        angle_turn_deg=0.0,
        state_um=0.0,
        state_turn_deg=0.0,
        drift_um=0.0,
        jumps_um={1.0: (120.0, 0.0)},
    )
    scene = GradientScene(rig, skin, motion=still, table_size=33)
    before = scene.radiance("full", grip=NEUTRAL, t_s=0.5)
    after = scene.radiance("full", grip=NEUTRAL, t_s=1.5)
    inner = slice(8, -8)
    np.testing.assert_allclose(after[inner, 28:-8], before[inner, 8:-28], rtol=0.02)
    assert np.abs(after[inner, 28:-8] / before[inner, 28:-8] - 1).mean() > 0.02


def test_drift_moves_image_as_stated(rig, skin):
    """A drifted picture is the picture of skin that lies there; tolerance: 6-point shifts."""
    still = {"angle_um": 0.0, "angle_turn_deg": 0.0, "state_um": 0.0, "state_turn_deg": 0.0}
    drifting = PatchMotion(4, drift_um=4.0, **still)
    t_s = 2.0
    dx, dy = drifting.drift_mm(t_s)
    assert np.hypot(dx, dy) > 1e-3
    lying = PatchMotion(4, drift_um=0.0, jumps_um={0.0: (1e3 * dx, 1e3 * dy)}, **still)
    drifted, lain, still_there = (
        GradientScene(rig, skin, motion=motion, table_size=33).radiance(
            "full", grip=NEUTRAL, t_s=t_s
        )
        for motion in (drifting, lying, PatchMotion(4, drift_um=0.0, **still))
    )
    error = np.abs(drifted / lain - 1.0).max()
    assert error < 0.01
    assert np.abs(still_there / lain - 1.0).max() > 3.0 * error


def test_state_truth_records_applied_motion(scene):
    stretched = GripState(45.0, 2, 9.6, 1.15, True, False)
    truth = ground_truth(scene, [NEUTRAL, stretched])
    states = {row["name"]: row for row in truth.parameters["states"]}
    assert set(states) == {"a000_n0", "a045_p2"}
    gradient = np.array(states["a045_p2"]["gradient"])
    axis = np.array([1.0, 1.0]) / np.sqrt(2.0)
    assert axis @ gradient @ axis == pytest.approx(1.15)
    assert np.linalg.det(gradient) == pytest.approx(1.15 * states["a045_p2"]["stretch_t"])
    assert truth.maps["height"].values is truth.maps["height_a000_n0"].values
    normals = truth.maps["normals_a045_p2"].values
    np.testing.assert_allclose(np.linalg.norm(normals, axis=-1), 1.0, rtol=1e-5)
    # heights and normals tell the same slopes (central differences of 12 um)
    height = truth.maps["bulged_height_a045_p2"].values
    slope = (height[:, 2:] - height[:, :-2]) / 12.0
    told = -(normals[..., 0] / normals[..., 2])[:, 1:-1]
    assert np.corrcoef(slope.ravel(), told.ravel())[0, 1] > 0.97


def test_invalid_scene_requests_are_refused(rig, skin, scene):
    with pytest.raises(SceneError, match="grip: got none"):
        scene.radiance("full")
    with pytest.raises(SceneError, match="pattern: got 'w'"):
        scene.radiance("w", grip=NEUTRAL)
    for light, message in (
        (PatternLight("full", 1.5, 0.0, 0.01, 0.0), "level of pattern 'full': got 1.5"),
        (PatternLight("x", 1.0, 0.02, 0.01, 0.0), "light of pattern 'x': got 0.02 to 0.01 s"),
    ):
        with pytest.raises(SceneError, match=message):
            scene.exposure("cam", pops=[light], exposure_s=0.1, seed=0, grip=NEUTRAL)
    with pytest.raises(SceneError, match="sectors"):
        GradientScene(rig, skin, sectors=7)
    with pytest.raises(SceneError, match="subject"):
        GradientScene(rig, "cube")


def test_unaffordable_patches_name_the_fast_renderer(rig, skin):
    """What Mitsuba does not render falls back with the reason; it never differs silently."""
    smooth = dataclasses.replace(skin, alpha=np.full_like(skin.alpha, 0.01))
    full = load_rig("gradient")
    for made, why in (
        (GradientScene(full, skin), "3.3e+08 shadow rays per state exceed 2.5e+07"),
        (GradientScene(rig, skin, sectors=16), "sectors: requested settings of the fast renderer"),
        (GradientScene(rig, smooth), "roughness 0.01 is below 0.02"),
        (GradientScene(rig, "flat"), "closed forms render the target flat"),
        (GradientScene(rig, skin, choice=choose_renderer("fast")), "requested"),
    ):
        assert (made.variant.renderer, made.variant.why) == ("fast", why)
    chosen = choose_renderer("mitsuba")
    assert GradientScene(rig, skin).variant == chosen
    assert GradientScene(full, skin, choice=chosen).variant == chosen


def test_cliffs_of_75_degrees_are_dark_but_finite():
    """Steeper than the table goes, and in their own shadow; waves 0.12 mm long, 70 um high."""
    scene = make_sine_relief_scene(optics=False)
    scene.set_waves(SineRelief(120.0, math.tan(math.radians(75.0))))
    light = scene.moments(NEUTRAL)
    normals = scene.surface(NEUTRAL).normals
    full = light["parallel"][0] + light["crossed"][0]
    assert np.isfinite(full).all()
    assert full.min() > -1e-4 * full.max()
    cliff, ridge = normals[..., 2] < 0.35, normals[..., 2] > 0.8
    height = scene.surface(NEUTRAL).relief_um
    valley = ridge & (height < 0.0)
    crest = ridge & (height > 0.0)
    assert cliff.any()
    # the surface's reflection, which does not spread inside the skin
    specular = light["parallel"][0] - light["crossed"][0]
    assert specular[cliff].mean() < 0.5 * specular[crest].mean()
    assert specular[valley].mean() < 0.8 * specular[crest].mean()  # their normals are alike


def test_buckled_and_detached_skin_are_rendered_as_such(scene):
    """A fold tilts normals by up to 15 degrees; skin that came off does not even bulge."""
    buckled = GripState(0.0, -3, 5.6, 0.72, True, True)
    loose = GripState(0.0, 5, 12.0, 1.0, False, False)
    surfaces = {grip: scene.surface(grip) for grip in (NEUTRAL, buckled, loose)}
    bulges = {grip: float(np.ptp(surface.bulge_um)) for grip, surface in surfaces.items()}
    assert bulges[loose] == 0.0
    assert 0.0 < bulges[NEUTRAL] < 2.0  # of 100 um over 8 mm, in 0.4 mm
    assert bulges[buckled] > 10.0
    for grip in (buckled, loose):
        image = scene.radiance("full", grip=grip)
        assert np.isfinite(image).all()
        assert image.min() > 0.0


def test_a_level_patch_mirrors_the_sphere_evenly(rig, flat_skin):
    """No furrow, no shadow: one value over the field but for its own tilt of 0.05 degrees."""
    level = GradientScene(rig, flat_skin, table_size=33)
    moments = level.moments(NEUTRAL)
    specular = (moments["parallel"] - moments["crossed"])[0, 6:-6, 6:-6]
    assert np.ptp(specular) < 0.03 * specular.mean()


@pytest.mark.parametrize("most", [512, 40, 16], ids=["whole", "less margin", "center"])
def test_stored_surface_is_bounded_around_the_center(rig, skin, monkeypatch, most):
    monkeypatch.setattr("rigsim.scenes.gradient.truth.MAX_SURFACE_PX", most)
    scene = GradientScene(rig, skin, table_size=33)
    side = min(SIDE, most)
    found = scene_surface(scene, [dataclasses.replace(NEUTRAL, step=1), NEUTRAL])
    wide = scene.surface(NEUTRAL, border_px=40).crop((SIDE - side) // 2)
    for field in dataclasses.fields(wide):
        expected = getattr(wide, field.name)
        assert expected.shape[:2] == (side + 80, side + 80)
        np.testing.assert_array_equal(found[field.name], expected)
    assert found["unit"] == scene.unit
