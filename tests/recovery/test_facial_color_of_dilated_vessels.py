"""The hemoglobin rig on states whose vessels dilated: no truth is a scale and a bias."""

import numpy as np
import pytest

from model.facial_color import HemoglobinRig, prediction_errors
from rigsim import subject

STATES = ("smile", "anger", "exercise")
RADIUS_PX = 8.0


@pytest.fixture(scope="module")
def face():
    return subject.make_subject("III", seed=3, size=128)


def errors(face, radius_px, moved_px=0):
    """Return errors of each state, its map displaced by some pixels before the fit."""
    neutral = face.hemoglobin()
    truth = {name: face.hemoglobin(name) for name in STATES}
    rig = HemoglobinRig.from_maps(
        neutral,
        {name: np.roll(h, moved_px, axis=1) for name, h in truth.items()},
        radius_px=radius_px,
    )
    return [
        prediction_errors.compare_prediction(rig.blend({n: 1.0}), truth[n], neutral) for n in STATES
    ]


def test_scale_and_bias_beat_gain_and_neutral_map(face):
    for found in errors(face, RADIUS_PX):
        assert found.predicted < 0.6 * found.one_gain < 0.6 * found.neutral_kept


def test_error_falls_with_the_radius_of_the_discs(face):
    by_radius = [np.mean([e.predicted for e in errors(face, r)]) for r in (32.0, 16.0, 8.0, 4.0)]
    assert by_radius == sorted(by_radius, reverse=True)
    assert by_radius[-1] < 0.5 * by_radius[0]


def test_small_misalignment_costs_little_large_costs_much(face):
    aligned, near, far = (
        np.mean([e.predicted for e in errors(face, RADIUS_PX, moved)]) for moved in (0, 1, 8)
    )
    assert near < 1.5 * aligned
    assert far > 2.0 * aligned


def test_mean_ratios_transfer_between_persons_absolute_means_fail(face):
    other = subject.make_subject("II", seed=7, size=128, mesh=face.mesh)
    rig = HemoglobinRig.from_maps(
        face.hemoglobin(), {"smile": face.hemoglobin("smile")}, radius_px=RADIUS_PX
    )
    found = {}
    for transfer in ("ratio", "absolute"):
        blend = rig.transfer_to(other.hemoglobin(), transfer=transfer).blend({"smile": 1.0})
        found[transfer] = prediction_errors.compare_prediction(
            blend, other.hemoglobin("smile"), other.hemoglobin()
        )
    # observation 3: the direction is shared between people, the pattern is their own
    assert found["ratio"].predicted < 0.6 * found["ratio"].neutral_kept
    assert found["absolute"].predicted > found["ratio"].predicted
