import errno
import json
from dataclasses import replace
from datetime import date

import numpy as np
import OpenEXR
import pytest

from capture.calibration import store
from capture.calibration.store import Calibration, Quantity


@pytest.fixture
def calibration(rng_image):
    return Calibration(
        kind="sensor",
        rig="flash",
        serials=("N5100-1",),
        created=date(2026, 11, 1),
        valid_until=date(2027, 1, 30),
        source="simulated",
        values={
            "N5100-1": {
                "gain_e_per_dn": Quantity([2.5, 2.6, 2.4], [0.01, 0.02, 0.01]),
                "full_well_e": Quantity(38000.0, 120.0, (37760.0, None)),
                "levels": Quantity(8.0),
            }
        },
        maps={"shading": rng_image},
        notes={"colors": "R G B"},
        inputs={"dark-0": store.digest_arrays(rng_image)},
        versions={"skinrig": "0.1"},
    )


@pytest.fixture
def rng_image():
    return np.random.default_rng(3).normal(1.0, 0.1, (7, 5, 3)).astype(np.float32)


def _rewrite(path, change, *, reseal=True):
    document = json.loads(path.read_text())
    change(document)
    if reseal:
        document["sha256"] = store._seal(document)
    path.write_text(json.dumps(document))


def test_saved_calibration_is_loaded_exactly(calibration, tmp_path):
    store.save(calibration, tmp_path)
    loaded = store.load(tmp_path, "sensor")
    for name, quantity in calibration.values["N5100-1"].items():
        other = loaded.quantity("N5100-1", name)
        np.testing.assert_array_equal(other.value, quantity.value)
        assert (other.stderr is None) == (quantity.stderr is None)
        assert other.interval == quantity.interval
    np.testing.assert_array_equal(loaded.maps["shading"], calibration.maps["shading"])
    assert (loaded.rig, loaded.serials, loaded.source) == ("flash", ("N5100-1",), "simulated")
    assert (loaded.created, loaded.valid_until) == (date(2026, 11, 1), date(2027, 1, 30))
    assert loaded.inputs == calibration.inputs
    assert loaded.notes == calibration.notes


def test_saving_again_replaces_file_without_stale_maps(calibration, tmp_path):
    store.save(calibration, tmp_path)
    second = Calibration(
        **{
            **{f: getattr(calibration, f) for f in calibration.__dataclass_fields__},
            "maps": {"shading": calibration.maps["shading"] + 1},
        }
    )
    store.save(second, tmp_path)
    assert sorted(p.suffix for p in tmp_path.iterdir()) == [".exr", ".json"]
    np.testing.assert_array_equal(
        store.load(tmp_path, "sensor").maps["shading"], calibration.maps["shading"] + 1
    )


def test_a_failed_write_keeps_the_old_calibration(calibration, tmp_path, monkeypatch):
    path = store.save(calibration, tmp_path)
    before = path.read_bytes()

    def full_disk(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(store.os, "replace", full_disk)
    with pytest.raises(OSError, match="No space"):
        store.save(calibration, tmp_path)
    assert path.read_bytes() == before
    assert not list(tmp_path.glob("*.part*"))


def test_calibration_of_other_rig_or_device_is_refused(calibration):
    today = date(2026, 11, 21)
    assert store.require_valid(calibration, rig="flash", serials=["N5100-1"], on_date=today)
    with pytest.raises(store.CalibrationMismatch, match="rig 'dome'"):
        store.require_valid(calibration, rig="dome", serials=["N5100-1"], on_date=today)
    with pytest.raises(store.CalibrationMismatch, match="calibrate these devices"):
        store.require_valid(calibration, rig="flash", serials=["N5100-2"], on_date=today)
    with pytest.raises(store.CalibrationMismatch, match="expected 'color'"):
        store.require_valid(
            calibration, rig="flash", serials=["N5100-1"], on_date=today, kind="color"
        )


@pytest.mark.parametrize("day", [date(2026, 10, 31), date(2027, 1, 31)])
def test_a_calibration_outside_its_dates_is_refused(calibration, day):
    with pytest.raises(store.CalibrationExpired, match="skinrig calibrate sensor"):
        store.require_valid(calibration, rig="flash", serials=["N5100-1"], on_date=day)
    assert issubclass(store.CalibrationExpired, ValueError)


def test_missing_kind_error_names_calibration_command(tmp_path):
    with pytest.raises(store.CalibrationMissing, match="skinrig calibrate color"):
        store.load(tmp_path, "color")


def test_single_altered_number_is_detected(calibration, tmp_path):
    path = store.save(calibration, tmp_path)

    def nudge(document):
        document["values"]["N5100-1"]["gain_e_per_dn"]["value"][0] += 1e-9

    _rewrite(path, nudge, reseal=False)
    with pytest.raises(store.CalibrationDamaged, match="altered"):
        store.load(tmp_path, "sensor")


def test_single_altered_pixel_is_detected(calibration, tmp_path):
    store.save(calibration, tmp_path)
    exr = next(tmp_path.glob("*.exr"))
    other = Calibration(
        **{
            **{f: getattr(calibration, f) for f in calibration.__dataclass_fields__},
            "maps": {"shading": calibration.maps["shading"] * np.float32(1.0001)},
        }
    )
    store.save(other, tmp_path / "other")
    exr.write_bytes(next((tmp_path / "other").glob("*.exr")).read_bytes())
    with pytest.raises(store.CalibrationDamaged, match="digest"):
        store.load(tmp_path, "sensor")


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda d: d.update(schema="skinrig.calibration/3"), "skinrig.calibration/3"),
        (lambda d: d.update(surprise=1), "surprise"),
        (lambda d: d.pop("rig"), "rig"),
        (lambda d: d.update(created="yesterday"), "calibrate again"),
        (lambda d: d.update(valid_until="2020-01-01"), "valid_until"),
        (lambda d: d["values"]["N5100-1"]["levels"].update(shape=[3]), "shape"),
        (lambda d: d["values"]["N5100-1"]["levels"].update(value=["8"]), "number"),
        (lambda d: d["maps"]["shading"].update(file="../shading.exr"), "is outside the folder"),
        (lambda d: d["maps"]["shading"].update(file="sensor-none.exr"), "missing"),
        (lambda d: d.update(source="guessed"), "measured"),
    ],
)
def test_broken_file_gives_single_named_error(calibration, tmp_path, change, says):
    path = store.save(calibration, tmp_path)
    _rewrite(path, change)
    with pytest.raises(store.CalibrationDamaged, match=says):
        store.load(tmp_path, "sensor")


@pytest.mark.parametrize("content", [b"", b"{", b"\xff\xfe", b"[]", b"{}", b"[" * 100_000])
def test_content_that_is_not_calibration_gives_named_error(tmp_path, content):
    (tmp_path / "color.json").write_bytes(content)
    with pytest.raises(store.CalibrationDamaged, match=r"color\.json"):
        store.load(tmp_path, "color")


def test_drift_is_counted_in_combined_standard_errors(calibration):
    fields = {f: getattr(calibration, f) for f in calibration.__dataclass_fields__}
    fields["values"] = {
        "N5100-1": {
            "gain_e_per_dn": Quantity([2.5, 2.6, 2.5], [0.01, 0.02, 0.01]),
            "levels": Quantity(9.0),
        }
    }
    rows = store.measure_drift(calibration, Calibration(**fields))
    assert rows[0].name == "gain_e_per_dn[2]"
    assert rows[0].sigmas == pytest.approx(0.1 / np.hypot(0.01, 0.01))
    assert "+7.1 sigma" in str(rows[0])
    assert rows[-1].name == "levels"
    assert rows[-1].sigmas is None


def test_drift_between_different_kinds_is_refused(calibration):
    fields = {f: getattr(calibration, f) for f in calibration.__dataclass_fields__}
    with pytest.raises(store.CalibrationMismatch, match="one kind"):
        store.measure_drift(calibration, Calibration(**{**fields, "kind": "color"}))


def test_not_a_number_never_enters_a_calibration():
    with pytest.raises(ValueError, match="finite"):
        Quantity([1.0, np.nan])
    with pytest.raises(ValueError, match="stderr"):
        Quantity([1.0, 2.0], [0.1])


@pytest.mark.parametrize("before", [False, True])
@pytest.mark.parametrize("failing", ["image", "document"])
def test_full_disk_leaves_nothing_half_written(calibration, tmp_path, monkeypatch, failing, before):
    folder = tmp_path / "calibration"
    if before:
        store.save(calibration, folder)
    kept = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    changed = replace(calibration, maps={"shading": calibration.maps["shading"] + 1})

    def full(*arguments):
        raise error

    error: Exception
    if failing == "image":
        error = RuntimeError("Failed to write pixel data. No space left on device.")
        monkeypatch.setattr(OpenEXR.File, "write", full)
    else:
        error = OSError(errno.ENOSPC, "No space left on device")
        monkeypatch.setattr(store, "_write_atomically", full)
    with pytest.raises((store.CalibrationError, OSError), match="No space left"):
        store.save(changed, folder)
    assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == kept
    assert folder.exists() == before
