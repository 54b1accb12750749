"""The plugins `skincoat`, `ledarray`, `rigcamera` and `olat` by Mitsuba's own kinds of test."""

import subprocess
import sys

import numpy as np
import pytest

from capture.rig import load_rig
from rigsim.light import surface_brdf
from rigsim.mitsuba.led_array import LED_COLUMNS, led_table
from rigsim.mitsuba.rig_camera import describe_camera
from rigsim.mitsuba.scene_radiance import load_description
from rigsim.mitsuba.startup import load_mitsuba
from rigsim.mitsuba.variant import choose_variant
from rigsim.render import camera_rays

pytestmark = pytest.mark.render

COATED = {"film": 0.5, "film_alpha": 0.2, "film_ior": 1.5, "powder": 0.2}
SKIN = {"type": "skincoat", "alpha": 0.3, "oil": 0.3, "vellus": 0.001, "bare": 0.9}
FALSE_ALARM = 1e-3


@pytest.fixture(scope="module")
def mi():
    choice = choose_variant("rgb")
    if not choice.is_vectorized:
        pytest.skip("no LLVM: the plugins need a vectorized variant")
    return load_mitsuba(choice)


@pytest.fixture(autouse=True)
def active_variant(mi):
    """Restore the process's variant, which other tests change."""
    load_mitsuba(choose_variant("rgb"))


def skin(mi, *, rgb=(0.6, 0.5, 0.4), **changes):
    description = SKIN | {"r_d": {"type": "rgb", "value": list(rgb)}} | changes
    return load_description(mi, description)


def point(mi, count, theta_deg, normal=(0.0, 0.0, 1.0)):
    """Surface points that a camera sees at an angle."""
    import drjit as dr

    si = dr.zeros(mi.SurfaceInteraction3f, count)
    si.sh_frame = mi.Frame3f(mi.Normal3f(*normal))
    si.n = mi.Normal3f(*normal)
    angle = np.radians(theta_deg)
    si.wi = mi.Vector3f(float(np.sin(angle)), 0.0, float(np.cos(angle)))
    return si


def chi_square(mi, sampled, evaluated, theta_deg, tests):
    """Whether samples of one BSDF have the density of another."""
    import drjit as dr
    from mitsuba import chi2

    context = mi.BSDFContext()

    def sample(numbers):
        si = point(mi, dr.width(numbers[0]), theta_deg)
        out, weight = sampled.sample(context, si, numbers[0], [numbers[1], numbers[2]])
        return out.wo, dr.select(dr.any(weight != 0.0), 1.0, 0.0)

    def density(direction):
        return evaluated.pdf(context, point(mi, dr.width(direction), theta_deg), direction)

    test = chi2.ChiSquareTest(
        domain=chi2.SphericalDomain(),
        sample_func=sample,
        pdf_func=density,
        sample_dim=3,
        sample_count=400_000,
        res=51,
        ires=16,
    )
    return test.run(FALSE_ALARM, tests)


@pytest.mark.parametrize("coating", [{}, COATED], ids=["bare", "coated"])
def test_samples_of_skin_have_its_density(mi, coating, tmp_path, monkeypatch):
    """Rationale: chi-square of 400,000 samples. False alarm: 1e-3 for all angles together."""
    monkeypatch.chdir(tmp_path)  # a failing chi-square writes its histograms there
    bsdf = skin(mi, **coating)
    assert all(chi_square(mi, bsdf, bsdf, theta, 3) for theta in (0.0, 40.0, 75.0))
    rougher = skin(mi, **coating, alpha=0.33)
    assert not chi_square(mi, rougher, bsdf, 40.0, 1)


@pytest.mark.parametrize("coating", [{}, COATED], ids=["bare", "coated"])
def test_skin_reflects_the_same_both_ways(mi, coating):
    bsdf, context = skin(mi, **coating), mi.BSDFContext()
    rng = np.random.default_rng(1)
    way = rng.standard_normal((2, 3, 500)).astype(np.float32)
    way[:, 2] = np.abs(way[:, 2]) + 0.05
    one, two = (mi.Vector3f(*(w / np.linalg.norm(w, axis=0))) for w in way)
    forth, back = point(mi, 500, 0.0), point(mi, 500, 0.0)
    forth.wi, back.wi = one, two
    there = np.array(bsdf.eval(context, forth, two)) / np.array(two.z)
    here = np.array(bsdf.eval(context, back, one)) / np.array(one.z)
    np.testing.assert_allclose(there, here, rtol=2e-5)
    assert np.abs(there[0] - there[2]).max() > 0.01  # colors differ, so the test can fail


@pytest.mark.parametrize("coating", [{}, COATED], ids=["bare", "coated"])
def test_evaluation_equals_the_compiled_loops(mi, coating):
    """Two codes of the same published formulas, float32 against float64."""
    rng = np.random.default_rng(2)
    way = rng.standard_normal((2, 400, 3)).astype(np.float32)
    way[..., 2] = np.abs(way[..., 2]) + 0.05
    way /= np.linalg.norm(way, axis=-1, keepdims=True)
    rows = [0.6, 0.5, 0.4, 0.3, 0.3, 0.001, 0.9, *coating.values()]
    total, specular = surface_brdf.evaluate_brdf(rows, [0.0, 0.0, 1.0], way[0], way[1])
    si = point(mi, 400, 0.0)
    si.wi = mi.Vector3f(*way[1].T)
    found = skin(mi, **coating).eval(mi.BSDFContext(), si, mi.Vector3f(*way[0].T))
    np.testing.assert_allclose(np.array(found).T / way[0][:, 2:], total, rtol=1e-4)
    assert (specular / total[:, 0]).max() > 0.1


def test_skin_of_reflectance_one_gains_no_light(mi):
    """Rationale: white furnace. An inner albedo of 1 returns the light that enters and comes back
    to the boundary once; facets whose neighbors shadow them lose the rest."""
    import drjit as dr

    white = skin(mi, rgb=(1.0, 1.0, 1.0), vellus=0.0, bare=1.0)
    for theta in (0.0, 30.0, 60.0, 80.0):
        si = point(mi, 1 << 20, theta)
        numbers = mi.PCG32(size=1 << 20)
        one, two, three = (numbers.next_float32() for _ in range(3))
        _, weight = white.sample(mi.BSDFContext(), si, one, mi.Point2f(two, three))
        mean = float(dr.mean(weight[0])[0])
        spread = float(dr.sqrt(dr.mean(dr.square(weight[0] - mean)))[0]) / 1024.0
        assert 0.6 < mean < 1.0 + 4.0 * spread


def test_a_parameter_above_its_range_is_refused(mi):
    scene = load_description(mi, ball({"r_d": {"type": "rgb", "value": [2.0] * 3}}))
    with pytest.raises(ValueError, match=r"skincoat: got r_d above 1\.25"):
        mi.load_dict({"type": "olat"}).trace(scene, scene.sensors()[0])


# lights and cameras -----------------------------------------------------------------------------

LEDS = {
    "position_mm": [[0.0, 0.0, 500.0], [300.0, 0.0, 300.0]],
    "axis": [[0.0, 0.0, -1.0], [-np.sqrt(0.5), 0.0, -np.sqrt(0.5)]],
}


def ball(skin_changes=None, **entries):
    view = load_rig("flash").resized(48).view("cam")
    camera = describe_camera(view)
    return {
        "type": "scene",
        "integrator": {"type": "direct", "emitter_samples": 1, "bsdf_samples": 0},
        "sensor": camera,
        "leds": {"type": "ledarray", "table": led_table(**LEDS, intensity=1e5)},
        "ball": {"type": "sphere", "radius": 90.0, "bsdf": SKIN | (skin_changes or {"r_d": 0.5})},
    } | entries


def test_leds_without_lobe_are_point_lights(mi):
    points = {
        f"light {k}": {"type": "point", "position": place, "intensity": 1e5}
        for k, place in enumerate(LEDS["position_mm"])
    }
    stock = {k: v for k, v in ball(**points).items() if k != "leds"}
    leds, theirs = (
        np.array(mi.render(load_description(mi, scene), spp=4096)) for scene in (ball(), stock)
    )
    assert leds.mean() == pytest.approx(theirs.mean(), rel=1e-3)
    assert theirs.mean() > 0.0


def test_lobe_and_level_scale_an_led(mi):
    """One LED seen from a point at 30 degrees off its axis."""
    si = point(mi, 1, 0.0)
    si.p = mi.Point3f(500.0 * float(np.tan(np.radians(30.0))), 0.0, 0.0)

    def light(**settings):
        table = led_table(LEDS["position_mm"][:1], LEDS["axis"][:1], **settings)
        emitter = load_description(mi, {"type": "ledarray", "table": table})
        found, weight = emitter.sample_direction(si, mi.Point2f(0.3, 0.4))
        return float(weight[0][0]), float(found.dist[0])

    even, distance = light()
    assert even == pytest.approx(1.0 / distance**2, rel=1e-5)
    assert light(exponent=3.0)[0] == pytest.approx(even * np.cos(np.radians(30.0)) ** 3, rel=1e-4)
    assert light(level=0.25)[0] == pytest.approx(0.25 * even, rel=1e-5)
    assert light(level=0.0)[0] == 0.0


def test_changed_levels_change_the_light(mi):
    """Both ways to the light: each LED for `olat`, and samples for stock integrators."""
    scene = load_description(mi, ball())
    olat = mi.load_dict({"type": "olat", "subpixels": 2})
    before = [np.array(mi.render(scene, integrator=olat)), np.array(mi.render(scene, spp=256))]
    parameters = mi.traverse(scene)
    parameters["leds.level"] = mi.Float([0.5, 0.5])
    parameters.update()
    after = [np.array(mi.render(scene, integrator=olat)), np.array(mi.render(scene, spp=256))]
    for full, half in zip(before, after, strict=True):
        np.testing.assert_allclose(half, 0.5 * full, rtol=1e-5)
        assert full.max() > 0.0


def test_leds_load_from_a_file(mi, tmp_path):
    path = tmp_path / "lights.csv"
    table = led_table(**LEDS, exponent=[1.0, 2.0])
    np.savetxt(path, table, delimiter=",", header=",".join(LED_COLUMNS), comments="")
    named = f'<string name="filename" value="{path}"/>'
    described = f'<emitter version="3.0.0" type="ledarray">{named}</emitter>'
    emitter = mi.load_string(described)
    np.testing.assert_allclose(emitter.table, table, rtol=1e-5)
    path.write_text(path.read_text().replace("-1.0", "-3.0"))
    with pytest.raises(RuntimeError, match=r"axes of length"):
        mi.load_string(described)


@pytest.mark.parametrize("bent", [None, (-0.12, 0.05, 1e-3, -2e-3, 0.01)], ids=["pinhole", "lens"])
def test_camera_casts_the_rays_of_the_rig(mi, bent):
    """Rationale: the inverse distortion by fixed points against Newton's method. Tolerance: a
    hundredth of a pixel."""
    view = load_rig("dome").resized(64).view("C03")
    _, expected = camera_rays(view, distortion=bent)
    sensor = load_description(mi, describe_camera(view, bent))
    y, x = np.mgrid[0 : view.height_px, 0 : view.width_px] + 0.5
    place = mi.Point2f(
        (x.ravel() / view.width_px).astype(np.float32),
        (y.ravel() / view.height_px).astype(np.float32),
    )
    ray, _ = sensor.sample_ray(0.0, 0.5, place, mi.Point2f(0.5))
    error = np.linalg.norm(np.array(ray.d).T - expected.reshape(-1, 3), axis=1)
    assert error.max() * view.focal_px < 0.01
    straight = camera_rays(view)[1].reshape(-1, 3)
    moved = np.linalg.norm(np.array(ray.d).T - straight, axis=1).max() * view.focal_px
    assert (moved > 0.1) == (bent is not None)


def test_bands_of_unequal_size_are_traced(mi, monkeypatch):
    """Cameras of the dome, some along an axis, with a last band of fewer rows."""
    rig = load_rig("dome").resized(32)
    scene = load_description(mi, {k: v for k, v in ball().items() if k != "sensor"})
    whole, parts = (mi.load_dict({"type": "olat", "subpixels": 2}) for _ in range(2))
    for view in rig.views:
        sensor = load_description(mi, describe_camera(view))
        expected = whole.trace(scene, sensor).count
        with monkeypatch.context() as patch:
            patch.setattr("rigsim.mitsuba.olat.RAYS_PER_BAND", 7 * 4 * view.width_px)
            found = parts.trace(scene, sensor)
        assert found.count == expected > 0
        assert len(found.bands) > 1


# integrator -------------------------------------------------------------------------------------

BLOCKER = {"type": "sphere", "radius": 25.0, "center": [40.0, 20.0, 110.0]}
SEVERAL = {"blocker": BLOCKER | {"bsdf": {"type": "diffuse"}}}


@pytest.mark.long
def test_sum_over_lights_is_the_path_tracers(mi):
    """Rationale: light, shadow and two BSDFs. Tolerance: 3 standard errors of 32 runs in 98 % of
    the pixels inside the surfaces, where 99.5 % are expected (Student's t)."""
    entries = SEVERAL | {"integrator": {"type": "path", "max_depth": 2}}
    scene = load_description(mi, ball(**entries))
    runs = np.stack([np.array(mi.render(scene, spp=256, seed=k)) for k in range(32)])
    mean, error = runs.mean(axis=0), runs.std(axis=0, ddof=1) / np.sqrt(32)
    ours = np.array(mi.render(scene, integrator=mi.load_dict({"type": "olat", "subpixels": 16})))
    inner = mean.min(axis=2) > 0.0
    z = np.abs(ours - mean)[inner] / np.maximum(error, 2e-4 * mean)[inner]
    assert (z < 3.0).mean() > 0.98
    brighter = np.abs(1.01 * ours - mean)[inner] / np.maximum(error, 2e-4 * mean)[inner]
    assert (brighter < 3.0).mean() < 0.95


def test_each_streamed_image_is_one_light(mi):
    scene = load_description(mi, ball(**SEVERAL))
    integrator = mi.load_dict({"type": "olat", "subpixels": 2})
    images = dict(integrator.stream(scene, scene.sensors()[0]))
    total = np.array(mi.render(scene, integrator=integrator))
    assert list(images) == [0, 1]
    np.testing.assert_allclose(images[0] + images[1], total, rtol=1e-6)
    assert np.abs(images[0] - images[1]).max() > 0.1 * total.max()


def test_analyzers_across_each_other_add_up(mi):
    """Rationale: two ideal analyzers at 90 degrees transmit all light. Tolerance: across a ray at
    an angle a off the axis, their axes are within a^2 / 2 of 90 degrees. The first blocks most of
    the reflection of LEDs whose polarizers cross it."""
    table = led_table(**LEDS, intensity=1e5, absorbs=[[0.0, 1.0, 0.0]] * 2, leak=0.01)
    leds = {"type": "ledarray", "table": table}
    scene = load_description(mi, ball({"r_d": 0.0}, leds=leds))
    crossed, parallel = (
        np.array(mi.render(scene, integrator=mi.load_dict({"type": "olat", "analyzer_deg": deg})))
        for deg in (90.0, 0.0)
    )
    leaky = {"type": "olat", "analyzer_deg": 90.0, "analyzer_leak": 1.0}
    total = np.array(mi.render(scene, integrator=mi.load_dict(leaky)))
    view = load_rig("flash").resized(48).view("cam")
    corner = np.hypot(view.width_px, view.height_px) / (2.0 * view.focal_px)
    np.testing.assert_allclose(crossed + parallel, total, rtol=0.5 * corner**2)
    assert corner < 0.3
    assert parallel.max() > 5.0 * crossed.max()


def test_a_scene_without_lights_is_refused(mi):
    scene = load_description(mi, {k: v for k, v in ball().items() if k != "leds"})
    with pytest.raises(ValueError, match="without lights"):
        mi.load_dict({"type": "olat"}).render(scene)


@pytest.mark.parametrize(
    ("variant", "plugin"),
    [
        ("scalar_rgb", {"type": "ledarray"}),
        ("scalar_rgb", {"type": "rigcamera"}),
        ("llvm_ad_mono", {"type": "olat"}),
        ("llvm_ad_spectral", {"type": "ledmoments"}),
        ("llvm_ad_spectral", {"type": "tissue"}),
    ],
)
def test_plugin_in_wrong_variant_is_refused(mi, variant, plugin):
    mi.set_variant(variant)
    with pytest.raises(RuntimeError, match=f"got the variant {variant}, expected a? ?[vl]"):
        mi.load_dict(plugin)


@pytest.mark.parametrize(("name", "value"), [("alpha", -1.0), ("int_ior", 0.5), ("oil", 2)])
def test_skincoat_outside_ranges_is_refused(mi, name, value):
    with pytest.raises(RuntimeError, match=f"skincoat, {name}: got {value:g}, expected"):
        mi.load_dict({"type": "skincoat", name: value})


PLAIN_SCRIPT = """
{imports}
for variant in ("scalar_rgb", "llvm_ad_mono_polarized", "llvm_ad_rgb"):
    mi.set_variant(variant)
    print(mi.load_dict({{"type": "skincoat", "oil": 0.2}}))
print(mi.load_dict({{"type": "tissue"}}).aov_names())
"""

IMPORT_ORDERS = {
    "package first": """
import sys
import rigsim.mitsuba
assert "mitsuba" not in sys.modules
import mitsuba as mi""",
    "Mitsuba first": """
import mitsuba as mi
import rigsim.mitsuba""",
    "after a variant": """
import mitsuba as mi
mi.set_variant("scalar_rgb")
import rigsim.mitsuba""",
}


@pytest.mark.parametrize("order", IMPORT_ORDERS)
def test_plugins_work_in_any_script(mi, order):
    """The package before and after Mitsuba, with variants of each kind."""
    script = PLAIN_SCRIPT.format(imports=IMPORT_ORDERS[order])
    run = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, timeout=120
    )
    assert run.returncode == 0, run.stderr
    assert run.stdout.count("SkinCoat[r_d, alpha, oil, vellus, bare]") == 3
    assert run.stdout.splitlines()[-1].startswith("['subsurface.")
