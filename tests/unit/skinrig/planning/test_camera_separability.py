"""Cameras that hardly separate blood from melanin are named before a session."""

import numpy as np
import pytest

from reconstruction.chromophores import ChromophoreError
from skinrig.planning.camera_separability import LOSS_RATIO, assess_camera


def test_sigma_camera_loses_blood_nikon_does_not():
    weak, usual = (
        assess_camera("Sigma SDMerill (NPL)", "D55"),
        assess_camera("Nikon 5100 (NPL)", "D55"),
    )
    assert "blood" in weak.loses
    assert usual.loses == ()
    assert weak.condition > LOSS_RATIO * usual.condition
    assert "blood +-" in weak.summary()
    assert "hardly" not in usual.summary()


def test_typical_camera_has_its_own_errors():
    found = assess_camera("Nikon 5100 (NPL)", "A")
    np.testing.assert_array_equal(found.melanin, found.typical_melanin)


def test_noise_raises_every_bound():
    quiet, loud = (
        assess_camera("linear sRGB", "D65", relative_noise=noise) for noise in (1e-3, 0.1)
    )
    assert (loud.melanin > quiet.melanin).all()
    assert (loud.blood > quiet.blood).all()


def test_noise_of_zero_is_refused():
    with pytest.raises(ChromophoreError, match="relative_noise"):
        assess_camera("linear sRGB", "D65", relative_noise=0.0)
