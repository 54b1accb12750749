"""Images of a dome session: exposures merged, darks off, in fractions of full scale per second."""

from datetime import UTC, datetime

import numpy as np
import pytest

from capture import raw
from capture.plan import Plan, Step
from capture.rig import load_rig
from capture.session import Session, SubjectRecord
from reconstruction.pipeline.dome.images import DomeImage, DomeImages
from reconstruction.pipeline.inputs import InputsError
from reconstruction.pipeline.sensor_noise import ElectronNoise

RIG = load_rig("dome").subset(lights=["L000", "L001"], views=["C00"]).resized(24)
VIEW = RIG.views[0]
SPAN = VIEW.white_level - VIEW.black_level
RATE = np.array([2.0, 3.0, 1.0])
"""Of the scene's colors, fractions of full scale per second."""
LONG_S, SHORT_S = 0.4, 0.1


def mosaic(rate, seconds, rng, *, ambient=0.0):
    """Draw the DN of an even scene; `rate` are the three colors."""
    colors = {"R": rate[0], "G": rate[1], "B": rate[2]}
    signal = np.empty((VIEW.height_px, VIEW.width_px))
    for cell, letter in enumerate(VIEW.cfa):
        signal[cell // 2 :: 2, cell % 2 :: 2] = (colors[letter] + ambient) * seconds
    electrons = rng.poisson(signal * VIEW.full_well_e)
    dn = (
        VIEW.black_level
        + (electrons + rng.normal(0, VIEW.read_noise_e, signal.shape)) / VIEW.gain_e_per_dn
    )
    return np.clip(np.rint(dn), 0, VIEW.white_level).astype(np.uint16)


def make(path, rng, *, ambient=0.0, darks=0, profile=True):
    steps = [
        Step(
            f"O{k}",
            "olat",
            {"light": "L000", "exposure": k, "pass": 0},
            {"light": "L000", "exposure_s": s, "level": 1.0},
            ("C00",),
        )
        for k, s in enumerate((LONG_S, SHORT_S))
    ]
    steps += [
        Step(f"D{k}", "dark", {"repeat": k}, {"exposure_s": LONG_S}, ("C00",)) for k in range(darks)
    ]
    noise = raw.noise_profile(
        VIEW.gain_e_per_dn, VIEW.read_noise_e, black=VIEW.black_level, white=VIEW.white_level
    )
    with Session.create(
        path,
        plan=Plan("dome", tuple(steps)),
        rig=RIG,
        devices={},
        subject=SubjectRecord("P1", ("research",)),
        source="simulated",
        seed=0,
        now=lambda: datetime(2026, 11, 21, tzinfo=UTC),
    ) as session:
        for step in steps:
            seconds = float(step.settings["exposure_s"])
            lit = RATE if step.kind == "olat" else np.zeros(3)
            blob = raw.encode_dng(
                mosaic(lit, seconds, rng, ambient=ambient),
                pattern=VIEW.cfa,
                black=VIEW.black_level,
                white=VIEW.white_level,
                exposure_s=seconds,
                noise_profile=noise if profile else None,
                camera_serial=VIEW.serial,
                step_id=step.id,
                session_id=session.id,
            )
            session.commit(
                step.id, "C00", blob, settings=step.settings, actual={}, t_box_s=1.5, t_host_s=2.0
            )
        session.close()
    return Session.open(path)


def test_two_exposures_give_rate_despite_saturated_long_exposure(tmp_path, rng):
    # red fills 80 %, green 120 % of the range in the long exposure
    images = DomeImages(make(tmp_path / "s", rng))
    image = images.image("C00", "L000")
    assert (images.views, images.lights) == (("C00",), ("L000",))
    assert image.rgb.shape == (VIEW.height_px // 2, VIEW.width_px // 2, 3)
    assert image.valid.all()
    pixels = image.valid.size
    for band in range(3):
        error = image.rgb[..., band].mean() - RATE[band]
        # neighbours share pixels: at most (1 + 2 * 0.3)^2 times the variance of as many independent
        spread = np.sqrt(image.variance[..., band].mean() / pixels) * 1.6
        assert abs(error) < 4 * spread  # 1 false alarm in 15,000 a channel


def test_the_variance_is_that_of_repeated_captures(tmp_path, rng):
    shots = [DomeImages(make(tmp_path / f"s{k}", rng)).image("C00", "L000") for k in range(40)]
    seen = np.var([shot.rgb for shot in shots], axis=0, ddof=1).mean(axis=(0, 1))
    said = np.mean([shot.variance for shot in shots], axis=(0, 1, 2))
    # 39 degrees of freedom at some 100 nearly independent pixels know a variance to 2.3 %
    np.testing.assert_allclose(said, seen, rtol=0.1)


def test_room_light_is_subtracted_with_darks(tmp_path, rng):
    with_darks = DomeImages(make(tmp_path / "a", rng, ambient=0.2, darks=4)).image("C00", "L000")
    without = DomeImages(make(tmp_path / "b", rng, ambient=0.2)).image("C00", "L000")
    assert with_darks.rgb[..., 2].mean() == pytest.approx(RATE[2], abs=0.02)
    assert without.rgb[..., 2].mean() == pytest.approx(RATE[2] + 0.2, abs=0.02)
    assert with_darks.variance.mean() > without.variance.mean()


def test_sensor_of_unknown_noise_is_reported_calibrated_not(tmp_path, rng):
    session = make(tmp_path / "s", rng, profile=False)
    with pytest.raises(InputsError, match="calibrate the sensor"):
        DomeImages(session).image("C00", "L000")
    noise = {VIEW.serial: ElectronNoise(VIEW.gain_e_per_dn, VIEW.read_noise_e)}
    assert DomeImages(session, noise=noise).image("C00", "L000").valid.all()


def test_missing_session_frames_are_reported(tmp_path, rng):
    images = DomeImages(make(tmp_path / "s", rng))
    with pytest.raises(InputsError, match="lacks camera C00, light L001"):
        images.image("C00", "L001")
    with pytest.raises(InputsError, match="no frames of kind 'mirror'"):
        DomeImages(images._session, kind="mirror")


def test_first_sensor_cell_center_is_first_pixel():
    np.testing.assert_array_equal(DomeImage.from_sensor_px(np.array([0.5, 0.5])), [0.0, 0.0])


def test_times_are_controller_times(tmp_path, rng):
    assert DomeImages(make(tmp_path / "s", rng)).times_s("C00", "L000") == (1.5, 1.5)


def test_exposures_of_a_moving_subject_stay_apart(tmp_path, rng):
    images = DomeImages(make(tmp_path / "s", rng), merge=False)
    assert images.captures == (("L000", 0), ("L000", 1))
    long, short = (images.image("C00", "L000", k) for k in (0, 1))
    assert not long.valid.any()  # green is saturated
    assert short.valid.all()
    assert short.rgb[..., 1].mean() == pytest.approx(RATE[1], rel=0.02)
