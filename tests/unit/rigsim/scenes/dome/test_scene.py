"""The dome's pictures: unit of light, geometry, exposures, motion."""

import dataclasses
import math
from functools import partial

import numpy as np
import pytest

from capture.rig import Rig, load_rig
from rigsim.as_built.dome import ActualDome, DomeTolerances, build_dome, distort
from rigsim.light import olat
from rigsim.light.led_light import DOME_METER_RATE_PER_S
from rigsim.mitsuba.variant import VariantChoice, choose_variant
from rigsim.needs.effects import SceneEffects
from rigsim.scenes.dome.scene import DomeScene
from rigsim.scenes.exposing import SceneError
from rigsim.subject.head_motion import HeadMotionError, draw_head_motion
from rigsim.subject.person import make_subject
from rigsim.targets.flat import make_target

pytestmark = pytest.mark.render


@dataclasses.dataclass(frozen=True)
class Pulse:
    led: int
    level: float
    t_on_s: float
    t_off_s: float


direct = partial(DomeScene, effects=SceneEffects(lateral=False, interreflections=False))


@pytest.fixture(scope="module")
def rig() -> Rig:
    """One frontal camera, LEDs in front, at both sides, above and behind."""
    dome = load_rig("dome")
    places = {
        "front": (0.0, 0.0, 700.0),
        "right": (600.0, 0.0, 360.0),
        "left": (-600.0, 0.0, 360.0),
        "top": (0.0, 600.0, 360.0),
        "back": (0.0, 0.0, -700.0),
    }
    lights = tuple(
        dataclasses.replace(dome.lights[0], name=name, position_mm=place)
        for name, place in places.items()
    )
    view = dataclasses.replace(dome.views[0], name="C", position_mm=(0.0, 0.0, 800.0))
    return dataclasses.replace(dome, lights=lights, views=(view,)).resized(96)


@pytest.fixture(scope="module")
def face():
    return make_subject("III", seed=1, size=128)


@pytest.fixture(scope="module")
def scene(rig, face):
    return direct(rig, face)


@pytest.fixture(scope="module")
def white(rig):
    return direct(rig, make_target("white"))


def test_white_reference_follows_intensity_lobe_cosine_and_distance(rig, white):
    """Closed form at each pixel's centre; tolerance: the pixel's size of 3 mm."""
    images = white.radiance("C")
    assert np.ptp(images[0]) > 0.05 * images[0].max()  # lobe and distance matter
    view = rig.views[0]
    step = view.field_mm[0] / view.width_px
    x = (np.arange(view.width_px) - 0.5 * (view.width_px - 1)) * step
    y = -(np.arange(view.height_px) - 0.5 * (view.height_px - 1)) * step
    points = np.stack(np.broadcast_arrays(x[None, :], y[:, None], np.zeros((1, 1))), axis=-1)
    for k, light in enumerate(rig.lights[:4]):
        place = np.array(light.position_mm)
        way = place - points
        distance = np.linalg.norm(way, axis=-1)
        cosine = way[..., 2] / distance
        off = np.arccos(np.clip(way @ place / distance / np.linalg.norm(place), -1.0, 1.0))
        lobe = np.vectorize(light.intensity)(off)
        expected = 0.99 * (lobe * cosine / distance**2)[..., None] * white.intensity(k)
        np.testing.assert_allclose(images[k], expected, rtol=2e-3)
    assert not images[4].any()  # it shines on the tile's back


def test_white_reference_facing_meter_led_gets_meter_rate(white):
    image = white.radiance("C", [0])[0]
    middle = image[image.shape[0] // 2, image.shape[1] // 2]
    assert middle.max() == pytest.approx(0.99 * DOME_METER_RATE_PER_S, rel=1e-3)
    np.testing.assert_allclose(middle / middle.max(), white.white_rgb(), rtol=1e-5)


def test_actual_dome_has_own_gains_dead_lights_wires(rig, white):
    axes = np.array([-np.array(light.position_mm) for light in rig.lights])
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    built = ActualDome(
        rig, rig, axes, gain={"C": 0.5}, dead=frozenset({"top"}), wiring=(1, 0, 2, 3, 4)
    )
    scene = direct(rig, make_target("white"), dome=built)
    every, plain = scene.radiance("C"), white.radiance("C")
    np.testing.assert_allclose(every[:3], 0.5 * plain[:3], rtol=1e-6)
    assert not every[3].any()
    crossed = scene.exposure("C", pops=[Pulse(0, 1.0, 0.0, 0.03)], exposure_s=0.1, seed=1)
    straight = white.exposure("C", pops=[Pulse(1, 0.5, 0.0, 0.03)], exposure_s=0.1, seed=1)
    assert (crossed.mean() - 64.0) / (straight.mean() - 64.0) == pytest.approx(1.0, rel=0.01)


@pytest.mark.parametrize("subject", ["face", "white"])
def test_lights_in_groups_expose_as_single_ones(rig, face, tmp_path, monkeypatch, subject):
    """Bit for bit: with all effects, of one light, of crossed wires, and ahead of requests."""
    seen = face if subject == "face" else make_target("white")
    axes = np.array([-np.array(light.position_mm) for light in rig.lights])
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    built = ActualDome(rig, rig, axes, dead=frozenset({"top"}), wiring=(1, 0, 2, 3, 4))
    scenes = [DomeScene(rig, seen, dome=built, seed=2) for _ in range(3)]
    scenes[1].expect_requests([("C", channel) for channel in range(5)])
    scenes[2].expect_requests([("C", channel) for channel in (4, 2, 0)])

    def frames(scene: DomeScene) -> list[np.ndarray]:
        pulses = [[Pulse(k, 1.0, 0.0, 0.03)] for k in range(5)]
        pulses.append([pulse for one in pulses for pulse in one])
        return [
            scene.exposure("C", pops=pops, exposure_s=0.1, seed=n) for n, pops in enumerate(pulses)
        ]

    single, grouped = frames(scenes[0]), frames(scenes[1])
    monkeypatch.setattr("rigsim.scenes.dome.images.IMAGE_CACHE_BYTES", 1)
    with scenes[2].images.render_ahead(tmp_path, 10**7):
        ahead = frames(scenes[2])
    assert np.ptp(single[0]) > 100
    for one, two, three in zip(single, grouped, ahead, strict=True):
        assert np.array_equal(one, two)
        assert np.array_equal(one, three)


def test_distorted_image_shows_points_at_lens_projection(rig, face):
    """Tolerance: the middle of what a pixel of 3 mm covers, and rows kept as float32."""
    built = build_dome(rig, seed=2, tolerances=DomeTolerances(distortion=0.2))
    scene = direct(rig, face, dome=built)
    truth, view = scene.truth(), built.rig.views[0]
    rows, columns = np.nonzero(truth["mask"])
    offset = truth["position_mm"][rows, columns] - np.array(view.position_mm)
    right, up, back = (np.array(axis) for axis in view.axes)
    slopes = np.stack([offset @ right, -(offset @ up)], axis=-1) / -(offset @ back)[:, None]

    def miss(distortion):
        middle = np.array([(view.width_px - 1) / 2, (view.height_px - 1) / 2])
        px = distort(slopes, distortion) * view.focal_px + middle
        return np.abs(px - np.stack([columns, rows], axis=-1)).max()

    assert miss(built.distortion["C"]) < 0.02
    assert miss(np.zeros(5)) > 0.1


def test_light_direction_brightens_matching_side_of_image(scene):
    front, right, left, top, back = scene.radiance("C").sum(axis=-1)
    half = right.shape[1] // 2
    assert right[:, half:].sum() > 3.0 * right[:, :half].sum()
    assert left[:, :half].sum() > 3.0 * left[:, half:].sum()
    rows = np.arange(top.shape[0])[:, None]
    assert (rows * top).sum() / top.sum() < (rows * front).sum() / front.sum() - 2.0
    assert back.sum() < 0.2 * front.sum()


def test_one_light_at_a_time_matches_single_light(scene):
    every = scene.radiance("C")
    for k in (3, 0):
        np.testing.assert_array_equal(scene.radiance("C", [k])[0], every[k])
    assert np.isfinite(every).all()
    assert every.min() == 0.0


def test_truth_maps_reproduce_frontal_image_of_matte_face(scene, rig):
    """pi f_r from `brdf` at each pixel's truth, times the light there, is the image."""
    truth = scene.truth()
    image = scene.radiance("C", [0])[0]
    mask = truth["mask"]
    position = truth["position_mm"][mask].astype(np.float64)
    normal = truth["normals"][mask]
    place = np.array(rig.lights[0].position_mm)
    way = place - position
    distance = np.linalg.norm(way, axis=-1, keepdims=True)
    way /= distance
    eye = np.array(rig.views[0].position_mm) - position
    eye /= np.linalg.norm(eye, axis=-1, keepdims=True)
    total, specular = scene.brdf(truth["uv"][mask], way, eye)
    cosine = np.sum(normal * way, axis=-1)
    off = np.arccos(np.clip(way @ place / np.linalg.norm(place), -1.0, 1.0))
    lobe = np.vectorize(rig.lights[0].intensity)(off)
    expected = math.pi * total * (lobe * cosine / distance[:, 0] ** 2)[:, None]
    expected *= scene.intensity(0)
    flat = cosine > 0.7
    ratio = image[mask][flat] / expected[flat]
    assert np.median(ratio) == pytest.approx(1.0, abs=5e-3)
    assert np.percentile(np.abs(ratio - 1.0), 80) < 0.06  # pixels of 3 mm average over relief
    assert (specular[flat] > 0.0).all()


def test_truth_on_the_texture_is_complete_and_simulated(scene, face):
    appearance = scene.truth_appearance()
    assert appearance.source == "simulated"
    assert set(appearance.maps) >= {"position", "normals", "r_d", "roughness", "oil", "fuzz"}
    r_d = appearance.maps["r_d"]
    assert r_d.values.shape == (128, 128, 3)
    assert r_d.valid is not None
    assert r_d.valid.mean() > 0.5
    floor = appearance.maps["r_d_floor"].values[r_d.valid]
    assert np.percentile(floor / r_d.values[r_d.valid].min(axis=-1), 99) < 0.03


def test_exposures_add_in_on_time_and_level(scene):
    """Expected electrons: one pulse of 20 ms is two of 10 ms, or one of 40 ms at half level.

    Statistics: mean of about 3000 lit pixels with shot noise below 5 %, and 0.1 % of power
    deviation a pulse; 5 standard deviations of the ratio, false alarm below 1e-6.
    """

    def mean(*pulses):
        frame = scene.exposure("C", pops=pulses, exposure_s=0.05, seed=4).astype(float) - 64.0
        return frame.sum()

    whole = mean(Pulse(0, 1.0, 0.0, 0.02))
    dark = mean()
    halves = mean(Pulse(0, 1.0, 0.0, 0.01), Pulse(0, 1.0, 0.03, 0.04))
    dim = mean(Pulse(0, 0.5, 0.0, 0.04))
    half = mean(Pulse(0, 1.0, 0.0, 0.01))
    bound = 5.0 * math.sqrt(2.0) * (0.001 + 0.05 / math.sqrt(3000.0))
    assert (halves - dark) / (whole - dark) == pytest.approx(1.0, abs=bound)
    assert (dim - dark) / (whole - dark) == pytest.approx(1.0, abs=bound)
    assert (half - dark) / (whole - dark) == pytest.approx(0.5, abs=bound)


def test_both_exposures_of_light_share_same_radiance(scene):
    """Noise aside, 120 ms hold four times the light of 30 ms at every pixel."""

    def mean_frame(on_s):
        pulse = [Pulse(0, 1.0, 0.0, on_s)]
        seeds = range(8)
        frames = [scene.exposure("C", pops=pulse, exposure_s=0.2, seed=s) for s in seeds]
        return np.mean(frames, axis=0) - 64.0

    long, short = mean_frame(0.12), mean_frame(0.03)
    bright = (long > 400.0) & (long < 3800.0)
    assert bright.sum() > 500
    assert np.median(long[bright] / short[bright]) == pytest.approx(4.0, rel=0.01)


def test_missing_pulse_gives_dark_frame_reproducible_by_seed(scene):
    dark = scene.exposure("C", pops=[], exposure_s=0.05, seed=0)
    assert dark.mean() == pytest.approx(64.0, abs=0.5)
    pulse = [Pulse(2, 1.0, 0.0, 0.03)]
    again = [scene.exposure("C", pops=pulse, exposure_s=0.05, seed=s) for s in (1, 1, 2)]
    np.testing.assert_array_equal(again[0], again[1])
    assert (again[0] != again[2]).any()


def test_subpixels_change_edges_only(rig, face, scene):
    fine = direct(rig, face, subpixels=4).radiance("C", [0])[0]
    coarse = scene.radiance("C", [0])[0]
    assert fine.sum() == pytest.approx(coarse.sum(), rel=5e-3)


def test_head_matches_its_mesh_at_time_zero(rig, face, scene):
    moving = direct(rig, face, motion=draw_head_motion(3))
    np.testing.assert_array_equal(moving.radiance("C", [0]), scene.radiance("C", [0]))
    assert (moving.radiance("C", [0], t_s=9.0) != scene.radiance("C", [0])).any()


@pytest.mark.parametrize("seed", range(5))
def test_drift_and_rotation_reach_drawn_sizes_smoothly(seed):
    motion = draw_head_motion(seed, drift_mm=2.0, drift_deg=0.5)
    t = np.linspace(0.0, 25.0, 2001)
    poses = [motion.pose(float(x)) for x in t]
    pivot = np.array([0.0, 0.0, -70.0])
    shift = np.array([r @ pivot + s - pivot for r, s in poses])
    turn = [math.acos(min(1.0, 0.5 * (np.trace(r) - 1.0))) for r, _ in poses]
    assert np.linalg.norm(shift, axis=1).max() == pytest.approx(2.0, rel=0.02)
    assert math.degrees(max(turn)) == pytest.approx(0.5, rel=0.02)
    assert np.linalg.norm(np.diff(shift, axis=0), axis=1).max() < 0.12  # mm in 12.5 ms
    np.testing.assert_allclose(motion.pose(0.0)[0], np.eye(3), atol=1e-12)


def test_shifted_head_equals_still_head_in_shifted_rig(rig, face):
    """Moving the head by s is moving camera and lights by -s, apart from where LEDs point."""
    motion = draw_head_motion(3, drift_mm=3.0, drift_deg=1.0, twitch=False)
    rotation, shift = motion.pose(7.0)
    moved = direct(rig, face, motion=motion).radiance("C", [0, 1], t_s=7.0)

    def carried(place, *, point=True):
        offset = shift if point else 0.0
        return tuple(float(v) for v in (np.array(place) - offset) @ rotation)

    view = rig.views[0]
    view = dataclasses.replace(
        view,
        position_mm=carried(view.position_mm),
        target_mm=carried(view.target_mm),
        up=carried(view.up, point=False),
    )
    lights = tuple(
        dataclasses.replace(light, position_mm=carried(light.position_mm)) for light in rig.lights
    )
    other = dataclasses.replace(rig, views=(view,), lights=lights)
    still = direct(other, face).radiance("C", [0, 1])
    # The LED's axis is towards the origin, which the head has left by 3 mm: 0.25 degrees.
    assert moved.sum() == pytest.approx(still.sum(), rel=3e-3)
    bright = still > 0.2 * still.max()
    assert np.percentile(np.abs(moved[bright] / still[bright] - 1.0), 95) < 0.03


def test_twitch_moves_only_mouth_for_half_a_second(rig, face, scene):
    motion = draw_head_motion(3, drift_mm=0.0, drift_deg=0.0)
    start = motion.twitch_start_s
    assert motion.twitch_amount(start) == motion.twitch_amount(start + 0.51) == 0.0
    assert motion.twitch_amount(start + 0.25) == pytest.approx(1.0)
    moving = direct(rig, face, motion=motion)
    rest = scene.radiance("C", [0])[0]
    np.testing.assert_array_equal(moving.radiance("C", [0], t_s=start - 0.01)[0], rest)
    image = moving.radiance("C", [0], t_s=start + 0.25)[0]
    changed = np.abs(image - rest).sum(axis=-1) > 0.02 * rest.max()
    assert changed.any()
    # A few rays that graze lids and nose meet the rebuilt mesh a little elsewhere.
    position = scene.truth()["position_mm"]
    corner = np.array([-25.0 if motion.twitch_side == "left" else 25.0, -42.0, 0.0])
    near = np.linalg.norm(position - corner, axis=-1) < 45.0
    change = np.abs(image - rest).sum(axis=-1)
    assert change[near].sum() > 20.0 * change[~near].sum()


def test_target_stays_in_place(rig, white):
    moving = direct(rig, make_target("white"), motion=draw_head_motion(1))
    np.testing.assert_array_equal(moving.radiance("C", [1], t_s=5.0), white.radiance("C", [1]))
    assert not direct(rig, make_target("dark")).radiance("C", [0]).any()


@pytest.mark.long
def test_vectorized_and_scalar_kernels_agree(rig, face, scene):
    """Two codes of one formula, two ray tracers; float32 against float64, and rays at edges."""
    if not choose_variant("rgb").is_vectorized:
        pytest.skip("no LLVM: there is one kernel only")
    plain = direct(rig, face, choice=VariantChoice("scalar_rgb", "asked for by the test", ""))
    for light in (0, 1, 3):
        one, two = scene.radiance("C", [light])[0], plain.radiance("C", [light])[0]
        assert one.sum() == pytest.approx(two.sum(), rel=2e-3)
        agree = np.abs(one - two) < 1e-4 * two.max()
        assert agree.mean() > 0.995


def test_both_kernels_agree_on_skin_under_a_coating(rig, face):
    """A film over the oil and grains over both, by two codes of one formula."""
    if not choose_variant("rgb").is_vectorized:
        pytest.skip("no LLVM: there is one kernel only")
    on = {"lotion": 0.8, "powder": 0.5}
    plain = VariantChoice("scalar_rgb", "asked for by the test", "")
    scenes = [direct(rig, face, conditions=on, choice=c) for c in (None, plain)]
    bare = direct(rig, face)
    for light in (0, 3):
        one, two = (scene.radiance("C", [light])[0] for scene in scenes)
        assert one.sum() == pytest.approx(two.sum(), rel=2e-3)
        assert (np.abs(one - two) < 1e-4 * two.max()).mean() > 0.995
        assert np.abs(one - bare.radiance("C", [light])[0]).max() > 0.05 * one.max()


def test_a_condition_is_in_the_truth(rig, face):
    scene = direct(rig, face, conditions={"sweat": 0.5})
    truth, maps = scene.truth(), scene.truth_appearance()
    inside = truth["mask"]
    np.testing.assert_allclose(truth["film_eta"][inside], 1.333, atol=2e-3)
    assert 0.05 < truth["film"][inside].mean() < 0.5
    assert {"film", "film_alpha", "film_eta", "powder"} <= set(maps.maps)
    assert maps.parameters["conditions"] == {"sweat": 0.5}
    uv = truth["uv"][inside][::50]
    up = truth["normals"][inside][::50]
    total, specular = scene.brdf(uv, up, up)
    assert np.all(total[:, 0] > specular)
    with pytest.raises(SceneError, match="conditions: got hot"):
        direct(rig, make_target("white"), conditions={"hot": 1.0})


def test_impossible_scene_requests_are_refused(rig, face, scene):
    with pytest.raises(SceneError, match="expected an LED"):
        direct(load_rig("flash").resized(64), face)
    with pytest.raises(SceneError, match="light: got 9"):
        scene.radiance("C", [9])
    with pytest.raises(SceneError, match="'X'"):
        scene.radiance("X")
    with pytest.raises(SceneError, match="level of LED 0"):
        scene.exposure("C", pops=[Pulse(0, 1.5, 0.0, 0.01)], exposure_s=0.1, seed=0)
    with pytest.raises(SceneError, match="end after"):
        scene.exposure("C", pops=[Pulse(0, 1.0, 0.02, 0.01)], exposure_s=0.1, seed=0)
    with pytest.raises(SceneError, match="expected a face"):
        direct(rig, make_target("white")).truth()
    with pytest.raises(SceneError, match="subpixels"):
        direct(rig, face, subpixels=0)
    with pytest.raises(HeadMotionError, match="drift_mm"):
        draw_head_motion(0, drift_mm=50.0)


def test_omitted_effects_are_named_and_built_are_not(rig, face, scene):
    names = {name for name, _ in scene.omitted}
    assert {"interreflection", "movement of the head"} <= names
    moving = {name for name, _ in direct(rig, face, motion=draw_head_motion(0)).omitted}
    assert "movement of the head" not in moving


def test_rows_keep_their_surface_within_a_thousandth(rng):
    values = rng.uniform(size=(1000, 7)).astype(np.float32)
    values *= np.array([1, 1, 1, 0.5, 0.6, 0.003, 1], np.float32)
    values[:, :3] = np.maximum(values[:, :3], 0.02)
    again = olat.unpack_surface(olat.pack_surface(values))
    np.testing.assert_allclose(again, values, rtol=1e-3, atol=1e-5)
    with pytest.raises(ValueError, match="negative"):
        olat.pack_surface(-values)
    with pytest.raises(ValueError, match="at most 1"):
        olat.pack_surface(values + 1.0)
