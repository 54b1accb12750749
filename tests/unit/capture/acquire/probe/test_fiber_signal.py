"""Assessment of a series of exposures so far: enough, hopeless, or to be continued."""

from functools import cache

import numpy as np
import pytest

from capture.acquire.probe.fiber_signal import FiberSignal, describe_fibers
from capture.plan.probe import exposure_series_s
from capture.rig import load_rig

RIG = load_rig("probe")
VIEW, PROBE = RIG.views[0], RIG.probe
SERIES_S = exposure_series_s(8, max_exposure_s=4.0, step_ev=1.0)
EVERY = len(SERIES_S)


@cache  # not when tests are read, which each process does
def spots():
    """Return the number of the fiber that lights each pixel, 28 for none, shape (H, W)."""
    rows, columns = np.mgrid[: VIEW.height_px, : VIEW.width_px]
    found = np.full(rows.shape, len(PROBE.fibers))
    for number, fiber in enumerate(PROBE.fibers):
        x, y = fiber.spot_px
        found[np.hypot(columns - x - 1, rows - y) < 8] = number
    return found


def frame(rates, exposure_s, rng, *, dark_e=0.0, hot=0):
    """Return DN of spots with so many full scales per second, (28,), alike in all colors."""
    electrons = dark_e * exposure_s + VIEW.full_well_e * exposure_s * np.append(rates, 0.0)[spots()]
    electrons = rng.poisson(np.minimum(electrons, 1e6)) + rng.normal(
        0.0, VIEW.read_noise_e, spots().shape
    )
    image = np.clip(np.round(VIEW.black_level + electrons / VIEW.gain_e_per_dn), 0, 4095)
    for number in range(hot):
        image[60 + number, 35 + 42 * number] = 4095
    return image.astype(np.uint16)


def looked(rates, rng, count=EVERY, **more):
    signal = FiberSignal(PROBE, VIEW)
    for exposure_s in SERIES_S[:count]:
        signal.add_exposure(frame(rates, exposure_s, rng, **more), exposure_s)
    return signal


def test_rate_uses_brightest_unsaturated_exposure(rng):
    rates = np.geomspace(10.0, 0.2, 28)
    signal = looked(rates, rng, dark_e=50.0)
    np.testing.assert_allclose(
        signal.rate_per_s, np.broadcast_to(rates[:, None], (28, 3)), rtol=0.06
    )
    assert signal.level.max() < 1.0


def test_series_continues_until_faintest_fiber_reaches_half_scale(rng):
    rates = np.geomspace(10.0, 0.8, 28)
    enough = [looked(rates, rng, count).verdict(SERIES_S[count:]).enough for count in range(1, 8)]
    # 0.8/s comes to a half at 0.63 s: the exposure of 1 s is the sixth
    assert enough == [False] * 5 + [True] * 2


def test_noise_is_never_enough_while_signal_may_hide(rng):
    rates = np.full(28, 5.0)
    rates[-1] = 2e-3
    assert not looked(rates, rng, 5).verdict(SERIES_S[5:]).enough


def test_signal_undetectable_in_remaining_exposures_is_abandoned_reported(rng):
    rates = np.full(28, 5.0)
    rates[-2:] = 0.0
    verdict = looked(rates, rng).verdict([1e-3])
    assert verdict.enough
    assert set(verdict.hopeless) == {(26, c) for c in range(3)} | {(27, c) for c in range(3)}
    assert describe_fibers(verdict.hopeless, PROBE) == (
        "red of F27, F28; green of F27, F28; blue of F27, F28"
    )


def test_fiber_saturated_in_shortest_exposure_is_distinguished(rng):
    rates = np.full(28, 5.0)
    rates[0] = 1e3
    verdict = looked(rates, rng, 5).verdict(SERIES_S[5:])
    assert verdict.enough
    assert {fiber for fiber, _ in verdict.saturated} == {0}
    assert verdict.hopeless == ()


def test_few_hot_pixels_are_not_signal(rng):
    clean = looked(np.full(28, 0.01), rng)
    hot = looked(np.full(28, 0.01), rng, hot=6)
    assert hot.level.max() == pytest.approx(clean.level.max(), rel=0.2)
    assert not hot.verdict([1.0]).saturated


def test_dark_current_is_not_signal(rng):
    signal = looked(np.zeros(28), rng, dark_e=300.0)
    assert np.abs(signal.signal_to_noise).max() < 6.0
    assert signal.level.max() < 0.03
