"""Choice of the ground-truth map that an expression's blood volume fraction is compared with."""

import numpy as np
import pytest

from model.skin import MAP_UNITS, SkinAppearance, SkinMap
from skinrig.evaluating.facial_color import true_blood

MOVED = ("hemoglobin", "hemoglobin_at_rest")
SPREAD = ("hemoglobin_blurred", "hemoglobin_blurred_at_rest")


@pytest.mark.parametrize(
    ("state", "names", "taken"),
    [
        ("neutral", ("hemoglobin",), "hemoglobin"),
        ("neutral", ("hemoglobin", "hemoglobin_blurred"), "hemoglobin_blurred"),
        ("smile", MOVED, "hemoglobin_at_rest"),
        ("smile", (*MOVED, *SPREAD), "hemoglobin_blurred_at_rest"),
        # blurred as it moved alone: the sharp one at rest goes with no blurred neutral one
        ("smile", (*MOVED, "hemoglobin_blurred"), None),
        ("smile", ("hemoglobin",), None),
    ],
)
def test_true_blood_is_scattered_consistently_across_states(state, names, taken):
    maps = {
        name: SkinMap(np.full((2, 2), number, np.float32), MAP_UNITS["hemoglobin"])
        for number, name in enumerate(names)
    }
    truth = SkinAppearance(maps, "simulated", parameters={"kind": "truth", "state": state})
    assert true_blood(truth) is (None if taken is None else maps[taken])
