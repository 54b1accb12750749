"""A faulty rig is named, and none without a fault."""

import numpy as np
import pytest

from reconstruction.fusion.consistency import RigCheck, check_rigs, name_faulty_rig
from reconstruction.fusion.person import POPULATION_MEAN, Regions, estimate_person
from reconstruction.fusion.signals import RigBands, residual_covariance, skin_of_person
from reconstruction.fusion.texels import OffsetModel

CAMERA = "Nikon 5100 (NPL)"
RIGS = (RigBands("dome", CAMERA, "LED-B3"), RigBands("flash", CAMERA, "D55"))


def checks_with(gain, seed):
    """Agreement of two rigs on one drawn face, of which one has a gain."""
    rng = np.random.default_rng(seed)
    skin = POPULATION_MEAN + rng.standard_normal(2) * [0.4, 0.3]
    unexplained = residual_covariance(RIGS, skin)
    calibration = np.zeros((6, 6))
    calibration[:3, :3] = 0.01**2
    calibration[3:, 3:] = 0.1**2
    calibration += 0.004**2 * np.eye(6)
    errors = OffsetModel(unexplained, calibration, 0.25 * unexplained)
    own = skin_of_person(skin, 0.5 * rng.standard_normal(6))
    model = [rig.log_signals(own) for rig in RIGS]
    offset = np.linalg.cholesky(errors.offset_covariance) @ rng.standard_normal(6)
    regions = Regions((np.concatenate(model) + offset + gain)[None], errors.local[None])
    person = estimate_person(RIGS, regions, errors.offset_covariance)
    return check_rigs(RIGS, regions, errors, person)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("rig", [0, 1])
def test_check_white_balance_names_its_rig(rig, seed):
    gain = np.zeros(6)
    gain[3 * rig : 3 * rig + 3] = 0.2, 0.0, -0.2
    found = name_faulty_rig(checks_with(gain, seed))
    assert found is not None
    assert found.rig == RIGS[rig].rig
    assert found.p_value < 1e-4
    # the difference of its channels is known better than their level
    difference = found.log_gain[0] - found.log_gain[2]
    assert 0.25 < difference < 0.55


@pytest.mark.parametrize("seed", range(4))
def test_check_stated_errors_name_none(seed):
    assert name_faulty_rig(checks_with(np.zeros(6), seed)) is None


def test_check_single_rig_has_none():
    errors = OffsetModel(*(1e-4 * np.eye(3) for _ in range(3)))
    regions = Regions(np.log([[0.37, 0.27, 0.22]]), 1e-4 * np.eye(3)[None])
    person = estimate_person(RIGS[:1], regions, errors.offset_covariance)
    assert check_rigs(RIGS[:1], regions, errors, person) == ()


def test_description_states_channel_and_size():
    check = RigCheck("flash", 0.97, np.array([0.0, -0.1, 0.0]), np.full(3, 0.02), 1e-6)
    assert check.describe("diffuse light").startswith("flash: diffuse light green 10 % too low, 5")
