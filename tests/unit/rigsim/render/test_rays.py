"""Shadows on a texture whose edges alone get rays."""

import numpy as np
import pytest

from rigsim.render import Caster, texture_visibility, visibility
from rigsim.subject.person import make_subject

pytestmark = pytest.mark.render


@pytest.mark.parametrize("light_mm", [(300.0, 200.0, 900.0), (800.0, 0.0, 100.0)])
def test_texture_visibility_equals_that_of_all_texels(light_mm):
    """Of 65,536 texels a few are alone in shadow, where no coarse texel is."""
    face = make_subject("III", seed=0, size=256)
    atlas, caster = face.atlas, Caster(face.mesh)
    seen = (caster, atlas.position_mm, atlas.normal, light_mm)
    every = visibility(*seen, radius_mm=20.0, samples=4)
    fewer = texture_visibility(*seen, radius_mm=20.0, samples=4)
    wrong = np.abs(every - fewer) > 0.0
    assert 0.1 < every.mean() < 0.95
    assert wrong.mean() < 1e-3
