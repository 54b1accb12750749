"""Calibrations of a sphere: written, read again, and refused where they do not belong."""

import dataclasses
from datetime import date, timedelta

import numpy as np
import pytest

from capture.calibration import store
from capture.calibration.led_sphere.lights import (
    SphereCalibration,
    SphereLightTable,
    SpherePolarizers,
)
from capture.calibration.record import Quantity
from capture.rig import load_rig

RIG = load_rig("gradient")
MADE = date(2026, 11, 21)


def table(rng):
    nominal = SphereLightTable.nominal(RIG)
    n = len(nominal.names)
    valid = rng.random(n) > 0.1
    return dataclasses.replace(
        nominal,
        directions_stderr=rng.uniform(0, 1e-3, (n, 3)),
        intensities=rng.uniform(0.5, 1.5, n),
        intensities_stderr=rng.uniform(0, 0.01, n),
        seen=np.ones(n, bool),
        valid=valid,
        dead=valid & (rng.random(n) > 0.9),
    )


def films(rng):
    n = len(RIG.lights)
    return SpherePolarizers(
        tuple(light.name for light in RIG.lights),
        *rng.uniform(0, 0.01, (4, n)),
        *rng.uniform(-0.01, 0.01, (1, n)),
        *rng.uniform(0, 0.01, (1, n)),
        np.ones(n, bool),
        0.01,
        0.001,
        5e-4,
        1e-5,
        3e-4,
        1e-5,
        1.4,
    )


def written(folder, rng):
    lights, leaks = table(rng), films(rng)
    about = {"rig": "gradient", "source": "simulated", "created": MADE}
    ball = {"radius_mm": Quantity(np.array(6.0), np.array(0.01))}
    store.save(lights.to_calibration(**about, ball=ball), folder)
    store.save(leaks.to_calibration(**about, serial="SG-0001"), folder)
    return lights, leaks


def test_sphere_calibration_round_trips_through_file(tmp_path, rng):
    lights, leaks = written(tmp_path, rng)
    found = SphereCalibration.load(tmp_path, RIG, on=MADE)
    for name in (
        "directions",
        "directions_stderr",
        "intensities",
        "intensities_stderr",
        "seen",
        "valid",
        "dead",
    ):
        np.testing.assert_array_equal(getattr(found.lights, name), getattr(lights, name))
    for field in dataclasses.fields(SpherePolarizers):
        np.testing.assert_array_equal(
            getattr(found.polarizers, field.name), getattr(leaks, field.name)
        )
    np.testing.assert_array_equal(found.usable, lights.valid & ~lights.dead)


def test_light_subset_comes_in_rig_order(tmp_path, rng):
    lights, _ = written(tmp_path, rng)
    some = RIG.subset(lights=["G100", "G003"])
    found = SphereCalibration.load(tmp_path, some)
    assert found.lights.names == ("G003", "G100")
    np.testing.assert_array_equal(found.lights.intensities, lights.intensities[[3, 100]])


def test_other_rig_camera_and_day_are_refused(tmp_path, rng):
    written(tmp_path, rng)
    with pytest.raises(store.CalibrationMismatch, match="other"):
        SphereCalibration.load(tmp_path, dataclasses.replace(RIG, name="other"))
    views = (dataclasses.replace(RIG.views[0], serial="SG-0002"),)
    with pytest.raises(store.CalibrationMismatch, match="SG-0002"):
        SphereCalibration.load(tmp_path, dataclasses.replace(RIG, views=views))
    with pytest.raises(store.CalibrationExpired):
        SphereCalibration.load(tmp_path, RIG, on=MADE + timedelta(days=400))
    with pytest.raises(store.CalibrationMissing):
        SphereCalibration.load(tmp_path / "none", RIG)


def test_invalid_light_table_is_refused(rng):
    lights = table(rng)
    with pytest.raises(ValueError, match="unit vectors"):
        dataclasses.replace(lights, directions=2 * lights.directions)
    with pytest.raises(ValueError, match="intensities"):
        dataclasses.replace(lights, intensities=lights.intensities[:5])
    with pytest.raises(ValueError, match="leakage"):
        dataclasses.replace(films(rng), leakage=-np.ones(len(RIG.lights)))
