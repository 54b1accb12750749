"""Gradient normals: exact where lights and lobe are known, with errors that say what is lost.

The pictures come from direct sums of a microfacet lobe over single lights, written here on angles
(sin and tan forms of Fresnel's equations, slope form of the lobe), with no table.
"""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from model.metrics import angular_error_rad
from reconstruction.gradient_normals import (
    SphereLights,
    estimate_roughness,
    from_patterns,
)

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
    normals, lights, *, strength=None, alpha=0.2, diffuse=0.4, off_deg=0.0, leak=0.0, view=VIEW,
    programmed=None, point_mm=None, distance_mm=np.inf, dark=0.0, polarized_exit=True,
):  # fmt: skip
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
    through, not_through = np.cos(off) ** 2, np.sin(off) ** 2 + leak
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
        spark = (each * p).sum(axis=-1)
        found[name, "parallel"] = dark + (through * spark + w * glow) / white
        found[name, "crossed"] = dark + (not_through * spark + (2.0 - w) * glow) / white
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
def test_normals_of_a_smooth_relief_are_exact_where_lights_and_roughness_are_known(alpha):
    lights, normals = sphere(), relief(48)
    images = pictures(normals, lights, alpha=alpha)
    found = from_patterns(images, lights=SphereLights(lights), alpha=alpha)
    assert found.valid.all()
    assert error_deg(found, normals).mean() <= 0.3  # degrees, the limit of this stage
    assert error_deg(found, normals).mean() < 0.05
    plain = from_patterns(images)
    assert error_deg(plain, normals).mean() > 10 * error_deg(found, normals).mean()


@pytest.mark.parametrize("alpha", [0.1, 0.3, 0.5])
def test_the_roughness_is_found_from_how_long_the_vectors_are(alpha):
    lights, normals = sphere(), relief(32)
    images = pictures(normals, lights, alpha=alpha)
    found = estimate_roughness(images, lights=SphereLights(lights))
    np.testing.assert_allclose(found.alpha, alpha, rtol=0.01)
    assert error_deg(from_patterns(images, lights=SphereLights(lights)), normals).mean() < 0.05


def test_a_surface_that_leans_to_the_right_and_up_has_normals_that_do(scene):
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
def test_any_patterns_that_tell_the_vector_give_the_same_normals(scene, names):
    lights, normals, images = scene
    found = from_patterns(only(images, names), lights=SphereLights(lights), alpha=0.2)
    assert found.valid.all()
    assert error_deg(found, normals).mean() < 0.05
    matte = from_patterns(only(images, (), names), component="diffuse")
    # full and three gradients of the two polarizations need not be the same
    other = from_patterns(only(images, names, NAMES), lights=SphereLights(lights), alpha=0.2)
    np.testing.assert_allclose(other.normals, found.normals, atol=1e-6)
    assert matte.valid.all()
