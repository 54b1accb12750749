"""Faults that maps of a light stack still have, by what was corrected."""

from types import SimpleNamespace

import numpy as np
import pytest

from reconstruction.pipeline import light_stack
from reconstruction.stack_diagnosis import Diagnosis
from reconstruction.stack_diagnosis.finding import Finding


@pytest.mark.parametrize(
    ("kept", "faults"), [(4, ("near lights",)), (3, ("moved image", "near lights"))]
)
def test_corrected_orders_are_not_remaining_faults(kept, faults, monkeypatch):
    """The order is used with any number of images; images are left out if four remain."""
    out = np.arange(7) >= kept
    order = np.arange(7)[::-1]
    findings = tuple(
        Finding(fault, (), "", 1.0, 1.0, "")
        for fault in ("order of lights", "swapped lights", "moved image", "near lights")
    )
    vectors = np.eye(3)[np.arange(7) % 3]
    found = Diagnosis(findings, order, out, vectors, np.ones(7))
    monkeypatch.setattr(light_stack, "_listed_lights", lambda *_: (vectors, False, 1.0))
    monkeypatch.setattr(light_stack, "_diagnose", lambda *_, near: found)
    extra = {"light_list": {}}
    session = SimpleNamespace(manifest=SimpleNamespace(extra=extra))
    inputs = SimpleNamespace(session=session, assumed=[], noted={})
    lights = light_stack._lights(inputs, None)
    assert inputs.noted["image_faults"] == list(faults)
    np.testing.assert_array_equal(lights.vectors, vectors[order])
    np.testing.assert_array_equal(lights.alive, ~out if kept >= 4 else np.ones(7, bool))
