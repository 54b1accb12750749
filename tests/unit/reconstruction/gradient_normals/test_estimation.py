"""Gradient normals: exact where lights and lobe are known, with errors that say what is lost.

The pictures come from direct sums of a microfacet lobe over single lights, written here on angles
(sin and tan forms of Fresnel's equations, slope form of the lobe), with no table.
"""

import logging

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from model.metrics import angular_error_rad
from reconstruction.gradient_normals import moment_kernels
from reconstruction.gradient_normals.estimation import estimate_roughness, from_patterns
from reconstruction.gradient_normals.noise import SensorNoise
from reconstruction.gradient_normals.patterns import (
    GradientError,
    MissingPatternsError,
    design_matrix,
)
from reconstruction.gradient_normals.sphere_lights import SphereLights, SphereLightsError

VIEW = np.array([0.0, 0.0, 1.0])
NAMES = ("full", "x", "y", "z", "-x", "-y", "-z", "dark")
ETA = 1.4


def sphere(count=140, hole=0.985, behind=-0.6):
    """Return directions spread evenly, without those before the lens and behind the subject."""
    k = np.arange(count) + 0.5
    z = 1.0 - (1.0 - behind) * k / count
    phi = np.pi * (1.0 + np.sqrt(5.0)) * k
    r = np.sqrt(1.0 - z * z)
    return np.stack([r * np.cos(phi), r * np.sin(phi), z], axis=-1)[z < hole]


def relief(side, tilt=0.25, seed=3):
    """Return normals (side, side, 3) of a smooth relief of mean slope `tilt`."""
    h = gaussian_filter(np.random.default_rng(seed).standard_normal((side, side)), 4.0, mode="wrap")
    down, right = np.gradient(h)
    scale = tilt / np.hypot(down, right).mean()
    n = np.stack([-right * scale, down * scale, np.ones_like(h)], axis=-1)
    return n / np.linalg.norm(n, axis=-1, keepdims=True)


def unit(v):
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def pictures(
    normals,
    lights,
    *,
    strength=None,
    alpha=0.2,
    diffuse=0.4,
    off_deg=0.0,
    leak=0.0,
    view=VIEW,
    programmed=None,
    point_mm=None,
    distance_mm=np.inf,
    dark=0.0,
    polarized_exit=True,
):
    """Return pictures by (pattern, polarizer), in units of a white diffuser in full light."""
    e = np.ones(len(lights)) if strength is None else np.asarray(strength)
    coordinates = lights if programmed is None else programmed
    white = 0.5 * np.sum(e * np.maximum(lights @ view, 0.0)) / np.pi
    ways = lights
    if point_mm is not None:
        way = lights * distance_mm - point_mm
        far = np.linalg.norm(way, axis=1)
        ways, e = way / far[:, None], e * (distance_mm / far) ** 2
    h = unit(lights + VIEW)  # films are tuned for the middle of the patch and the nominal view
    theta = np.arccos(np.clip(np.sum(h * VIEW, axis=1), -1, 1))
    inner = np.arcsin(np.sin(theta) / ETA)
    r_s = np.sin(theta - inner) / np.sin(theta + inner)
    r_p = np.tan(theta - inner) / np.tan(theta + inner)
    s = unit(np.cross(h, VIEW))
    a = np.array([0.0, 1.0, 0.0])
    gain = 1.0 / ((s @ a / r_s) ** 2 + (np.cross(s, VIEW) @ a / r_p) ** 2)
    off = np.radians(off_deg)
    through, not_through = np.cos(off) ** 2, np.sin(off) ** 2 + np.asarray(leak)
    h = unit(ways + view)
    nl, nv, nh = normals @ ways.T, normals @ view, normals @ h.T
    tan2 = np.tan(np.arccos(np.clip(nh, 1e-6, 1.0))) ** 2
    lobe = 1.0 / (np.pi * alpha**2 * np.clip(nh, 1e-6, 1) ** 4 * (1.0 + tan2 / alpha**2) ** 2)

    def hidden(cosine):
        tan = np.tan(np.arccos(np.clip(cosine, 1e-3, 1.0)))
        return 0.5 * (np.sqrt(1.0 + (alpha * tan) ** 2) - 1.0)

    lobe = lobe / (1.0 + hidden(nl) + hidden(nv)[..., None]) / 4.0
    each = lobe / np.clip(nv, 1e-3, 1.0)[..., None] * (nl > 0) * gain * e
    matte = np.maximum(nl, 0.0) / np.pi * diffuse * e / 2.0
    w = 1.0
    if polarized_exit:
        out = np.clip(np.arccos(np.clip(nv, -1, 1)), 1e-6, None)
        refracted = np.arcsin(np.sin(out) / ETA)
        t_s = 1.0 - (np.sin(out - refracted) / np.sin(out + refracted)) ** 2
        t_p = 1.0 - (np.tan(out - refracted) / np.tan(out + refracted)) ** 2
        turned = np.cos(off) * a + np.sin(off) * np.cross(a, view)
        across = np.cross(normals, view)
        share = (across @ turned) ** 2 / np.maximum(np.sum(across**2, axis=-1), 1e-20)
        w = 2.0 * (t_s * share + t_p * (1.0 - share)) / (t_s + t_p)
    found = {}
    for name in NAMES:
        p = np.zeros(len(lights)) if name == "dark" else np.ones(len(lights))
        if name not in ("full", "dark"):
            c = coordinates[:, "xyz".index(name[-1])]
            p = (1.0 - c) / 2.0 if name[0] == "-" else (1.0 + c) / 2.0
        glow = (matte * p).sum(axis=-1)
        spark = (each * through * p).sum(axis=-1)
        leaked = (each * not_through * p).sum(axis=-1)
        found[name, "parallel"] = dark + (spark + w * glow) / white
        found[name, "crossed"] = dark + (leaked + (2.0 - w) * glow) / white
    return found


def only(images, parallel, crossed=None):
    """Return the pictures of the patterns named."""
    crossed = parallel if crossed is None else crossed
    kept = {"parallel": parallel, "crossed": crossed}
    return {key: image for key, image in images.items() if key[0] in kept[key[1]]}


def noisy(images, noise, rng):
    """Return pictures with noise as :class:`SensorNoise` says, float32."""
    return {
        key: (
            image
            + np.sqrt(noise.read_variance + noise.gain * np.maximum(image, 0.0))
            * rng.standard_normal(image.shape)
        ).astype(np.float32)
        for key, image in images.items()
    }


def error_deg(found, truth):
    return np.degrees(angular_error_rad(found.normals[found.valid], truth[found.valid]))


def assert_clean(found):
    """No NaN anywhere, and what is not valid says so in every map."""
    for name in ("normals", "albedo", "residual", "stderr_rad"):
        assert np.isfinite(getattr(found, name)).all(), name
    assert not np.isnan(found.stderr_albedo).any()
    bad = ~found.valid
    assert (found.normals[bad] == 0).all()
    assert (found.stderr_rad[bad] == found.stderr_rad.dtype.type(np.pi)).all()
    np.testing.assert_allclose(np.linalg.norm(found.normals[~bad], axis=-1), 1.0, atol=1e-5)


@pytest.fixture(scope="module")
def scene():
    """A smooth relief, its lights, and its pictures without noise."""
    lights, normals = sphere(), relief(48)
    return lights, normals, pictures(normals, lights)


@pytest.mark.parametrize("alpha", [0.05, 0.1, 0.2, 0.3, 0.5])
def test_smooth_normals_are_exact_with_known_lights_roughness(alpha):
    lights, normals = sphere(), relief(48)
    images = pictures(normals, lights, alpha=alpha)
    found = from_patterns(images, lights=SphereLights(lights), alpha=alpha)
    assert found.valid.all()
    assert error_deg(found, normals).mean() <= 0.3  # degrees, the limit of this stage
    assert error_deg(found, normals).mean() < 0.05
    plain = from_patterns(images)
    assert error_deg(plain, normals).mean() > 10 * error_deg(found, normals).mean()


@pytest.mark.parametrize("alpha", [0.1, 0.3, 0.5])
def test_roughness_is_found_from_vector_lengths(alpha):
    lights, normals = sphere(), relief(32)
    images = pictures(normals, lights, alpha=alpha)
    found = estimate_roughness(images, lights=SphereLights(lights))
    np.testing.assert_allclose(found.alpha, alpha, rtol=0.01)
    assert error_deg(from_patterns(images, lights=SphereLights(lights)), normals).mean() < 0.05


def test_surface_leaning_right_and_up_has_such_normals(scene):
    lights, _, _ = scene
    n = np.broadcast_to(unit(np.array([0.2, 0.1, 1.0])), (2, 2, 3))
    for component in ("specular", "diffuse"):
        found = from_patterns(pictures(n, lights), component=component)
        assert (found.normals[..., 0] > 0.1).all()
        assert (found.normals[..., 1] > 0.05).all()


@pytest.mark.parametrize(
    "names",
    [
        ("full", "x", "y", "z"),
        ("full", "-x", "y", "-z"),
        ("x", "-x", "y", "z"),
        ("-x", "-y", "z", "-z"),
        NAMES[:7],
        *(tuple(n for n in NAMES if n != missing) for missing in NAMES),
    ],
)
def test_sufficient_pattern_sets_give_equal_normals(scene, names):
    lights, normals, images = scene
    found = from_patterns(only(images, names), lights=SphereLights(lights), alpha=0.2)
    assert found.valid.all()
    assert error_deg(found, normals).mean() < 0.05
    matte = from_patterns(only(images, (), names), component="diffuse")
    # full and three gradients of the two polarizations need not be the same
    other = from_patterns(only(images, names, NAMES), lights=SphereLights(lights), alpha=0.2)
    np.testing.assert_allclose(other.normals, found.normals, atol=1e-6)
    assert matte.valid.all()


@pytest.mark.parametrize("dark", [False, True])
def test_moments_are_weighted_least_squares_of_all_samples(rng, dark):
    """The closed form of the kernel beside a dense fit, with samples missing at random."""
    checked = 0
    for _ in range(60):
        there = rng.random(8) < 0.8
        there[7] &= dark
        y, v = rng.standard_normal(8), np.exp(rng.standard_normal(8))
        names = [name for name, here in zip(NAMES, there, strict=True) if here]
        A = design_matrix(names, dark=dark)
        out = np.empty((moment_kernels.MOMENT_ROWS, 1))
        moment_kernels.fit_moments(
            np.where(there, y, np.nan)[:, None], v[:, None], 0.0, 1.0, 1, dark, out
        )
        if len(names) == 0 or np.linalg.matrix_rank(A) < A.shape[1]:
            assert np.isnan(out[moment_kernels.C_0, 0])
            continue
        checked += 1
        W = np.diag(1.0 / v[there])
        cov = np.linalg.inv(A.T @ W @ A)
        fit = cov @ A.T @ W @ y[there]
        np.testing.assert_allclose(out[:4, 0], fit[:4], rtol=1e-8, atol=1e-8)
        for row, i, j in (
            (4, 0, 0),
            (5, 1, 1),
            (6, 2, 2),
            (7, 3, 3),
            (8, 1, 2),
            (9, 1, 3),
            (10, 2, 3),
        ):
            np.testing.assert_allclose(out[row, 0], cov[i, j], rtol=1e-8, atol=1e-9)
        r = y[there] - A @ fit
        np.testing.assert_allclose(out[moment_kernels.CHI, 0], r @ W @ r, rtol=1e-7, atol=1e-9)
        assert out[moment_kernels.FREE, 0] == len(names) - A.shape[1]
    assert checked > 10


@pytest.mark.parametrize(
    ("names", "words"),
    [
        (("x", "y", "z"), "full"),
        (("full", "x", "y"), "z or -z"),
        (("full", "x", "-x", "dark"), "y or -y and z or -z"),
        ((), "full"),
    ],
)
def test_too_few_patterns_are_refused_naming_sufficient_ones(scene, names, words):
    _, _, images = scene
    with pytest.raises(MissingPatternsError, match=words):
        from_patterns(only(images, NAMES, names) if names else only(images, NAMES, ("dark",)))


def test_specular_normals_need_both_polarizers_diffuse_only_crossed(scene):
    _, normals, images = scene
    with pytest.raises(MissingPatternsError, match="no crossed"):
        from_patterns(only(images, NAMES, ()))
    with pytest.raises(MissingPatternsError, match="no parallel"):
        from_patterns(only(images, (), NAMES))
    with pytest.raises(MissingPatternsError, match="no crossed"):
        from_patterns(only(images, NAMES, ()), component="diffuse")
    found = from_patterns(only(images, (), NAMES), component="diffuse")
    # on a nearly whole sphere of lights, a matte surface's vector is its normal
    assert error_deg(found, normals).mean() < 1.0


def test_dark_frames_are_subtracted_even_for_single_polarizer(scene):
    lights, normals, clean = scene
    images = pictures(normals, lights, dark=0.03)
    one = {key: image for key, image in images.items() if key != ("dark", "crossed")}
    for given in (images, one):
        found = from_patterns(given)
        np.testing.assert_allclose(found.normals, from_patterns(clean).normals, atol=1e-9)
    # without complements a dark level is part of every gradient
    four = only(images, ("full", "x", "y", "z"))
    apart = error_deg(from_patterns(four, component="diffuse"), normals).mean()
    assert apart > 2 * error_deg(from_patterns(images, component="diffuse"), normals).mean()


@pytest.mark.parametrize("patterns", [NAMES, ("full", "x", "y", "z"), ("x", "-x", "y", "z")])
@pytest.mark.parametrize("given", ["model", "arrays"])
def test_errors_match_standard_errors(rng, patterns, given):
    """Mean of squared error over squared standard error is 1.

    Its standard deviation is at most sqrt(2 / pixels); false alarm at four of these: 6e-5.
    """
    lights, normals = sphere(), relief(40, tilt=0.15)
    clean = only(pictures(normals, lights, alpha=0.3), patterns)
    noise = SensorNoise(2e-7, 2e-8)
    variance = (
        noise
        if given == "model"
        else {key: noise.read_variance + noise.gain * image for key, image in clean.items()}
    )
    found = from_patterns(
        noisy(clean, noise, rng), lights=SphereLights(lights), alpha=0.3, variance=variance
    )
    assert found.valid.all()
    ratio = (np.radians(error_deg(found, normals)) / found.stderr_rad.ravel()) ** 2
    assert abs(ratio.mean() - 1.0) < 4 * np.sqrt(2.0 / ratio.size)


def test_four_patterns_cost_error_as_announced(rng):
    """Full, x, y, z alone: a moment has 4 V + V_full instead of 2 V and less."""
    lights, normals = sphere(), relief(40, tilt=0.15)
    images = noisy(pictures(normals, lights, alpha=0.3), SensorNoise(1e-7, 1e-7), rng)
    errors, told = {}, {}
    for label, names in (("all", NAMES), ("four", ("full", "x", "y", "z"))):
        found = from_patterns(
            only(images, names),
            lights=SphereLights(lights),
            alpha=0.3,
            variance=SensorNoise(1e-7, 1e-7),
        )
        errors[label], told[label] = error_deg(found, normals).mean(), found.stderr_rad.mean()
    assert errors["four"] > 1.3 * errors["all"]
    np.testing.assert_allclose(errors["four"] / errors["all"], told["four"] / told["all"], rtol=0.1)


def test_noise_is_found_from_contradicting_patterns(rng):
    lights, normals = sphere(), relief(64)
    noise = SensorNoise(1e-6, 2e-7)
    images = noisy(pictures(normals, lights, alpha=0.3), noise, rng)
    kwargs = {"lights": SphereLights(lights), "alpha": 0.3}
    told = from_patterns(images, variance=noise, **kwargs)
    found = from_patterns(images, **kwargs)
    np.testing.assert_allclose(found.stderr_rad.mean(), told.stderr_rad.mean(), rtol=0.1)
    four = from_patterns(only(images, ("full", "x", "y", "z")), **kwargs)
    assert (four.stderr_rad == np.float32(np.pi)).all()  # nothing to find it from


def test_unequal_lights_are_corrected_and_bias_otherwise(rng):
    lights, normals = sphere(), relief(32)
    strength = np.exp(0.3 * rng.standard_normal(len(lights)))
    images = pictures(normals, lights, strength=strength)
    right = from_patterns(images, lights=SphereLights(lights, strength), alpha=0.2)
    wrong = from_patterns(images, lights=SphereLights(lights), alpha=0.2)
    assert error_deg(right, normals).mean() < 0.05
    assert error_deg(wrong, normals).mean() > 0.5


def test_light_uncertainty_is_included_in_standard_errors():
    """Squared errors over what is announced, by drawn sphere; false alarm at 4 sigma: 6e-5."""
    lights, normals = sphere(), relief(16)
    rng = np.random.default_rng(7)
    told = SphereLights(lights, intensity_stderr=np.full(len(lights), 0.05))
    ratios = []
    for _ in range(24):
        strength = 1.0 + 0.05 * rng.standard_normal(len(lights))
        found = from_patterns(
            pictures(normals, lights, strength=strength, alpha=0.3),
            lights=told,
            alpha=0.3,
            variance=1e-18,
        )
        announced = np.mean(found.stderr_rad**2)
        ratios.append(np.mean(np.radians(error_deg(found, normals)) ** 2) / announced)
    ratios = np.array(ratios)
    assert abs(ratios.mean() - 1.0) < 4 * ratios.std(ddof=1) / np.sqrt(len(ratios))


def test_leakage_by_direction_is_corrected():
    lights, normals = sphere(), relief(32)
    leak = 0.25 * (1.0 + lights[:, 0]) * (1.0 - 0.5 * lights[:, 2])
    images = pictures(normals, lights, leak=leak)
    right = from_patterns(images, lights=SphereLights(lights, leakage=leak), alpha=0.2)
    wrong = from_patterns(images, lights=SphereLights(lights), alpha=0.2)
    assert error_deg(right, normals).mean() < 0.05
    assert error_deg(wrong, normals).mean() > 0.2


def test_misoriented_polarizers_leave_calibrated_normals_unrotated():
    """Three of the lights reflect more crossed than parallel: their films are 50 degrees off."""
    lights, normals = sphere(), relief(32)
    leak = np.zeros(len(lights))
    facing = np.argsort(-lights[:, 2])[:3]
    leak[facing] = np.tan(np.radians(50.0)) ** 2
    images = pictures(normals, lights, leak=leak)
    aware = from_patterns(images, lights=SphereLights(lights, leakage=leak), alpha=0.2)
    unaware = from_patterns(images, lights=SphereLights(lights), alpha=0.2)
    assert error_deg(aware, normals).mean() < 0.05
    assert error_deg(unaware, normals).mean() > 0.2


def test_ten_degree_analyzer_offset_costs_signal_not_normals(rng, caplog):
    """Signal falls to cos 20 degrees, with the diffuse light's own polarization turned as well."""
    lights, normals = sphere(), relief(32)
    images = pictures(normals, lights, off_deg=10.0)
    straight = from_patterns(pictures(normals, lights), lights=SphereLights(lights), alpha=0.2)
    unaware = from_patterns(images, lights=SphereLights(lights), alpha=0.2)
    np.testing.assert_allclose(
        np.median(unaware.albedo / straight.albedo), np.cos(np.radians(20.0)), rtol=0.02
    )
    assert error_deg(unaware, normals).mean() < 0.3
    leak = np.full(len(lights), np.tan(np.radians(10.0)) ** 2)
    with caplog.at_level(logging.WARNING):
        aware = from_patterns(images, lights=SphereLights(lights, leakage=leak), alpha=0.2)
    assert "polarizers leak" in caplog.text
    assert "10 degrees" in caplog.text
    assert error_deg(aware, normals).mean() < 0.3
    assert 0.9 < np.median(aware.albedo / straight.albedo) < 1.0


def test_patterns_programmed_for_nominal_directions_use_programmed_directions(rng):
    drawn, normals = sphere(), relief(24)
    built = unit(drawn + 0.02 * rng.standard_normal(drawn.shape))
    images = pictures(normals, built, programmed=drawn)
    right = from_patterns(images, lights=SphereLights(built, programmed=drawn), alpha=0.2)
    wrong = from_patterns(images, lights=SphereLights(drawn), alpha=0.2)
    assert error_deg(right, normals).mean() < 0.05
    assert error_deg(wrong, normals).mean() > 2 * error_deg(right, normals).mean()


@pytest.mark.parametrize("component", ["specular", "diffuse"])
def test_off_center_points_use_shifted_light_camera_directions(component):
    """A point 6 mm off the middle, lights at 600 mm and a camera at 300 mm."""
    lights, normals = sphere(400), relief(16)
    point = np.array([6.0, -4.0, 0.0])
    view = unit(np.array([0.0, 0.0, 300.0]) - point)
    images = pictures(normals, lights, view=view, point_mm=point, distance_mm=600.0, alpha=0.3)
    kwargs = {"lights": SphereLights(lights, distance_mm=600.0), "component": component}
    if component == "specular":
        kwargs["alpha"] = 0.3
    there = from_patterns(
        images,
        view=np.broadcast_to(view, (16, 16, 3)),
        points_mm=np.broadcast_to(point, (16, 16, 3)),
        **kwargs,
    )
    offset = (there.normals - normals).mean(axis=(0, 1))
    middle = from_patterns(images, **kwargs)
    before = (middle.normals - normals).mean(axis=(0, 1))
    assert np.linalg.norm(offset) < 0.3 * np.linalg.norm(before)


@pytest.mark.parametrize("turn_deg", [0.0, 23.0, 90.0])
@pytest.mark.parametrize("tilt_deg", [0.0, 30.0, 45.0, 60.0])
def test_flat_patch_has_normal_or_none_when_steep(tilt_deg, turn_deg):
    """Across the analyzer's axis, light mirrored beyond Brewster's angle tells nothing."""
    lights = sphere()
    tilt, turn = np.radians(tilt_deg), np.radians(turn_deg)
    n = np.array([np.sin(tilt) * np.cos(turn), np.sin(tilt) * np.sin(turn), np.cos(tilt)])
    normals = np.broadcast_to(n, (3, 3, 3))
    found = from_patterns(
        pictures(normals, lights, alpha=0.25), lights=SphereLights(lights), alpha=0.25
    )
    assert found.valid.all() or tilt_deg >= 45.0
    assert error_deg(found, normals).max(initial=0.0) < 0.3
    assert_clean(found)


def test_black_skin_has_specular_but_not_diffuse_normals(rng):
    lights, normals = sphere(), relief(24)
    images = noisy(pictures(normals, lights, diffuse=0.0, alpha=0.3), SensorNoise(1e-7, 1e-8), rng)
    kwargs = {"lights": SphereLights(lights), "variance": SensorNoise(1e-7, 1e-8)}
    found = from_patterns(images, alpha=0.3, **kwargs)
    assert found.valid.all()
    assert error_deg(found, normals).mean() < 0.5
    matte = from_patterns(images, component="diffuse", **kwargs)
    assert matte.valid.mean() < 0.1  # a signal of three standard errors by chance
    assert_clean(matte)


def test_images_without_light_give_no_normals(rng):
    lights = sphere()
    dark = {key: np.zeros((5, 4), np.float32) for key in pictures(relief(4), lights)}
    for images in (dark, noisy(dark, SensorNoise(0.0, 1e-6), rng)):
        found = from_patterns(images, lights=SphereLights(lights))
        assert_clean(found)
        assert found.valid.mean() < 0.3
    with pytest.raises(GradientError, match="no pixel"):
        estimate_roughness(dark, lights=SphereLights(lights))


def test_saturated_samples_are_omitted_and_others_give_normal(scene):
    lights, normals, images = scene
    clipped = {key: np.minimum(image, 0.9) for key, image in images.items()}
    clipped["x", "parallel"][5:9, 5:9] = 0.9  # one pattern: seven are left
    for name in ("full", "-y", "y"):  # no full, no y: nothing is left
        clipped[name, "parallel"][20:22, 20] = 0.9
    clipped["z", "crossed"][30, 30] = np.nan
    kept = {key: image.copy() for key, image in clipped.items()}
    found = from_patterns(clipped, lights=SphereLights(lights), alpha=0.2, saturation=0.9)
    assert_clean(found)
    assert not found.valid[20:22, 20].any()
    assert found.valid.sum() == found.valid.size - 2
    assert error_deg(found, normals).mean() < 0.05
    assert found.used[6, 6] == 15
    wrong = from_patterns(clipped, lights=SphereLights(lights), alpha=0.2)
    patch = (slice(5, 9), slice(5, 9))
    near = np.sum(wrong.normals[patch] * normals[patch], axis=-1) > np.cos(np.radians(5.0))
    assert not near.any()
    for key, image in kept.items():
        np.testing.assert_array_equal(clipped[key], image)


@pytest.mark.parametrize("options", [{}, {"smoothing": 1.5}, {"smoothing": "wiener"}])
def test_single_pixel_mask_and_nan_images_are_handled(scene, options):
    lights, normals, images = scene
    valid = np.zeros((48, 48), bool)
    valid[7, 9] = True
    images = {key: image.astype(np.float32) for key, image in images.items()}
    found = from_patterns(
        images, lights=SphereLights(lights), alpha=0.2, valid=valid, variance=1e-9, **options
    )
    assert_clean(found)
    np.testing.assert_array_equal(found.valid, valid)
    assert error_deg(found, normals)[0] < 0.5
    nothing = {key: np.full((6, 6), np.nan, np.float32) for key in images}
    found = from_patterns(nothing, lights=SphereLights(lights), variance=1e-9, **options)
    assert_clean(found)
    assert not found.valid.any()


def test_lobes_beyond_horizon_give_no_normals():
    """What comes back from behind the surface, as from a neighbour's flank, has no normal."""
    images = {
        (n, p): np.full((2, 2), 0.5)
        for n in ("full", "x", "y", "z")
        for p in ("parallel", "crossed")
    }
    behind = unit(np.array([0.05, 0.0, -1.0]))
    for name, w in zip(("full", "x", "y", "z"), (1.0, *(1 + behind) / 2), strict=True):
        images[name, "parallel"] = images[name, "parallel"] + 0.1 * w
    found = from_patterns(images, variance=1e-8)
    assert not found.valid.any()
    assert_clean(found)


@pytest.mark.parametrize("options", [{"smoothing": 1.5}, {"smoothing": "wiener"}])
def test_filters_lower_noise_as_stated_and_keep_topography(rng, options):
    lights = sphere()
    h = gaussian_filter(rng.standard_normal((96, 96)), 18.0, mode="wrap")
    down, right = np.gradient(h)
    slope = 0.12 / np.hypot(down, right).mean()
    normals = unit(np.stack([-slope * right, slope * down, np.ones_like(h)], axis=-1))
    noise = SensorNoise(2e-6, 2e-7)
    images = noisy(pictures(normals, lights, alpha=0.3), noise, rng)
    kwargs = {"lights": SphereLights(lights), "alpha": 0.3, "variance": noise}
    plain, found = from_patterns(images, **kwargs), from_patterns(images, **options, **kwargs)
    inner = (slice(8, -8), slice(8, -8))

    def rms(maps):
        error = angular_error_rad(maps.normals[inner], normals[inner])
        return float(np.sqrt(np.mean(error**2)))

    assert rms(found) < 0.35 * rms(plain)
    announced = float(np.sqrt(np.mean(found.stderr_rad[inner] ** 2)))
    # neighbours share their noise: some 6000 pixels / 30 of them are free; 4 sigma is 0.4
    assert abs((rms(found) / announced) ** 2 - 1.0) < 0.4


def test_tiles_of_rows_make_no_seams(scene, monkeypatch):
    lights, _, images = scene
    kwargs = {"lights": SphereLights(lights), "alpha": 0.2, "smoothing": 1.0, "variance": 1e-8}
    whole = from_patterns(images, **kwargs)
    monkeypatch.setattr("reconstruction.gradient_normals.moments.TILE_PIXELS", 48 * 7)
    tiled = from_patterns(images, **kwargs)
    np.testing.assert_array_equal(whole.normals, tiled.normals)
    np.testing.assert_array_equal(whole.stderr_rad, tiled.stderr_rad)


def test_channels_are_summed_for_specular_separate_for_diffuse(scene):
    lights, _, images = scene
    weights = np.array([0.5, 1.0, 0.2])
    color = {key: image[..., None] * weights for key, image in images.items()}
    one = from_patterns(images, lights=SphereLights(lights), alpha=0.2, variance=1e-8)
    found = from_patterns(color, lights=SphereLights(lights), alpha=0.2, variance=1e-8)
    np.testing.assert_allclose(found.normals, one.normals, atol=1e-6)
    matte = from_patterns(color, component="diffuse")
    assert matte.normals.shape == (48, 48, 3, 3)
    assert matte.valid.shape == (48, 48, 3)
    single = from_patterns({k: v[..., 1] for k, v in color.items()}, component="diffuse")
    np.testing.assert_array_equal(matte.normals[:, :, 1], single.normals)


def test_types_are_kept(scene):
    _, _, images = scene
    assert from_patterns(images).normals.dtype == np.float64
    small = {key: image.astype(np.float32) for key, image in images.items()}
    assert from_patterns(small).normals.dtype == np.float32


def test_mismatched_gradient_input_is_refused_by_name(scene):
    lights, _, images = scene
    told = SphereLights(lights)
    with pytest.raises(GradientError, match="did you mean full"):
        from_patterns({**images, ("ful", "parallel"): images["full", "parallel"]})
    with pytest.raises(GradientError, match="shape"):
        from_patterns({**images, ("full", "parallel"): np.zeros((2, 2))})
    with pytest.raises(GradientError, match="variance"):
        from_patterns(images, variance={("full", "parallel"): 1.0})
    with pytest.raises(GradientError, match="without lights"):
        from_patterns(images, alpha=0.2)
    with pytest.raises(SphereLightsError, match="alpha"):
        from_patterns(images, lights=told, alpha=0.0)
    with pytest.raises(GradientError, match="finite distance"):
        from_patterns(images, lights=told, points_mm=np.zeros((48, 48, 2)))
    with pytest.raises(GradientError, match="noise is unknown"):
        from_patterns(only(images, ("full", "x", "y", "z")), smoothing="wiener")
    with pytest.raises(SphereLightsError, match="exchanged"):
        SphereLights(lights, leakage=np.full(len(lights), 1.2))
    with pytest.raises(SphereLightsError, match=r"directions\[2\]"):
        SphereLights(np.diag([1.0, 1.0, 3.0]))
    with pytest.raises(SphereLightsError, match="own ray"):
        SphereLights(lights, polarizers=lights)
