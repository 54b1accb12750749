"""The homogeneous medium nearest to tissue that is none, over readings of any kind."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from model import photon_table
from reconstruction import subsurface

FEW = settings(derandomize=True, deadline=None, max_examples=6, database=None)


@FEW
@given(
    sigma_a=st.floats(0.02, 0.3),
    sigma_s=st.floats(0.8, 3.0),
    factor=st.floats(0.3, 1.0),
    bad=st.sampled_from([None, np.nan, np.inf, 0.0]),
)
def test_the_nearest_medium_of_a_medium_is_itself(sigma_a, sigma_s, factor, bad):
    radius = np.linspace(0.3, 7.05, 28)
    profile = factor * photon_table.reflectance(
        radius, sigma_a, sigma_s, collection="fiber", core_mm=0.2
    )
    variance = (0.005 * profile) ** 2
    valid = np.ones(28, bool)
    if bad is not None:
        profile[7], valid[7] = bad, False
    fit = subsurface.nearest_medium(radius, profile, variance=variance, core_mm=0.2, valid=valid)
    assert bool(fit.valid)
    truth = np.sqrt(3.0 * sigma_a * (sigma_a + sigma_s))
    assert abs(np.log(fit.sigma_tr_per_mm / truth)) < 0.1


@FEW
@given(level=st.sampled_from([0.0, 5e-324, 1e-200, -1.0]))
def test_no_medium_is_nearest_to_darkness(level):
    radius = np.linspace(0.3, 7.05, 28)
    fit = subsurface.nearest_medium(
        radius, np.full(28, level), variance=np.full(28, 1e-12), core_mm=0.2
    )
    assert not fit.valid
