"""Integrator `tissue` against published values, the photon walk, and Mitsuba's `volpath`.

Every comparison allows 4 standard errors of independent pixels or renders (false alarms: below 2e-4
each by Student's distribution with 63 degrees of freedom). The same comparison with one thing wrong
has to fail.
"""

from dataclasses import replace
from math import inf

import numpy as np
import pytest

from rigsim.geometry.mesh import build_mesh
from rigsim.mitsuba.render_error import RenderError
from rigsim.mitsuba.scene_radiance import look_at, radiance
from rigsim.mitsuba.startup import load_mitsuba
from rigsim.mitsuba.variant import choose_variant
from rigsim.scenes.reference.flat_layers import (
    describe_boundary,
    describe_flat_layers,
    render_reflectance,
    render_voxels,
)
from rigsim.subject.person_skin import PersonSkin, layers
from rigsim.tissue.tissue_mc import Layer, LayerStack, TransportError, trace_photons

pytestmark = [
    pytest.mark.render,
    pytest.mark.skipif(
        not choose_variant("mono").is_vectorized, reason="Dr.Jit finds no LLVM 17 or newer here"
    ),
]

GIOVANELLI = LayerStack((Layer(inf, 1.0, 9.0, 0.0, 1.5),))
VAN_DE_HULST = LayerStack((Layer(0.2, 1.0, 9.0, 0.75, 1.0),))


def reflects(stack, expected, samples, *, digits=5e-4, **more):
    found = render_reflectance(stack, samples=samples, seed=1, **more)
    assert found.stderr < 0.02 * expected
    return bool(abs(found.reflectance - expected) < 4.0 * found.stderr + digits)


@pytest.mark.long
def test_half_space_matches_giovanelli_uniquely():
    """Expected: Giovanelli 1955 (doi:10.1080/713821040), .2600 with the specular .04."""
    assert reflects(GIOVANELLI, 0.2200, 6144)
    thin = replace(GIOVANELLI.layers[0], eta=1.45)
    assert not reflects(LayerStack((thin,)), 0.2200, 6144)


@pytest.mark.long
def test_matched_slab_matches_van_de_hulst_uniquely():
    """Expected: van de Hulst 1980, table 35, R .09739."""
    assert reflects(VAN_DE_HULST, 0.09739, 16384)
    wide = replace(VAN_DE_HULST.layers[0], g=0.65)
    assert not reflects(LayerStack((wide,)), 0.09739, 16384)


@pytest.mark.long
def test_white_furnace_returns_all_light():
    """Rationale: without absorption all light that enters leaves. Expected: 1 - F(0)."""
    whole = 1.0 - (0.4 / 2.4) ** 2
    white = LayerStack((Layer(0.5, 0.0, 10.0, 0.5, 1.4),), eta_below=1.4)
    assert reflects(white, whole, 2048, floor_reflectance=1.0)
    gray = LayerStack((replace(white.layers[0], sigma_a_per_mm=0.05),), eta_below=1.4)
    assert not reflects(gray, whole, 2048, floor_reflectance=1.0)


def test_layers_reflect_the_same_both_ways():
    """Rationale: reciprocity of light and camera at 0 and 60 degrees, through a smooth boundary."""
    found = []
    for light_deg, camera_deg in ((60.0, 0.0), (0.0, 60.0)):
        scene = describe_flat_layers(GIOVANELLI, light_deg=light_deg)
        angle = np.radians(camera_deg)
        place = 5.0 * np.sin(angle), 0.0, 5.0 * np.cos(angle)
        scene["sensor"]["to_world"] = look_at(place, (0.0, 0.0, 0.0), (0.0, 1.0, 0.0))
        image = render_voxels(scene, samples=2048, seed=1)[..., -1].ravel()
        found.append((image.mean(), image.std(ddof=1) / 8.0, np.cos(np.radians(light_deg))))
    (forth, forth_error, slant), (back, back_error, _) = found
    assert abs(forth / slant - back) < 4.0 * np.hypot(forth_error / slant, back_error)
    assert abs(forth - back) > 4.0 * np.hypot(forth_error, back_error)
    assert back_error < 0.01 * back


@pytest.mark.long
@pytest.mark.parametrize(
    ("preset", "samples", "photons"), [("I", 12288, 1_000_000), ("VI", 32768, 3_000_000)]
)
def test_skin_layers_match_photon_walk(preset, samples, photons):
    """Tolerance: .75 %, three standard errors (.25 %) or more; false alarms below 3e-3.

    A fifth more blood takes 3 to 4 % of the light; a third of the photons show that.
    """
    stack = layers(PersonSkin.of_preset(preset), "cheek", "neutral", 540.0)
    traced = trace_photons(stack, photons=photons, rng=np.random.default_rng(0), threads=2)
    found = render_reflectance(stack, samples=samples, seed=2)
    assert np.hypot(found.stderr, traced.reflectance_stderr) < 0.0025 * traced.reflectance
    assert found.reflectance == pytest.approx(traced.reflectance, rel=0.0075)
    bloody = layers(PersonSkin.of_preset(preset, blood=1.2), "cheek", "neutral", 540.0)
    other = trace_photons(bloody, photons=photons // 3, rng=np.random.default_rng(0), threads=2)
    assert found.reflectance != pytest.approx(other.reflectance, rel=0.0075)


def wavy_mesh(half, amplitude, waves, count=48):
    x = np.linspace(-half, half, count + 1)
    px, py = (part.ravel() for part in np.meshgrid(x, x))
    z = amplitude * np.sin(np.pi * waves * px / half) * np.cos(np.pi * waves * py / half)
    at = np.arange((count + 1) ** 2).reshape(count + 1, count + 1)
    a, b, c, d = (part.ravel() for part in (at[:-1, :-1], at[:-1, 1:], at[1:, 1:], at[1:, :-1]))
    faces = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    uv = 0.5 * (np.column_stack([px, py]) / half + 1.0)
    return build_mesh(np.column_stack([px, py, z]), faces, uv)


def box_of_voxels(
    integrator, *, eta=1.4, alpha=0.5, height=0.0, uneven=False, absorption=1.0, half=3.0
):
    """Random voxels in a black box, under a flat or wavy boundary, lit by two lights."""
    rng = np.random.default_rng(5)
    depth = 2.0
    scattering = np.full((8, 6, 6, 1), 4.0)
    scattering[-1] = 8.0
    if uneven:
        scattering *= rng.uniform(0.5, 1.5, scattering.shape)
    sigma_a = rng.uniform(0.02, 0.4, scattering.shape)
    sigma_a[-1] = rng.choice([0.2, 3.0], sigma_a[-1].shape)
    sigma_a *= absorption
    place = np.diag([2.0 * half, 2.0 * half, depth + 1.5 * height, 1.0])
    place[:3, 3] = -half, -half, -depth

    def volume(values):
        return {"type": "gridvolume", "grid": values, "filter_type": "nearest", "to_world": place}

    sigma_t = scattering + sigma_a
    interior = {
        "type": "heterogeneous",
        "sigma_t": volume(sigma_t),
        "albedo": volume(scattering / sigma_t),
        "phase": {"type": "hg", "g": 0.7},
    }
    skin = {"bsdf": describe_boundary(eta, alpha), "interior": interior}
    if height:
        skin |= {"type": "mesh", "mesh": wavy_mesh(half, height, 4), "face_normals": True}
    else:
        skin |= {"type": "rectangle", "to_world": np.diag([half, half, 1.0, 1.0])}
    walls = {}
    black = {"type": "twosided", "side": {"type": "diffuse", "reflectance": 0.0}}
    for name, axis, sign in (
        ("w", 0, -1),
        ("e", 0, 1),
        ("s", 1, -1),
        ("n", 1, 1),
        ("floor", 2, -1),
    ):
        point = np.array([0.0, 0.0, -0.5 * depth])
        point[axis] = 0.999 * sign * (half if axis < 2 else depth)
        inward = point.copy()
        inward[axis] -= sign
        tall = 0.5 * depth + 1.2 * height if axis < 2 else 1.2 * half
        up = (0.0, 0.0, 1.0) if axis < 2 else (0.0, 1.0, 0.0)
        to_world = look_at(point, inward, up) @ np.diag([1.2 * half, tall, 1.0, 1.0])
        walls[name] = {"type": "rectangle", "to_world": to_world, "bsdf": black}
    flat = describe_flat_layers(VAN_DE_HULST)
    sensor = flat["sensor"] | {
        "type": "perspective",
        "fov": 10.0,
        "to_world": look_at((4.0, -3.0, 30.0), (0.0, 0.0, 0.0), (0.0, 1.0, 0.0)),
    }
    return {
        "type": "scene",
        "integrator": {"type": integrator, "max_depth": -1},
        "sensor": sensor,
        "skin": skin,
        **walls,
        "point": {"type": "point", "position": [10.0, 0.0, 12.0], "intensity": 200.0},
        "sun": {"type": "directional", "direction": [0.5, 0.6, -1.0], "irradiance": 1.0},
    }


def halves(samples, **scene):
    """Means of the image's left and right half with standard errors, of 12 renders."""
    means = [
        render_voxels(box_of_voxels(**scene), samples=samples, seed=seed)[..., 0]
        .reshape(8, 2, 4)
        .mean(axis=(0, 2))
        for seed in range(12)
    ]
    return np.mean(means, axis=0), np.std(means, axis=0, ddof=1) / np.sqrt(12.0)


def agree(ours, peer):
    distance = np.abs(ours[0] - peer[0]) / np.hypot(ours[1], peer[1])
    return bool((distance < 4.5).all())


SCENES = {
    "uneven": ({"eta": 1.0, "uneven": True}, {"eta": 1.0, "uneven": False}, 512),
    "relief": ({"height": 0.1}, {"height": 0.1, "absorption": 1.5}, 1024),
}
"""Scene, the same with one thing wrong, and samples; the relief has a rough boundary."""


@pytest.mark.long
@pytest.mark.parametrize("name", SCENES)
def test_voxels_match_volpath_uniquely(name):
    """False alarms: below 2e-3 by Student's distribution with 11 degrees of freedom or more.

    The halves of a wrong scene differ by 10 to 20 %, 10 standard errors in one of them.
    """
    scene, wrong, samples = SCENES[name]
    peer = halves(samples, integrator="volpath", **scene)
    assert agree(halves(samples // 2, integrator="tissue", **scene), peer)
    assert not agree(halves(samples // 2, integrator="tissue", **wrong), peer)


def test_surface_and_subsurface_parts_add_up():
    """Rationale: a smooth boundary has no highlight of distant lights; a rough one does."""
    smooth, rough = (
        render_voxels(box_of_voxels("tissue", alpha=alpha), samples=256, seed=1).mean(axis=(0, 1))
        for alpha in (0.0, 0.5)
    )
    assert smooth[0] == pytest.approx(smooth[1], rel=1e-6)
    assert 0.1 * rough[0] < rough[0] - rough[1] < 0.5 * rough[0]


def test_same_seed_gives_same_image():
    first, second, other = (
        render_voxels(box_of_voxels("tissue"), samples=16, seed=seed) for seed in (1, 1, 2)
    )
    assert np.array_equal(first, second)
    assert not np.array_equal(first, other)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"height": 0.1, "alpha": 0.0}, "expected roughdielectric"),
        ({"height": 0.1, "eta": 1.0}, "expected roughdielectric"),
    ],
)
def test_smooth_relief_is_refused(change, message):
    with pytest.raises(RenderError, match=message):
        render_voxels(box_of_voxels("tissue", **change), samples=1, seed=0)


def test_interpolated_grid_is_refused():
    scene = box_of_voxels("tissue")
    scene["skin"]["interior"]["sigma_t"]["filter_type"] = "trilinear"
    with pytest.raises(RenderError, match="filter_type"):
        render_voxels(scene, samples=1, seed=0)


def test_layers_of_two_indices_are_refused():
    stack = LayerStack((Layer(0.1, 1.0, 9.0, 0.8, 1.4), Layer(inf, 1.0, 9.0, 0.8, 1.5)))
    with pytest.raises(TransportError, match="expected one value"):
        describe_flat_layers(stack)


@pytest.mark.long
@pytest.mark.parametrize("scattering", [(1.0, 1.0, 1.0), (1.4, 1.0, 0.6)], ids=["shared", "own"])
def test_bands_together_match_each_band_alone(scattering):
    """Rationale: bands share walks where scattering is even over them, and have their own else."""
    absorption = (0.5, 1.0, 3.0)
    ours, stderr, alone = [], [], []
    whole = box_of_voxels("tissue")
    medium = whole["skin"]["interior"]
    sigma_t, albedo = (medium[name]["grid"] for name in ("sigma_t", "albedo"))
    sigma_s = sigma_t * albedo * np.array(scattering)
    sigma_a = sigma_t * (1.0 - albedo) * np.array(absorption)
    for bands in ([0, 1, 2], [0], [1], [2]):
        total = (sigma_s + sigma_a)[..., bands]
        medium["sigma_t"]["grid"], medium["albedo"]["grid"] = total, sigma_s[..., bands] / total
        kind = "rgb" if len(bands) == 3 else "mono"
        for name in ("sigma_t", "albedo"):
            medium[name]["raw"] = True
        whole["sensor"]["film"]["pixel_format"] = "rgb" if kind == "rgb" else "luminance"
        load_mitsuba(choose_variant(kind))
        image = radiance(whole, kind=kind, samples=1024, seed=len(bands) + bands[0])
        found = image[..., -len(bands) :].reshape(64, len(bands)).astype(np.float64)
        (ours if len(bands) == 3 else alone).extend(found.mean(axis=0))
        stderr.extend(found.std(axis=0, ddof=1) / 8.0)
    errors = np.hypot(stderr[:3], stderr[3:])
    assert (np.abs(np.subtract(ours, alone)) < 4.0 * errors).all()
    assert (np.abs(np.subtract(ours, alone[::-1]))[[0, 2]] > 4.0 * errors[[0, 2]]).all()
