"""Histograms of heights, of maps whose masks differ."""

from types import SimpleNamespace

import numpy as np

from model.skin import SkinMap
from reconstruction.pipeline.gradient import stages
from reconstruction.pipeline.gradient.images import SkinState
from reconstruction.pipeline.gradient.skin_strain import StateStrain
from reconstruction.registration.strain import Strain

SIDE, PIXEL_UM = 120, 6.0


def at_rest(name, step):
    still = Strain(np.eye(2), np.zeros(2), 1e-8 * np.eye(6), 0.05, 100, True)
    return StateStrain(SkinState(name, 0.0, step, 8.0, 0.1), 1.0, still)


def test_histograms_correct_counted_pixels_only():
    """Skin that the neutral map lacks has no effect, however noisy or deep its grooves are."""
    strains = [at_rest("rest", 0), at_rest("moved", 1)]
    rig = SimpleNamespace(pixel_um=PIXEL_UM)
    columns = np.arange(SIDE) * np.ones((SIDE, 1))
    stderr, left = np.ones((SIDE, SIDE), np.float32), columns < SIDE // 2
    relief = 10.0 * np.cos(0.4 * columns).astype(np.float32)

    def document(last, noise):
        height = np.where(columns < SIDE - 10, relief, last * relief).astype(np.float32)
        masks = {"rest": left, "moved": np.ones_like(left)}
        made = {
            f"height_{name}": SkinMap(height, "um", stderr, mask) for name, mask in masks.items()
        }
        made |= {
            f"_slope_error_{name}": np.where(left, 1e-3, noise).astype(np.float32) for name in masks
        }
        found = stages._histograms(rig, strains, **made)
        return found[stages.HISTOGRAM_FILE]

    expected = document(1.0, 1e-3)
    assert document(5.0, 1e-3) == expected
    assert document(1.0, 0.5) == expected
