import dataclasses
from datetime import date

import numpy as np
import pytest
from scipy.stats import binom

from capture.calibration import store
from capture.calibration.sensor.noise_model import SensorCalibration, calibrate_sensor
from capture.calibration.sensor.transfer_curve import FlatPair, PhotonTransferError, cfa_offsets


@dataclasses.dataclass(frozen=True)
class Bench:
    """A sensor in front of an evenly lit target: shot noise, PRNU, read noise, full well, ADC."""

    gain: float = 2.5  # e/DN
    read_noise: float = 6.0  # e
    black: float = 512.0
    white: int = 16383
    full_well: float = 60000.0
    prnu: float = 0.008
    dsnu: float = 1.5  # DN
    dark: float = 0.0  # e/s
    vignetting: float = 0.25  # loss at the corner
    nonlinearity: float = 0.0
    flash_jitter: float = 0.005
    color: tuple[float, float, float] = (0.6, 1.0, 0.45)
    shape: tuple[int, int] = (128, 192)
    pattern: str = "RGGB"

    def fixed_pattern(self, rng):
        v, u = np.mgrid[-1 : 1 : self.shape[0] * 1j, -1 : 1 : self.shape[1] * 1j]
        self_response = 1 + self.prnu * rng.normal(size=self.shape)
        return (
            self_response * (1 - self.vignetting * (u**2 + v**2) / 2),
            self.dsnu * rng.normal(size=self.shape),
        )

    def frame(self, light, fixed, rng, *, exposure_s=0.01):
        response, offset = fixed
        electrons = light * response * 36000.0
        if self.pattern != "MONO":
            filters = np.ones(self.shape)
            for c, positions in enumerate(cfa_offsets(self.pattern).values()):
                for row, column in positions:
                    filters[row::2, column::2] = self.color[c]
            electrons = electrons * filters
        electrons = electrons * (1 + self.nonlinearity * electrons / 36000.0)
        if light > 0:
            electrons = electrons * (1 + self.flash_jitter * rng.normal())
        electrons = rng.poisson(electrons + self.dark * exposure_s)
        electrons = np.minimum(electrons, self.full_well)
        electrons = electrons + self.read_noise * rng.normal(size=self.shape)
        dn = np.rint(electrons / self.gain + self.black + offset)
        return np.clip(dn, 0, self.white).astype(np.uint16)

    def calibrate(self, rng, *, levels=8, top=0.95, darks=4, exposures_s=None, **kwargs):
        fixed = self.fixed_pattern(rng)
        light = np.linspace(top / levels, top, levels)
        pairs = [FlatPair(self.frame(x, fixed, rng), self.frame(x, fixed, rng), x) for x in light]
        times = [0.01] * darks if exposures_s is None else exposures_s
        return calibrate_sensor(
            pairs,
            [self.frame(0.0, fixed, rng, exposure_s=t) for t in times],
            white_dn=self.white,
            pattern=self.pattern,
            dark_exposures_s=exposures_s,
            **kwargs,
        )


def sigmas(quantity, truth):
    return (quantity.value - truth) / quantity.stderr


@pytest.fixture(scope="module")
def calibrations():
    bench = Bench(shape=(96, 128))
    return [
        bench.calibrate(np.random.default_rng([7, seed]), levels=6, block=8) for seed in range(36)
    ]


def outside_interval(count_inside, count, share=0.6827, false_alarm=1e-3):
    """Whether so many estimates within one standard error contradict a coverage of 68 %."""
    low, high = binom.ppf([false_alarm / 2, 1 - false_alarm / 2], count, share)
    return not low <= count_inside <= high


@pytest.mark.parametrize(
    ("name", "truth"),
    [
        ("gain_e_per_dn", 2.5),
        ("read_noise_e", 6.0),
        ("prnu", 0.008),
        ("dsnu_dn", 1.5),
        ("nonlinearity", 0.0),
    ],
)
def test_stated_errors_cover_truth_in_68_percent(calibrations, name, truth):
    """Rationale: one standard error must hold 68 % of the truths.

    Expected: 108 estimates (36 seeds x 3 colors) per quantity; false-alarm rate 1e-3 per quantity.
    Colors share darks and flash jitter only in the nonlinearity, so that one color is judged there.
    """
    z = np.array([sigmas(getattr(c, name), truth) for c in calibrations])
    if name == "nonlinearity":
        z = z[:, 1]
    inside = int((np.abs(z) < 1).sum())
    assert not outside_interval(inside, z.size), f"{inside} of {z.size} inside, z sd {z.std():.2f}"
    assert np.abs(z).max() < 5


def test_coverage_test_fails_for_gain_two_percent_off(calibrations):
    z = np.array([sigmas(c.gain_e_per_dn, 2.5 * 1.02) for c in calibrations])
    assert outside_interval(int((np.abs(z) < 1).sum()), z.size)


def test_gain_error_falls_with_root_of_pixel_count():
    """Expected: 4 x the pixels, 1/2 the stated error, within 15 % (it is a smooth function)."""
    errors = [
        Bench(shape=shape)
        .calibrate(np.random.default_rng(1), levels=6, block=8)
        .mean_gain_e_per_dn()
        .stderr
        for shape in ((96, 128), (192, 256))
    ]
    assert errors[0] / errors[1] == pytest.approx(2.0, rel=0.15)


def test_the_variance_follows_the_line_of_photon_transfer(calibrations):
    """chi2/dof of about 500 blocks has a standard deviation near 0.06; 36 x 3 of them average."""
    chi2 = np.array([c.chi2_per_dof for c in calibrations])
    assert abs(chi2.mean() - 1.0) < 0.05


def test_full_well_is_found_where_variance_collapses():
    bench = Bench(full_well=24000.0, color=(1.0, 1.0, 1.0))
    result = bench.calibrate(np.random.default_rng(3), levels=12, top=1.3)
    assert result.saturated_by == ("full well",) * 3
    np.testing.assert_allclose(result.full_well_e.value, 24000.0, rtol=0.03)
    assert np.abs(sigmas(result.full_well_e, 24000.0)).max() < 4
    assert np.abs(sigmas(result.gain_e_per_dn, 2.5)).max() < 4


def test_white_level_is_found_at_converter_limit():
    bench = Bench(full_well=1e9, color=(1.0, 1.0, 1.0))
    result = bench.calibrate(np.random.default_rng(3), levels=12, top=1.6)
    assert result.saturated_by == ("white level",) * 3
    np.testing.assert_allclose(result.saturation_dn.value, 16383, atol=1)
    assert np.abs(sigmas(result.gain_e_per_dn, 2.5)).max() < 4


def test_a_sensor_never_saturated_states_a_bound_only():
    result = Bench().calibrate(np.random.default_rng(3), top=0.5)
    assert result.saturated_by == ("not reached",) * 3


def test_the_flat_field_takes_the_vignetting_out():
    """Expected: shading of 25 % known to 0.3 % everywhere from 0.1 million photons a block."""
    bench = Bench(vignetting=0.25)
    result = bench.calibrate(np.random.default_rng(5))
    v, u = np.mgrid[-1 : 1 : bench.shape[0] * 1j, -1 : 1 : bench.shape[1] * 1j]
    truth = 1 - bench.vignetting * (u**2 + v**2) / 2
    np.testing.assert_allclose(result.flat_mosaic(*bench.shape), truth, rtol=0.004)
    assert result.flat_mosaic(*bench.shape).min() < 0.8


def test_nonlinear_sensor_is_detected_and_linear_is_not():
    """A response losing 3 % at full signal is found with the right size, well outside its error."""
    q = {}
    for bend in (0.0, -0.03):
        bench = Bench(nonlinearity=bend, flash_jitter=0.001, color=(1.0, 1.0, 1.0), vignetting=0.0)
        q[bend] = bench.calibrate(np.random.default_rng(8)).nonlinearity
    assert np.abs(sigmas(q[0.0], 0.0)).max() < 4
    np.testing.assert_allclose(q[-0.03].value, -0.03 * 0.95, atol=0.004)
    assert np.abs(sigmas(q[-0.03], 0.0)).min() > 5


def test_dark_current_comes_from_darks_of_several_times():
    bench = Bench(dark=40.0)
    result = bench.calibrate(
        np.random.default_rng(2), exposures_s=[0.01, 0.01, 2.0, 2.0, 8.0, 8.0], darks=6
    )
    assert result.dark_e_per_s is not None
    assert np.abs(sigmas(result.dark_e_per_s, 40.0)).max() < 4
    assert Bench().calibrate(np.random.default_rng(2)).dark_e_per_s is None


def test_hot_pixels_are_omitted():
    bench = Bench(prnu=0.0)
    rng = np.random.default_rng(4)
    response, offset = bench.fixed_pattern(rng)
    offset[10:14, 20] = 4000.0
    pairs = [
        FlatPair(*(bench.frame(x, (response, offset), rng) for _ in range(2)), x)
        for x in np.linspace(0.1, 0.9, 6)
    ]
    darks = [bench.frame(0.0, (response, offset), rng) for _ in range(4)]
    result = calibrate_sensor(pairs, darks, white_dn=bench.white)
    assert result.hot_pixels == 4
    assert np.abs(sigmas(result.black_dn, 512.0)).max() < 5
    assert np.abs(sigmas(result.gain_e_per_dn, 2.5)).max() < 4


def test_monochrome_sensor_is_single_color():
    result = Bench(pattern="MONO").calibrate(np.random.default_rng(6))
    assert result.colors == ("MONO",)
    assert np.abs(sigmas(result.gain_e_per_dn, 2.5)).max() < 4


def test_noise_profile_predicts_frame_variance(calibrations):
    scale, offset = calibrations[0].noise_profile()
    span = 16383 - 512
    assert scale == pytest.approx(1 / (2.5 * span), rel=0.05)
    assert offset == pytest.approx(((6.0 / 2.5) ** 2 + 1 / 12) / span**2, rel=0.05)


def test_a_sensor_calibration_survives_the_disk(calibrations, tmp_path):
    calibration = calibrations[0].to_calibration(
        serial="N1", rig="flash", source="simulated", created=date(2026, 11, 21)
    )
    store.save(calibration, tmp_path)
    again = SensorCalibration.from_calibration(store.load(tmp_path, "sensor"), "N1")
    np.testing.assert_array_equal(again.gain_e_per_dn.value, calibrations[0].gain_e_per_dn.value)
    np.testing.assert_array_equal(again.flat_mosaic(20, 30), calibrations[0].flat_mosaic(20, 30))
    assert again.saturated_by == calibrations[0].saturated_by
    assert again.dark_e_per_s is None


def _frames(n, value=600):
    return [np.full((64, 64), value, dtype=np.uint16) for _ in range(n)]


@pytest.mark.parametrize(
    ("pairs", "darks", "says"),
    [
        (lambda: [FlatPair(*_frames(2), 1.0)] * 4, lambda: _frames(2), "amounts of light"),
        (lambda: [FlatPair(*_frames(2), x) for x in (1.0, 2.0, 3.0)], lambda: _frames(1), "darks"),
        (
            lambda: [FlatPair(*_frames(2), x) for x in (1.0, 2.0, 3.0)],
            lambda: [np.zeros((64, 66), np.uint16)] * 2,
            "shapes",
        ),
        (
            lambda: [FlatPair(*_frames(2, 600 + int(x)), x) for x in (1.0, 2.0, 3.0)],
            lambda: _frames(2, 512),
            "take flats at 8",
        ),
        (
            lambda: [FlatPair(*_frames(2, 16383), x) for x in (1.0, 2.0, 3.0)],
            lambda: _frames(2, 512),
            "below saturation",
        ),
        (
            lambda: [
                FlatPair(_frames(1, 1000)[0], _frames(1, 9000)[0], x) for x in (1.0, 2.0, 3.0)
            ],
            lambda: _frames(2, 512),
            "same light",
        ),
    ],
)
def test_unusable_frames_error_names_required_frames(pairs, darks, says):
    with pytest.raises(PhotonTransferError, match=says):
        calibrate_sensor(pairs(), darks(), white_dn=16383)


def test_identical_frames_are_not_pair():
    ramp = np.linspace(0, 1, 128)[None, :] * np.ones((128, 1))
    pairs = [
        FlatPair(*[(512 + x * 14000 * ramp).astype(np.uint16)] * 2, x) for x in (0.3, 0.6, 0.9)
    ]
    with pytest.raises(PhotonTransferError, match="identical"):
        calibrate_sensor(pairs, [np.full((128, 128), 512, np.uint16)] * 2, white_dn=16383)


def test_denoised_frames_are_refused_as_processed():
    """The same small noise at every level, as after a denoiser, has no photon transfer slope."""
    rng = np.random.default_rng(9)
    ramp = np.linspace(0, 1, 128)[None, :] * np.ones((128, 1))

    def frame(x):
        return np.rint(512 + x * 14000 * ramp + 2 * rng.normal(size=ramp.shape)).astype(np.uint16)

    pairs = [FlatPair(frame(x), frame(x), x) for x in (0.3, 0.6, 0.9)]
    with pytest.raises(PhotonTransferError, match="does not grow"):
        calibrate_sensor(pairs, [frame(0.0), frame(0.0)], white_dn=16383)
