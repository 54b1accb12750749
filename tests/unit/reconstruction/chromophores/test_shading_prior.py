import numpy as np
import pytest

from reconstruction.chromophores import model_error, shading_prior
from reconstruction.chromophores.shading_prior import (
    ShadingPrior,
    ShadingPriorError,
    lognormal_prior,
    prior_from_histogram,
)


def test_face_prior_has_mean_and_width_of_data():
    found = model_error.load_shading_histogram()
    places = found.low + found.step * (np.arange(len(found.counts)) + 0.5)
    counts = np.array(found.counts, float)
    mean = np.average(places, weights=counts)
    spread = np.sqrt(np.average((places - mean) ** 2, weights=counts))
    prior = shading_prior.face_prior()
    assert prior.mean == pytest.approx(mean, abs=0.01)
    # what is not expected widens it: 0.99 s^2 + 0.01 * 1.5^2, and the softness
    assert prior.sd == pytest.approx(np.sqrt(0.99 * (spread**2 + 0.1**2) + 0.01 * 1.5**2), rel=0.01)


def test_skin_rarely_exceeds_white_reference_light_often_less():
    prior = shading_prior.face_prior()
    more = prior.density[prior.nodes > np.log(1.3)].sum() * prior.step
    less = prior.density[prior.nodes < np.log(0.7)].sum() * prior.step
    assert more < 0.03
    assert less > 0.3


def test_an_unknown_exposure_adds_its_spread():
    prior = shading_prior.face_prior()
    wide = prior.broaden(1.0)
    assert wide.mean == pytest.approx(prior.mean, abs=0.01)
    assert wide.sd == pytest.approx(np.hypot(prior.sd, 1.0), rel=0.01)
    assert wide.density.sum() * wide.step == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: lognormal_prior(0.0, 0.5), "center, spread"),
        (lambda: lognormal_prior(0.7, 0.5).broaden(0.0), "log_sd"),
        (lambda: ShadingPrior(0.0, 0.1, np.array([1.0, 0.0])), "density"),
        (lambda: ShadingPrior(0.0, -0.1, np.ones(3)), "step"),
        (lambda: prior_from_histogram(-1.0, 0.1, [0, 0]), "counts"),
        (lambda: prior_from_histogram(-9.0, 0.1, [1, 1]), "bins"),
    ],
)
def test_invalid_distribution_is_refused(make, message):
    with pytest.raises(ShadingPriorError, match=message):
        make()
