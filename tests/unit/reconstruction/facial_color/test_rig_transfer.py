"""A hemoglobin rig carried to a face that stands elsewhere in its picture."""

import numpy as np
import pytest

from model.facial_color.rig import HemoglobinRig
from reconstruction.facial_color.rig_transfer import RigTransferError, transfer_rig

SHAPE = (96, 80)
MARKS = {
    "a": (12.0, 10.0),
    "b": (66.0, 12.0),
    "c": (40.0, 50.0),
    "d": (14.0, 84.0),
    "e": (68.0, 82.0),
    "f": (40.0, 20.0),
    "g": (25.0, 60.0),
    "h": (56.0, 62.0),
}


def face(seed=0):
    """Blood with a patch that reddens by half, and the map of the factor."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    factor = 1.0 + 0.5 * np.exp(-((x - 40.0) ** 2 + (y - 50.0) ** 2) / (2 * 14.0**2))
    return 0.02 + 0.002 * rng.standard_normal(SHAPE), factor


def elsewhere(points):
    """The same points in a picture twice as large, shifted by 61 and 9 px."""
    return {name: (2.0 * x + 61.0, 2.0 * y + 9.0) for name, (x, y) in points.items()}


def test_reddening_patch_transfers_to_same_landmark():
    neutral, factor = face()
    rig = HemoglobinRig.from_maps(neutral, {"blush": neutral * factor}, radius_px=5.0)
    shape = (220, 200)
    there = transfer_rig(rig, shape, landmarks_rig=MARKS, landmarks_onto=elsewhere(MARKS))
    other = np.full(shape, 0.03) + 0.003 * np.random.default_rng(9).standard_normal(shape)
    found = there.transfer_to(other).evaluate({"blush": 1.0})
    ratio = np.where(found.valid, found.hemoglobin / other, np.nan)

    def near(x, y, ratio=ratio):
        return float(np.nanmedian(ratio[int(y) - 3 : int(y) + 4, int(x) - 3 : int(x) + 4]))

    x, y = elsewhere({"c": (40.0, 50.0)})["c"]
    assert near(x, y) == pytest.approx(1.5, abs=0.06)
    assert near(*elsewhere({"b": (66.0, 12.0)})["b"]) == pytest.approx(1.0, abs=0.06)
    # without landmarks the patch would lie in the middle of the other picture
    plain = rig.transfer_to(other).evaluate({"blush": 1.0})
    assert near(x, y, plain.hemoglobin / other) < 1.4


def test_the_radius_grows_with_the_face():
    neutral, factor = face()
    rig = HemoglobinRig.from_maps(neutral, {"blush": neutral * factor}, radius_px=5.0)
    there = transfer_rig(rig, (220, 200), landmarks_rig=MARKS, landmarks_onto=elsewhere(MARKS))
    assert there.radius_px == pytest.approx(10.0, rel=0.05)


def test_region_outside_rig_mask_stays_unknown():
    neutral, factor = face()
    seen = np.ones(SHAPE, bool)
    seen[:30] = False
    rig = HemoglobinRig.from_maps(neutral, {"blush": neutral * factor}, radius_px=5.0, valid=seen)
    there = transfer_rig(rig, SHAPE, landmarks_rig=MARKS, landmarks_onto=MARKS)
    assert not there.states["blush"].valid[:20].any()
    assert there.states["blush"].valid[50:80, 10:70].all()


def test_too_few_common_names_are_refused():
    neutral, factor = face()
    rig = HemoglobinRig.from_maps(neutral, {"blush": neutral * factor}, radius_px=5.0)
    few = {name: MARKS[name] for name in "abc"}
    with pytest.raises(RigTransferError, match="3 names"):
        transfer_rig(rig, SHAPE, landmarks_rig=MARKS, landmarks_onto=few)
    line = {name: (float(k), float(k)) for k, name in enumerate(MARKS)}
    with pytest.raises(RigTransferError, match="landmarks"):
        transfer_rig(rig, SHAPE, landmarks_rig=line, landmarks_onto=line)
