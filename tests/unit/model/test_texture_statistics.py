import numpy as np
import pytest

from model import texture_statistics
from model.texture_space import TextureError, TextureSpace
from model.texture_statistics import describe, match


def texture(side, rng, *, angle_rad=0.0, strength=0.05, color=(0.55, 0.38, 0.28)):
    """A colored random texture with streaks at an angle, float32."""
    shape = (side, side) if np.isscalar(side) else side
    fy, fx = np.fft.fftfreq(shape[0])[:, None], np.fft.fftfreq(shape[1])[None, :]
    along = fx * np.cos(angle_rad) + fy * np.sin(angle_rad)
    across = fy * np.cos(angle_rad) - fx * np.sin(angle_rad)
    envelope = 1.0 / (1.0 + (along / 0.02) ** 2 + (across / 0.1) ** 2)
    layers = []
    for _ in range(3):
        noise = np.fft.ifft2(np.fft.fft2(rng.standard_normal(shape)) * envelope).real
        layers.append(noise / max(noise.std(), 1e-12))
    tint = np.array([[1.0, 1.0, 1.0], [0.1, -0.3, -0.1], [0.05, 0.05, -0.2]])
    return np.asarray(color * np.exp(strength * np.stack(layers, axis=-1) @ tint), np.float32)


def test_a_vector_is_93_histograms(rng):
    vector = describe(texture(64, rng))
    assert vector.shape == (23808,)
    assert vector.dtype == np.float64
    assert vector.min() >= 0.0
    np.testing.assert_allclose(vector.reshape(93, 256).sum(axis=1), 1.0, atol=1e-12)


def test_a_texture_that_matches_already_stays_as_it_is(rng):
    image = texture((96, 80), rng)
    space = TextureSpace.fit([image, texture(64, rng, angle_rad=1.0)])
    found = match(image, describe(image, space=space), space=space, iterations=3)
    assert np.abs(found.image - image).max() < 3e-6
    assert found.before.max() == 0.0
    assert found.after.max() < 2e-3


def test_matching_gives_an_image_the_statistics_of_another(rng):
    source, target = texture(128, rng, strength=0.03), texture(128, rng, angle_rad=1.0)
    space = TextureSpace.fit([source, target])
    found = match(source, describe(target, space=space), space=space, iterations=4)
    assert found.distances.shape == (5, 3, 31)
    assert found.after.mean() < 0.25 * found.before.mean()
    # the distances are those of the image that is returned
    again = texture_statistics.statistics(found.image, space=space).vector
    expected = texture_statistics.distance(
        space.histograms(again), space.histograms(describe(target, space=space)), space.edges
    )
    np.testing.assert_allclose(found.after, expected, atol=2e-3)


def test_an_empty_mask_is_named(rng):
    with pytest.raises(TextureError, match="no valid texel"):
        describe(texture(8, rng), valid=np.zeros((8, 8), bool))
