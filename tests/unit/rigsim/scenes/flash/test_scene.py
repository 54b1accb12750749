"""The flash scene: light where geometry says, films as Malus says, truth that fits the images."""

import dataclasses
import math
from dataclasses import dataclass

import numpy as np
import pytest

from capture.calibration.color.chart import find_chart
from capture.rig import Rig, load_rig
from rigsim.as_built.polarizers import IDEAL_POLARIZERS, PolarizerError, Polarizers, draw_polarizers
from rigsim.mitsuba.variant import VariantChoice
from rigsim.needs.effects import SceneEffects
from rigsim.scenes.exposing import SceneError
from rigsim.scenes.flash.scene import FLAT_FIELD_LEVEL, METERING_LEVEL, FlashScene
from rigsim.sensor import make_sensor
from rigsim.subject.person import SimulatedSubject
from rigsim.targets.flat import make_target, patch_centers_mm

# Embree traces the rays, so these tests need no Mitsuba.
EMBREE = VariantChoice("scalar_rgb", "asked for by the test", "")
WIDTH = 252  # of the shared rig


@dataclass(frozen=True)
class Fired:
    """A pop as the world reports it."""

    token: str = "t1"
    power: float = 1.0
    polarizer: str = "crossed"
    analyzer_deg: float | None = None
    led: str = ""


PLAIN = {"choice": EMBREE, "subpixels": 1}


def scene_of(rig: Rig, subject, *, lateral=None, optics=None, **kwargs) -> FlashScene:
    effects = SceneEffects(lateral=lateral, interreflections=False, optics=optics)
    return FlashScene(rig, subject, effects=effects, **(PLAIN | kwargs))


@pytest.fixture(scope="module")
def ideal(rig: Rig, face: SimulatedSubject) -> FlashScene:
    return scene_of(rig, face, films=IDEAL_POLARIZERS, lateral=False, optics=False)


@pytest.fixture(scope="module")
def real(rig: Rig, face: SimulatedSubject) -> FlashScene:
    return scene_of(rig, face, subpixels=2)


def test_white_reference_gives_metered_level_behind_both_polarizers(rig):
    scene = scene_of(rig, make_target("white"), films=IDEAL_POLARIZERS)
    crossed, parallel = scene.radiance("crossed"), scene.radiance("parallel")
    middle = crossed[rig.views[0].height_px // 2, WIDTH // 2]
    np.testing.assert_allclose(middle, 0.99 * scene.white_rgb(), rtol=1e-3)
    assert middle.max() == pytest.approx(0.99 * METERING_LEVEL, rel=1e-3)
    np.testing.assert_allclose(parallel, crossed, rtol=1e-5)


def test_light_on_tile_follows_cosine_and_inverse_square(rig):
    scene = scene_of(rig, make_target("white"), films=IDEAL_POLARIZERS)
    view = rig.views[0]
    image = scene.radiance("crossed")[..., 1] / (0.99 * scene.white_rgb()[1])
    step_mm = view.distance_mm / view.focal_px
    x = (np.arange(view.width_px) - 0.5 * (view.width_px - 1)) * step_mm
    y = -(np.arange(view.height_px) - 0.5 * (view.height_px - 1)) * step_mm

    def irradiance(px, py):
        total = 0.0
        for light in rig.lights:
            lx, ly, lz = light.position_mm
            total = total + lz / ((px - lx) ** 2 + (py - ly) ** 2 + lz**2) ** 1.5
        return total

    expected = irradiance(x[None, :], y[:, None]) / irradiance(0.0, 0.0)
    np.testing.assert_allclose(image, expected, rtol=1e-4)


def test_light_on_right_brightens_right_side(rig, face):
    right = dataclasses.replace(rig, lights=(rig.light("right"),))
    scene = scene_of(right, face, lateral=False)
    image = scene.radiance("crossed").sum(axis=-1)
    assert image[:, WIDTH // 2 :].sum() > 1.1 * image[:, : WIDTH // 2].sum()
    shine = scene.truth()["specular"][..., 1]
    columns = np.arange(WIDTH)
    assert (shine * columns).sum() / shine.sum() > WIDTH / 2 + 5


def test_row_0_is_top_and_column_0_left(real):
    truth = real.truth()
    rows, columns = np.nonzero(truth["mask"])
    y, x = truth["position_mm"][rows, columns, 1], truth["position_mm"][rows, columns, 0]
    assert np.corrcoef(rows, y)[0, 1] < -0.99
    assert np.corrcoef(columns, x)[0, 1] > 0.99
    # The brows are above the middle of the image.
    hair_rows = np.nonzero(truth["hair"] > 0.5)[0]
    assert 0.2 < hair_rows.mean() / truth["hair"].shape[0] < 0.45


def test_crossed_image_is_shading_times_reflectance_plus_leak(ideal):
    """Without lateral transport and with ideal films, what exceeds the product is the specular
    leak of skew directions: positive, and below 1 % of the white reference."""
    truth = ideal.truth()
    product = truth["shading"][..., None] * truth["reflectance"] * ideal.white_rgb()
    rest = (ideal.radiance("crossed") - product)[truth["mask"]]
    # Texels are blended after the product is taken, which shows at the borders of moles and hair.
    assert np.quantile(np.abs(rest), 0.9) < 5e-4 * METERING_LEVEL
    assert np.quantile(rest, 0.02) > -5e-4 * METERING_LEVEL
    assert np.abs(rest).max() < 0.01 * METERING_LEVEL


def test_skin_facing_camera_is_brighter_than_lambertian(ideal):
    """Expected: T(0)^2 / (T(0) T_average) = 1.053 in the middle of the forehead."""
    truth = ideal.truth()
    facing = truth["mask"] & (truth["normals"][..., 2] > 0.995)
    ratio = truth["shading"][facing] / truth["irradiance"][facing]
    assert ratio.mean() == pytest.approx(0.97222 / 0.92319, rel=5e-3)


def test_both_images_split_into_subsurface_and_surface_light(ideal):
    """Near the axis: crossed = d / 2, parallel = d / 2 + s; far off it parallel is not."""
    truth = ideal.truth()
    crossed, parallel = ideal.radiance("crossed"), ideal.radiance("parallel")
    near = truth["mask"] & (truth["normals"][..., 2] > 0.98)
    half = 0.5 * truth["diffuse"]
    np.testing.assert_allclose(crossed[near], half[near], rtol=0.01)
    np.testing.assert_allclose(parallel[near], (half + truth["specular"])[near], rtol=0.01)
    far = truth["mask"] & (truth["normals"][..., 2] < 0.5) & (truth["irradiance"] > 0.05)
    off = np.abs(parallel - half - truth["specular"])[far] / half[far]
    assert np.quantile(off, 0.9) > 0.01


def test_images_behind_crossed_analyzers_sum_to_constant(real):
    sums = [
        real.radiance("parallel", angle) + real.radiance("parallel", angle + 90.0)
        for angle in (0.0, 17.0, 45.0)
    ]
    # Film absorbs along an axis in its plane: off the optical axis two films at 90 degrees pass
    # axes that are not quite perpendicular, by up to 0.013 rad in the corner of this image.
    np.testing.assert_allclose(sums[1], sums[0], rtol=3e-3, atol=1e-6)
    np.testing.assert_allclose(sums[2], sums[0], rtol=3e-3, atol=1e-6)


def test_metal_target_is_dark_behind_crossed_analyzer(rig):
    films = Polarizers(light_extinction=2000.0, analyzer_extinction=3000.0, analyzer_zero_deg=1.0)
    scene = scene_of(rig, make_target("malus"), films=films)
    middle = np.s_[rig.views[0].height_px // 2, WIDTH // 2]
    angles = np.arange(0.0, 181.0, 15.0)
    curve = np.array([scene.radiance("parallel", a)[middle][1] for a in angles])
    leak = 1.0 / 2000.0 + 1.0 / 3000.0
    shape = np.cos(np.deg2rad(angles + 1.0)) ** 2
    expected = curve[0] / shape[0] * (shape + leak * (1.0 - shape))
    np.testing.assert_allclose(curve, expected, atol=2e-4 * curve[0])
    assert curve[6] / curve[0] == pytest.approx(leak + math.sin(math.radians(1.0)) ** 2, rel=0.1)


def test_flat_is_uniform_unpolarized_and_cap_is_dark(rig):
    flat, dark = scene_of(rig, make_target("flat")), scene_of(rig, make_target("dark"))
    image = flat.radiance("parallel")
    assert image.max() == pytest.approx(FLAT_FIELD_LEVEL)
    assert np.ptp(image, axis=(0, 1)).max() == 0.0
    np.testing.assert_array_equal(image, flat.radiance("crossed", 33.0))
    assert not dark.radiance("crossed").any()


def test_chart_is_found_at_its_position(rig):
    scene = scene_of(rig.resized(504), make_target("chart"))
    view = scene.rig.views[0]
    found = find_chart(scene.radiance("crossed") / scene.white_rgb())
    scale = view.focal_px / view.distance_mm
    x = patch_centers_mm()[:, 0] * scale + 0.5 * (view.width_px - 1)
    y = 0.5 * (view.height_px - 1) - patch_centers_mm()[:, 1] * scale
    np.testing.assert_allclose(found, np.column_stack([x, y]), atol=0.6)


def test_exposures_scale_with_pop_power_and_add_up(rig, face):
    quiet = dataclasses.replace(
        make_sensor(rig.views[0], prnu=0.0, dsnu_e=0.0, vignetting=0.0, dark_e_per_s=0.0),
        read_noise_e=0.0,
    )
    scene = scene_of(rig, make_target("white"), sensor=quiet, films=IDEAL_POLARIZERS)

    def mean(*pops: Fired) -> float:
        frame = scene.exposure("cam", pops=pops, exposure_s=0.01, seed=3)
        return float(frame.mean()) - quiet.black

    one, half = mean(Fired()), mean(Fired(power=0.5))
    assert half / one == pytest.approx(0.5, rel=0.01)
    assert mean(Fired(power=0.5), Fired(token="t2", power=0.3)) / one == pytest.approx(
        0.8, rel=0.01
    )


def test_without_a_pop_the_frame_is_dark(rig):
    view = load_rig("flash").views[0]  # its read noise is more than a DN; binned pixels' is not
    sensor = make_sensor(view)
    scene = scene_of(rig, make_target("white"), sensor=sensor)
    frame = scene.exposure("cam", pops=(), exposure_s=0.01, seed=1)
    noise_dn = math.hypot(view.read_noise_e, sensor.dsnu_e) / view.gain_e_per_dn
    assert abs(frame.mean() - view.black_level) < 5.0 * noise_dn / math.sqrt(frame.size)
    assert frame.std() == pytest.approx(math.hypot(noise_dn, math.sqrt(1 / 12)), rel=0.05)


def test_same_seed_gives_same_frame_another_seed_another(real):
    frames = [
        real.exposure("cam", pops=(Fired(),), exposure_s=0.01, seed=seed) for seed in (1, 1, 2)
    ]
    np.testing.assert_array_equal(frames[0], frames[1])
    assert (frames[0] != frames[2])[real.truth()["mask"]].mean() > 0.5


def test_exercise_reddens_the_cheeks_and_leaves_the_melanin(rig, face, ideal):
    tired = scene_of(rig, face, state="exercise", films=IDEAL_POLARIZERS, lateral=False)
    before, after = ideal.truth(), tired.truth()
    np.testing.assert_array_equal(before["melanin"], after["melanin"])
    x, y = before["position_mm"][..., 0], before["position_mm"][..., 1]
    cheeks = before["mask"] & (np.abs(np.abs(x) - 45.0) < 8.0) & (np.abs(y + 8.0) < 8.0)
    assert (after["hemoglobin"][cheeks] > 1.15 * before["hemoglobin"][cheeks]).all()
    ratio = tired.radiance("crossed")[cheeks] / ideal.radiance("crossed")[cheeks]
    assert ratio[:, 1].mean() < 0.97
    assert ratio[:, 0].mean() > ratio[:, 1].mean()


def test_lateral_transport_smooths_image_and_keeps_truth_sharp(real, ideal):
    truth = real.truth()
    inside = truth["mask"]
    # Texels are 1 mm here. Melanin lies above the spreading and stays half sharp.
    for name, factor in (("melanin", 0.99), ("hemoglobin", 0.95)):
        sharp, blurred = truth[name][inside], truth[f"{name}_blurred"][inside]
        assert blurred.mean() == pytest.approx(sharp.mean(), rel=0.03)

        def detail(m: np.ndarray) -> float:
            both = inside[:, 1:] & inside[:, :-1]
            return float(np.std(np.log(m[:, 1:][both] / m[:, :-1][both])))

        assert detail(truth[f"{name}_blurred"]) < factor * detail(truth[name])
    red, green, blue = real.resolution_mm()
    assert 0.2 < blue < green < red < 3.0
    np.testing.assert_array_equal(ideal.truth()["hemoglobin"], ideal.truth()["hemoglobin_blurred"])


def test_truth_is_finite_with_unit_normals_towards_camera(real):
    truth = real.truth()
    shape = real.rig.views[0].height_px, WIDTH
    for name, values in truth.items():
        assert values.shape[:2] == shape, name
        assert np.isfinite(values).all(), name
    inside = truth["mask"]
    np.testing.assert_allclose(np.linalg.norm(truth["normals"][inside], axis=-1), 1.0, atol=1e-5)
    assert (truth["normals"][inside][:, 2] > 0.0).mean() > 0.95
    assert 0.2 < inside.mean() < 0.8
    assert truth["hair"][inside].max() < 0.02


def test_polarizers_of_rig_follow_from_serial_number(rig):
    films = draw_polarizers(rig)
    assert films == draw_polarizers(rig)
    assert 1500.0 <= films.light_extinction <= 6000.0
    assert abs(films.analyzer_zero_deg) <= 1.2
    view = dataclasses.replace(rig.views[0], serial="SR-0002")
    assert draw_polarizers(dataclasses.replace(rig, views=(view,))) != films


def test_omitted_effects_are_reported_with_reason(real, ideal, rig):
    for scene in (real, ideal, scene_of(rig, make_target("white"))):
        assert len(scene.omitted) >= 3
        assert all(what and why for what, why in scene.omitted)
    assert len(ideal.omitted) == len(real.omitted) + 2  # spreading, and the lens


def test_invalid_options_are_named(rig, face, real):
    mixed = dataclasses.replace(
        rig, lights=(rig.lights[0], dataclasses.replace(rig.lights[1], illuminant="A"))
    )
    with pytest.raises(SceneError, match="expected one"):
        scene_of(mixed, face)
    with pytest.raises(SceneError, match="truth: got the target 'white'"):
        scene_of(rig, make_target("white")).truth()
    with pytest.raises(SceneError, match="no view 'cam2'"):
        real.radiance("crossed", view_name="cam2")
    with pytest.raises(PolarizerError, match="polarizer: got 'cross'"):
        real.radiance("cross")
    with pytest.raises(SceneError, match=r"power of pop 't1': got 1\.5"):
        real.exposure("cam", pops=(Fired(power=1.5),), exposure_s=0.0, seed=0)
    with pytest.raises(PolarizerError, match=r"light_extinction: got 1\.0"):
        Polarizers(1.0, 2.0, 0.0)


def test_white_reference_has_level_under_led(rig):
    """Expected: the same strongest level as under the flash, in the channel of the LED."""
    scene = scene_of(rig, make_target("white"), films=IDEAL_POLARIZERS, optics=False)
    for led, channel in (("LED-450-20", 2), ("LED-600-20", 0)):
        light = scene.under(led).radiance("crossed")
        middle = light[light.shape[0] // 2, light.shape[1] // 2]
        assert middle.argmax() == channel
        assert middle.max() == pytest.approx(0.99 * METERING_LEVEL, rel=0.01)


def test_led_light_depends_more_on_oxygenation(rig, face):
    """Expected: 30 points of oxygenation change light at 600 nm five times as much as green."""
    tissue = dataclasses.replace(face.tissue, oxygenation=0.45)
    deoxygenated = dataclasses.replace(face, tissue=tissue)
    change = {}
    small = rig.resized(WIDTH // 2)
    for led in ("", "LED-600-20"):
        pair = [
            scene_of(small, one, films=IDEAL_POLARIZERS, lateral=False, optics=False).under(led)
            for one in (face, deoxygenated)
        ]
        mask = pair[0].truth()["mask"]
        one, other = (scene.radiance("crossed")[mask] for scene in pair)
        channel = 0 if led else 1  # red of the LED, green of the flash
        change[led] = abs(np.log(other[:, channel] / one[:, channel]).mean())
    assert change["LED-600-20"] > 5.0 * change[""]
    assert change["LED-600-20"] > 0.03
