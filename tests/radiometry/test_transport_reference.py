"""Light that skin reflects onto skin against Mitsuba's path tracer."""

import numpy as np
import pytest

from skinrig.benchmarks.dome.transport import build_cases
from skinrig.rendering.transport import SkinExchange


@pytest.mark.long
def test_paths_agree_with_mitsuba_on_a_head():
    # one head lit from below, 48 px: light from the skin is 2 to 3 % of all
    case = build_cases(["I"], ["below"], width_px=48, texels=64, samples=256)[0]
    direct = case.render(None)
    exchange = SkinExchange.of(case.surface, case.caster, samples=64)
    found, true = case.render(exchange) - direct, case.reference - direct
    skin = case.skin
    # standard error of the reference's mean, and the elements' size of some millimeters
    assert found[skin].mean() == pytest.approx(true[skin].mean(), rel=0.08)
    assert np.corrcoef(found[skin].ravel(), true[skin].ravel())[0, 1] > 0.9
    # without the paths that end at the lamps' highlights a third of the light is missing
    matt = exchange.scatter(np.zeros((len(exchange.met), 3)))
    assert np.all(matt.entered == 0.0)
