import numpy as np
import pytest

from reconstruction.polarization import PolarizerAxes, separate

VERTICAL, HORIZONTAL = np.array([0.0, 1.0, 0.0]), np.array([1.0, 0.0, 0.0])


def fresnel_transmittance(cosine, eta):
    """Power transmittance (s, p) by Snell's law and the sine and tangent forms of Fresnel."""
    i = np.arccos(cosine)
    t = np.arcsin(np.sin(i) / eta)
    t_s = 1 - (np.sin(i - t) / np.sin(i + t)) ** 2
    t_p = 1 - (np.tan(i - t) / np.tan(i + t)) ** 2
    return t_s, t_p


def tilted(angle_rad, towards):
    """Normal tilted from +z towards a direction in the image plane."""
    return np.cos(angle_rad) * np.array([0, 0, 1.0]) + np.sin(angle_rad) * np.asarray(towards)


@pytest.fixture
def scene():
    rng = np.random.default_rng(1)
    diffuse = rng.uniform(0.1, 0.8, (12, 15, 3))
    specular = rng.uniform(0.0, 0.5, (12, 15, 3))
    return diffuse, specular


@pytest.mark.parametrize("extinction", [None, np.inf, 1000.0, 20.0, (50.0, 200.0, 10.0)])
def test_polarization_separation_is_exact_for_any_polarizer_leakage(scene, extinction):
    diffuse, specular = scene
    leak = 0.0 if extinction is None else 1.0 / np.asarray(extinction)
    out = separate(specular + diffuse / 2, leak * specular + diffuse / 2, extinction=extinction)
    np.testing.assert_allclose(out.diffuse, diffuse, atol=1e-12)
    np.testing.assert_allclose(out.specular, specular, atol=1e-12)
    assert out.valid.all()
    assert out.stderr is None


def test_a_leak_ignored_shows_as_diffuse_light(scene):
    diffuse, specular = scene
    out = separate(specular + diffuse / 2, specular / 50 + diffuse / 2)
    np.testing.assert_allclose(out.diffuse - diffuse, 2 * specular / 50, atol=1e-12)


@pytest.mark.parametrize("angle_deg", [1.0, 30.0, 60.0, 80.0])
@pytest.mark.parametrize("towards", [VERTICAL, HORIZONTAL, (HORIZONTAL + VERTICAL) / np.sqrt(2)])
def test_partly_polarized_diffuse_light_is_taken_into_account(angle_deg, towards):
    """Light leaving at an angle is polarized in the plane of exit: T_p > T_s."""
    normal = tilted(np.deg2rad(angle_deg), towards)
    t_s, t_p = fresnel_transmittance(normal[2], 1.4)
    share = towards @ VERTICAL  # of the p direction along the vertical analyzer
    up = t_p * share**2 + t_s * (1 - share**2)
    side = t_p * (1 - share**2) + t_s * share**2
    diffuse, specular = 0.6, 0.2
    parallel = specular + diffuse * up / (t_s + t_p)
    crossed = diffuse * side / (t_s + t_p)
    shape = (1, 1, 3)
    out = separate(
        np.full(shape, parallel),
        np.full(shape, crossed),
        normals=normal.reshape(1, 1, 3),
        view_dir=(0, 0, 1),
    )
    np.testing.assert_allclose(out.diffuse, diffuse, rtol=1e-9)
    np.testing.assert_allclose(out.specular, specular, rtol=1e-9)


def test_specular_without_normals_is_wrong_off_axis():
    """The test above can fail: at 60 degrees, parallel minus crossed is far from specular."""
    normal = tilted(np.deg2rad(60.0), VERTICAL)
    t_s, t_p = fresnel_transmittance(normal[2], 1.4)
    out = separate(
        np.full((1, 1, 3), 0.6 * t_p / (t_s + t_p)), np.full((1, 1, 3), 0.6 * t_s / (t_s + t_p))
    )
    assert out.specular[0, 0, 0] > 0.02


def test_incident_polarized_light_is_corrected_to_unpolarized():
    """A surface tilted sideways under vertically polarized light receives the s part only."""
    normal = tilted(np.deg2rad(50.0), HORIZONTAL)
    t_s, t_p = fresnel_transmittance(normal[2], 1.4)
    entered = 2 * t_s / (t_s + t_p)
    up, side = entered * t_s / (t_s + t_p), entered * t_p / (t_s + t_p)
    out = separate(
        np.full((1, 1, 3), 0.1 + 0.5 * up),
        np.full((1, 1, 3), 0.5 * side),
        normals=normal.reshape(1, 1, 3),
        light_dir=(0, 0, 1),
        view_dir=(0, 0, 1),
    )
    np.testing.assert_allclose(out.diffuse, 0.5, rtol=1e-9)
    np.testing.assert_allclose(out.specular, 0.1, rtol=1e-9)


def test_two_lights_are_corrected_weighted_by_cosines():
    angle = np.deg2rad(14.0)
    lights = np.array([tilted(angle, HORIZONTAL), tilted(angle, -HORIZONTAL)])
    normal = tilted(np.deg2rad(40.0), HORIZONTAL).reshape(1, 1, 3)
    images = np.full((1, 1, 3), 0.4), np.full((1, 1, 3), 0.3)
    both = separate(*images, normals=normal, view_dir=(0, 0, 1), light_dir=lights[:, None, None, :])
    single = [
        separate(*images, normals=normal, view_dir=(0, 0, 1), light_dir=light).diffuse[0, 0, 0]
        for light in lights
    ]
    assert min(single) < both.diffuse[0, 0, 0] < max(single)


@pytest.mark.parametrize(
    ("half_angle_deg", "leak"), [(7.5, 1.5e-4), (15.0, 2.5e-3), (20.0, 8e-3), (30.0, 4.6e-2)]
)
def test_specular_outside_symmetry_planes_leaks_into_crossed_image(half_angle_deg, leak):
    """Rationale: light polarized at 45 degrees to the plane of incidence comes back turned.

    Expected: leaks of the polarized reference renderings at these half angles, to 7 %.
    """
    angle = 2 * np.deg2rad(half_angle_deg)
    light = tilted(angle, HORIZONTAL)
    in_plane = np.array([np.cos(angle), 0.0, -np.sin(angle)])
    axes = PolarizerAxes(
        light=tuple((VERTICAL + in_plane) / np.sqrt(2)),
        parallel=tuple((VERTICAL + HORIZONTAL) / np.sqrt(2)),
        crossed=tuple((VERTICAL - HORIZONTAL) / np.sqrt(2)),
    )
    specular = np.full((1, 1, 3), 0.5)
    out = separate(specular, 0 * specular, light_dir=light, view_dir=(0, 0, 1), axes=axes)
    found = -out.diffuse / 2 / out.specular  # crossed holds none, so the leak is taken off it
    np.testing.assert_allclose(found, leak, rtol=0.07)


def test_lights_in_axis_planes_do_not_leak():
    flat = np.full((1, 1, 3), 0.5)
    out = separate(flat, 0.01 * flat, light_dir=tilted(0.5, HORIZONTAL), view_dir=(0, 0, 1))
    np.testing.assert_allclose(out.diffuse, 0.01, rtol=1e-9)


def test_stated_errors_are_those_of_repeated_images(scene):
    """400 repeats of 180 pixels x 3 channels: each spread known to 3.5 %, their mean to 0.2 %."""
    diffuse, specular = scene
    rng = np.random.default_rng(2)
    variance = (1e-4 + 1e-3 * (specular + diffuse / 2), 1e-4 + 1e-3 * diffuse / 2)
    results = []
    for _ in range(400):
        images = [
            mean + np.sqrt(v) * rng.normal(size=v.shape)
            for mean, v in zip(
                (specular + diffuse / 2, specular / 30 + diffuse / 2), variance, strict=True
            )
        ]
        results.append(separate(*images, extinction=30.0, variance=variance))
    for name, error in (("diffuse", "stderr"), ("specular", "stderr_specular")):
        spread = np.std([getattr(r, name) for r in results], axis=0, ddof=1)
        ratio = spread / np.mean([getattr(r, error) for r in results], axis=0)
        assert ratio.mean() == pytest.approx(1.0, abs=0.01)


def test_leak_error_propagates_by_its_derivative(scene):
    diffuse, specular = scene
    parallel, crossed = specular + diffuse / 2, specular / 30 + diffuse / 2
    step = 1e-6
    low, high = (separate(parallel, crossed, extinction=1 / (1 / 30 + d)) for d in (-step, step))
    out = separate(
        parallel, crossed, extinction=30.0, variance=np.zeros_like(parallel), leak_stderr=1e-3
    )
    np.testing.assert_allclose(
        out.stderr, 1e-3 * np.abs(high.diffuse - low.diffuse) / (2 * step), rtol=1e-4, atol=1e-10
    )
    np.testing.assert_allclose(
        out.stderr_specular,
        1e-3 * np.abs(high.specular - low.specular) / (2 * step),
        rtol=1e-4,
        atol=1e-10,
    )


def test_saturated_masked_or_undefined_pixels_are_masked_nan(scene):
    diffuse, specular = (part.copy() for part in scene)
    parallel, crossed = specular + diffuse / 2, diffuse / 2
    parallel[0, 0, 1] = 5.0
    crossed[1, 1, 2] = np.nan
    mask = np.ones(parallel.shape[:2], bool)
    mask[2, 2] = False
    before = parallel.copy()
    out = separate(
        parallel, crossed, valid=mask, saturation=2.0, variance=np.full_like(parallel, 1e-6)
    )
    expected = np.ones(parallel.shape[:2], bool)
    expected[[0, 1, 2], [0, 1, 2]] = False
    np.testing.assert_array_equal(out.valid, expected)
    for part in (out.diffuse, out.specular, out.stderr, out.stderr_specular):
        np.testing.assert_array_equal(np.isnan(part).any(-1), ~expected)
        np.testing.assert_array_equal(np.isnan(part).all(-1), ~expected)
    np.testing.assert_array_equal(parallel, before)


def test_surface_facing_away_is_masked():
    normals = np.array([[[0, 0, 1.0], [0, 0, -1.0], [1.0, 0, 0]]])
    flat = np.full((1, 3, 3), 0.3)
    out = separate(flat, flat / 2, normals=normals, view_dir=(0, 0, 1))
    assert out.valid.tolist() == [[True, False, False]]


def test_negative_noise_is_kept():
    out = separate(np.full((1, 1, 3), -0.001), np.full((1, 1, 3), 0.001))
    np.testing.assert_allclose(out.specular, -0.002)


def test_leading_axes_broadcast_as_a_loop(scene):
    diffuse, specular = scene
    parallel = np.stack([specular + diffuse / 2, specular])
    crossed = np.stack([diffuse / 2, specular / 9])
    together = separate(parallel, crossed, extinction=(100.0, 50.0, 20.0))
    for i in range(2):
        alone = separate(parallel[i], crossed[i], extinction=(100.0, 50.0, 20.0))
        np.testing.assert_array_equal(together.diffuse[i], alone.diffuse)


def test_the_type_of_the_images_is_kept(scene):
    diffuse, specular = (part.astype(np.float32) for part in scene)
    normals = np.broadcast_to(np.float32([0, 0.6, 0.8]), (*diffuse.shape[:2], 3))
    out = separate(
        specular,
        diffuse,
        extinction=100.0,
        normals=normals,
        view_dir=(0, 0, 1),
        light_dir=(0, 0, 1),
        variance=diffuse,
    )
    assert {out.diffuse.dtype, out.specular.dtype, out.stderr.dtype} == {np.dtype(np.float32)}


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ({"extinction": 0.5}, "extinction"),
        ({"extinction": np.nan}, "extinction"),
        ({"extinction": 1.01}, "polarizers"),
        ({"extinction": (1.0e3, 1.0e3)}, "shape"),
        ({"normals": np.ones((2, 2, 3)) / np.sqrt(3)}, "view_dir"),
        ({"normals": np.ones((2, 2, 3)), "view_dir": (0, 0, 1)}, "unit"),
        ({"eta": 1.0}, "eta"),
        ({"variance": np.full((2, 2, 3), -1.0)}, "variance"),
    ],
)
def test_arguments_outside_their_range_are_named(arguments, says):
    with pytest.raises(ValueError, match=says):
        separate(np.ones((2, 2, 3)), np.ones((2, 2, 3)), **arguments)


def test_images_that_do_not_fit_are_refused():
    with pytest.raises(ValueError, match="crossed: got"):
        separate(np.ones((2, 2, 3)), np.ones((2, 3, 3)))
    with pytest.raises(ValueError, match="floating"):
        separate(np.ones((2, 2, 3), np.uint16), np.ones((2, 2, 3), np.uint16))
    with pytest.raises(ValueError, match="unit vector"):
        PolarizerAxes(light=(0.0, 2.0, 0.0))
    with pytest.raises(ValueError, match="axes that differ"):
        PolarizerAxes(crossed=(0.0, 1.0, 0.0))


def test_infinite_variance_masks_its_pixel_without_warning():
    parallel, crossed = np.full((2, 2, 3), 0.5), np.full((2, 2, 3), 0.25)
    parallel[0, 0] = crossed[0, 0]  # no specular part
    for bad in (np.inf, np.nan):
        variance = np.full(parallel.shape, 1e-4)
        variance[0, 0, 1] = bad
        with np.errstate(all="raise"):
            found = separate(parallel, crossed, variance=variance, extinction=1000.0)
        assert found.valid.tolist() == [[False, True], [True, True]]
        assert np.isfinite(found.stderr[found.valid]).all()
        with np.errstate(all="raise"):
            found = separate(parallel, crossed, variance=variance)
        assert found.valid.tolist() == [[False, True], [True, True]]
