"""Lights of a rendering: what words mean, what environments give."""

import numpy as np
import pytest

from capture.calibration.lights.light_list import LightTable
from capture.rig import load_rig
from model import store
from skinrig.errors import UnusableError, UsageError
from skinrig.rendering.lights import (
    Light,
    LightError,
    compute_pixel_directions,
    read_environment,
    sample_environment_lights,
)
from skinrig.rendering.request import RenderRig, parse_lights, parse_subpixels


@pytest.fixture
def stage():
    return RenderRig.of("dome", None)


def test_rig_light_is_at_nominal_position_and_scale(stage):
    lamp = stage.light("L017*0.5")
    drawn = load_rig("dome").light("L017")
    towards, white = lamp.directions_and_irradiance([[0.0, 0.0, 0.0]])
    np.testing.assert_allclose(lamp.position_mm, drawn.position_mm)
    np.testing.assert_allclose(white, 0.5)
    np.testing.assert_allclose(towards[0] @ drawn.position_mm, np.linalg.norm(drawn.position_mm))
    assert stage.assumed == ["light L017 is at its nominal position"]


def test_calibrated_light_matches_its_table_everywhere():
    rig = load_rig("dome").subset(lights=["L010", "L020"])
    nominal = LightTable.nominal(rig, white_per_s=3.0)
    lamp = Light.from_table(nominal, "L020", radius_mm=10.0)
    points = np.random.default_rng(0).normal(size=(20, 3)) * 80.0
    towards, white = lamp.directions_and_irradiance(points)
    expected_towards, expected = nominal.irradiance(points)
    np.testing.assert_allclose(towards, expected_towards[1], atol=1e-12)
    np.testing.assert_allclose(white, expected[1], rtol=1e-12)


@pytest.mark.parametrize(
    ("words", "place", "direction", "color"),
    [
        ("1,1,2", None, np.array([1, 1, 2]) / np.sqrt(6), (1, 1, 1)),
        ("at:300,200,600", (300, 200, 600), None, (1, 1, 1)),
        ("0,0,5*2,1,0.5", None, (0, 0, 1), (2, 1, 0.5)),
    ],
)
def test_lights_are_read_from_words(stage, words, place, direction, color):
    lamp = stage.light(words)
    assert lamp.intensity == color
    assert (lamp.position_mm is None) == (place is None)
    np.testing.assert_allclose(
        lamp.position_mm if direction is None else lamp.direction,
        place if direction is None else direction,
    )


@pytest.mark.parametrize("words", ["L999", "1,2", "at:1,2", "1,1,2*x", "1,1,2*-1", "0,0,nan"])
def test_unknown_light_names_are_refused(stage, words):
    with pytest.raises(UnusableError if words == "L999" else UsageError, match="--light"):
        stage.light(words)


@pytest.mark.parametrize("words", ["C99", "1,2", "front"])
def test_unknown_view_names_are_refused(stage, words):
    with pytest.raises(UsageError if "," in words else UnusableError, match="--view"):
        stage.camera(words, size_px=64)


def test_rig_view_keeps_field_at_any_size(stage):
    small, large = (stage.camera("C03", size_px=n) for n in (65, 650))
    assert small.image_size[0] == 65
    assert large.image_size[0] == 650
    corner = large.rays([[-0.5, -0.5]])
    np.testing.assert_allclose(small.rays([[-0.5, -0.5]]), corner, atol=1e-9)


def test_numbers_of_rays_are_squares():
    assert parse_subpixels(9) == 3
    for wrong in (0, 2, -4, 1024):
        with pytest.raises(UnusableError, match="--samples"):
            parse_subpixels(wrong)


@pytest.mark.parametrize(
    "fields",
    [
        {},
        {"position_mm": (1, 0, 0), "direction": (1, 0, 0)},
        {"direction": (0, 0, 0)},
        {"direction": (0, 0, 1), "intensity": (-1, 0, 0)},
        {"direction": (0, 0, 1), "radius": 1.0},
        {"position_mm": (0, 0, 0)},
        {"position_mm": (0, 0, np.nan)},
    ],
)
def test_a_light_that_cannot_shine_is_refused(fields):
    with pytest.raises(LightError):
        Light(name="wrong", **fields)


def test_environment_lights_give_its_irradiance_on_every_side():
    """Stratified draws: the sum over cosines has a few percent of noise with 400 lights."""
    towards, solid = compute_pixel_directions(32, 64)
    image = np.repeat(
        (1.0 + 20.0 * np.exp(30.0 * (towards @ [-0.6, 0.64, 0.48] - 1)))[..., None], 3, 2
    )
    image[..., 2] *= 0.5
    lights = sample_environment_lights(image, 400, rng=np.random.default_rng(1))
    ways = np.array([light.direction for light in lights])
    colors = np.array([light.intensity for light in lights])
    for normal in np.eye(3), -np.eye(3):
        for n in normal:
            true = np.einsum("hwc,hw->c", image, solid * np.maximum(towards @ n, 0.0)) / np.pi
            found = np.maximum(ways @ n, 0.0) @ colors
            np.testing.assert_allclose(found, true, rtol=0.1)


def test_environment_right_side_lights_left_of_facing_face():
    """Who stands inside and looks along +z has -x at the right hand."""
    image = np.zeros((16, 32, 3))
    image[8, 24] = 1.0
    (light,) = sample_environment_lights(image, 1, rng=np.random.default_rng(0))
    assert light.direction[0] < -0.98
    image = np.zeros((16, 32, 3))
    image[0, 3] = 1.0
    (light,) = sample_environment_lights(image, 1, rng=np.random.default_rng(0))
    assert light.direction[1] > 0.99


def test_the_same_seed_draws_the_same_lights():
    image = np.random.default_rng(0).random((8, 16, 3))
    one, two, other = (
        sample_environment_lights(image, 5, rng=np.random.default_rng(s)) for s in (1, 1, 2)
    )
    assert one == two
    assert one != other


@pytest.mark.parametrize("image", [np.ones((4, 8)), -np.ones((4, 8, 3)), np.zeros((4, 8, 3))])
def test_an_environment_without_light_is_refused(image):
    with pytest.raises(LightError, match="environment"):
        sample_environment_lights(image, 4, rng=np.random.default_rng(0))


def test_an_environment_is_read_from_a_file(tmp_path, stage):
    store.write_exr(tmp_path / "gray.exr", np.full((4, 8), 0.5, np.float32))
    assert read_environment(tmp_path / "gray.exr").shape == (4, 8, 3)
    found = parse_lights(
        stage,
        ["0,0,1"],
        radius_mm=None,
        environment=tmp_path / "gray.exr",
        environment_count=3,
        seed=0,
    )
    assert [light.name for light in found] == ["0,0,1"] + 3 * ["environment"]
    with pytest.raises(UsageError, match="got none"):
        parse_lights(stage, [], radius_mm=None, environment=None, environment_count=3, seed=0)
