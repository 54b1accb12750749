"""Histograms and noise of heights, of maps whose masks differ."""

from types import SimpleNamespace

import numpy as np

from model.skin import SkinMap
from reconstruction.gradient_normals import SphereLights
from reconstruction.pipeline.gradient import stages
from reconstruction.pipeline.gradient.images import SkinState
from reconstruction.pipeline.gradient.skin_strain import StateStrain
from reconstruction.registration.strain import Strain

SIDE, PIXEL_UM = 120, 6.0


def at_rest(name, step):
    still = Strain(np.eye(2), np.zeros(2), 1e-8 * np.eye(6), 0.05, 100, True)
    return StateStrain(SkinState(name, 0.0, step, 8.0, 0.1), 1.0, still)


def test_histograms_correct_counted_pixels_only(rng):
    """Skin that the neutral map lacks has no effect, however noisy or deep its grooves are."""
    strains = [at_rest("rest", 0), at_rest("moved", 1)]
    lights = rng.standard_normal((60, 3))
    lights /= np.linalg.norm(lights, axis=1, keepdims=True)
    rig = SimpleNamespace(pixel_um=PIXEL_UM, lights=SphereLights(lights))
    columns = np.arange(SIDE) * np.ones((SIDE, 1))
    stderr, left = np.ones((SIDE, SIDE), np.float32), columns < SIDE // 2
    relief = 10.0 * np.cos(0.4 * columns).astype(np.float32)

    def document(last, noise):
        # deeper than the rest of the relief, so that it casts no shadow onto the counted pixels
        height = np.where(columns < SIDE - 10, relief, last * relief - 200.0).astype(np.float32)
        masks = {"rest": left, "moved": np.ones_like(left)}
        made = {
            f"height_{name}": SkinMap(height, "um", stderr, mask) for name, mask in masks.items()
        }
        made |= {
            f"_slope_noise_{name}": np.where(left, 1e-3, noise).astype(np.float32) for name in masks
        }
        found = stages._histograms(rig, strains, SimpleNamespace(alpha=0.25), **made)
        return found[stages.HISTOGRAM_FILE]

    expected = document(1.0, 1e-3)
    assert document(5.0, 1e-3) == expected
    assert document(1.0, 0.5) == expected


def test_height_noise_without_pixels_is_zero(rng):
    shape = (20, 20)
    restored = SimpleNamespace(sample_noise=lambda rng: rng.standard_normal((2, *shape)))

    def relief(field, valid):
        return SimpleNamespace(height=np.zeros(shape))

    stderr, noise = stages._height_noise(restored, np.zeros(shape, bool), relief, PIXEL_UM)
    assert np.isinf(stderr).all()
    assert not noise.any()
