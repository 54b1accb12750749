"""Spots of the fibers are found by themselves, in order, with errors that hold."""

from types import SimpleNamespace

import numpy as np
import pytest

from capture.calibration.fiber import discs
from capture.calibration.fiber.merge import merge_series
from capture.calibration.fiber.spots import FiberSpotError, find_fiber_spots

SHORT_S = (0.01, 1.0, 30.0)


def merged(camera, light, times=SHORT_S):
    return merge_series(
        camera.series(light, times), times, darks=camera.darks(), noise=camera.noise
    )


def find_in(series, camera, **about):
    return find_fiber_spots(series, camera.nominal, names=camera.names, pattern="RGGB", **about)


def find(camera, light, **about):
    return find_in(merged(camera, light), camera, **about)


@pytest.fixture(scope="module")
def falling():
    return np.geomspace(1e5, 50.0, 28)[:, None] * np.array([0.6, 1.0, 0.5])


@pytest.fixture(scope="module")
def row(fiber_camera, falling):
    """A camera, the merged series of a row whose light falls, and the spots found in it."""
    camera = fiber_camera(np.random.default_rng(12345))
    series = merged(camera, falling)
    spots = find_in(series, camera)
    return SimpleNamespace(camera=camera, series=series, spots=spots)


def test_displaced_spots_on_rotated_row_found_within_errors(row):
    camera, spots = row.camera, row.spots
    assert spots.found.all()
    assert spots.findings == ()
    away = (spots.center_px - camera.places) / spots.center_stderr_px
    # 56 coordinates: five standard errors are exceeded once in 30,000 runs
    assert np.abs(away).max() < 5
    assert spots.center_stderr_px.max() < 0.05
    assert np.abs((spots.radius_px - 13.0) / spots.radius_stderr_px).max() < 5
    assert spots.radius_stderr_px.max() < 0.1
    assert spots.rotation_rad == pytest.approx(0.004, abs=1e-3)
    # an estimate that keeps to the nominal places would fail
    assert np.abs(camera.nominal - camera.places).max() > 1


@pytest.mark.parametrize("shift", [(5.0, 5.0), (-5.0, -5.0), (-15.0, 8.0)])
def test_row_shifted_as_whole_is_found(rng, fiber_camera, falling, shift):
    camera = fiber_camera(rng, shift=shift)
    spots = find(camera, falling)
    np.testing.assert_allclose(spots.center_px, camera.places, atol=0.1)
    np.testing.assert_allclose(spots.shift_px, shift, atol=1.0)


def test_dark_fiber_is_reported_at_its_expected_position(rng, fiber_camera, falling, caplog):
    light = falling.copy()
    light[11] = 0.0
    camera = fiber_camera(rng)
    spots = find(camera, light)
    assert np.flatnonzero(~spots.found).tolist() == [11]
    assert np.linalg.norm(spots.center_px[11] - camera.places[11]) < 4
    assert "F12" in spots.findings[0]
    assert "dark" in spots.findings[0]
    assert caplog.records == []  # all fits end before their limit


def test_foreign_spot_is_reported_with_position(rng, fiber_camera, falling):
    camera = fiber_camera(rng)
    camera.places[20, 1] -= 38.0
    other = fiber_camera(np.random.default_rng(3), places=camera.places)
    with pytest.raises(FiberSpotError, match=r"28 spots, of which 1 .*x 8\d\d, y 2\d px"):
        find(other, falling)


def test_missing_light_and_too_few_spots_are_distinguished(rng, fiber_camera, falling):
    camera = fiber_camera(rng)
    with pytest.raises(FiberSpotError, match="found none"):
        find(camera, np.zeros((28, 3)))
    light = falling.copy()
    light[9:] = 0.0
    with pytest.raises(FiberSpotError, match=r"found 9 .*expected 28"):
        find(camera, light)


@pytest.mark.long
def test_merging_spots_are_resolved_by_single_uncovered_frames(rng, fiber_camera):
    nominal = fiber_camera(rng, shift=(0, 0), turn_rad=0, jitter_px=0).places
    places = nominal.copy()
    places[8, 0] += 14.0
    places[9, 0] -= 14.0  # 14 px apart, each of a radius of 13
    camera = fiber_camera(rng, places=places)
    light = np.full((28, 3), 2e3)
    masks = {}
    for i in (8, 9):
        alone = np.zeros_like(light)
        alone[i] = light[i]
        masks[i] = merged(camera, alone, (0.1, 1.0))
    spots = find(camera, light, masks=masks)
    np.testing.assert_allclose(spots.center_px, places, atol=0.2)
    assert spots.overlapping[[8, 9]].all()
    assert any("F09 and F10: their spots overlap" in text for text in spots.findings)
    blind = find(camera, light)
    assert np.flatnonzero(~blind.found).tolist() == [8, 9]
    assert any("F09 and F10 end in one spot" in text for text in blind.findings)


def test_cover_over_wrong_fiber_is_error(row, falling):
    camera = row.camera
    alone = np.zeros_like(falling)
    alone[5] = falling[5]
    with pytest.raises(
        FiberSpotError, match="only F05 uncovered the brightest spot is that of F06"
    ):
        find_in(row.series, camera, masks={4: merged(camera, alone, (0.01, 0.1))})


def test_spots_that_have_moved_since_are_followed(rng, row, fiber_camera, falling):
    later = fiber_camera(rng, places=row.camera.places + np.array([1.3, -0.7]))
    followed, shift = row.spots.track(merged(later, falling), "RGGB")
    np.testing.assert_allclose(shift, [1.3, -0.7], atol=0.03)
    np.testing.assert_allclose(followed.center_px, later.places, atol=0.1)


def test_unfinished_fits_are_counted_in_one_warning(row, monkeypatch, caplog):
    monkeypatch.setattr(discs, "MAX_DISC_EVALUATIONS", 3)
    find_in(row.series, row.camera)
    (record,) = caplog.records
    assert "28 not converged" in record.getMessage()
