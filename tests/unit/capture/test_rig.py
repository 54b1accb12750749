"""Rig files: geometry, strictness, and messages that say everything at once."""

import dataclasses
import json
import pickle

import numpy as np
import pytest

from capture.rig import Light, RigError, is_id, load_rig, rig_from_json


@pytest.fixture
def flash():
    return load_rig("flash")


@pytest.fixture
def flash_json(flash):
    return json.loads(json.dumps(flash.to_json()))


def test_flashes_are_fourteen_degrees_from_camera(flash):
    camera = np.array(flash.view("cam").position_mm)
    for light in flash.lights:
        position = np.array(light.position_mm)
        cosine = camera @ position / np.linalg.norm(camera) / np.linalg.norm(position)
        assert np.degrees(np.arccos(cosine)) == pytest.approx(14.0, abs=0.01)
        assert np.linalg.norm(position) == pytest.approx(1000.0, rel=1e-3)


def test_camera_images_face_with_six_megapixels(flash):
    view = flash.view("cam")
    width_mm, height_mm = view.field_mm
    assert (view.width_px, view.height_px) == (3024, 2016)
    assert width_mm == pytest.approx(260, abs=2)
    assert height_mm == pytest.approx(width_mm * 2016 / 3024)


def test_image_axes_are_right_handed_with_y_up(flash):
    right, up, back = map(np.array, flash.view("cam").axes)
    np.testing.assert_allclose((right, up, back), np.eye(3), atol=1e-15)


@pytest.mark.parametrize("width_px", [16, 504, 1512, 3024])
def test_a_resized_rig_keeps_its_field_of_view(flash, width_px):
    small = flash.resized(width_px).view("cam")
    assert small.field_mm[0] == pytest.approx(flash.view("cam").field_mm[0])
    # whole even rows: the height is off by less than one row of the small image
    row_mm = small.field_mm[1] / small.height_px
    assert abs(small.field_mm[1] - flash.view("cam").field_mm[1]) <= row_mm
    assert small.height_px % 2 == 0


@pytest.mark.parametrize("factor", [0.0, -1.0, float("nan"), float("inf")])
def test_iso_that_is_not_positive_is_refused(flash, factor):
    assert flash.at_iso(1.0) == flash
    with pytest.raises(RigError, match="a number above 0"):
        flash.at_iso(factor)


def test_a_rig_survives_its_json(flash, flash_json):
    assert rig_from_json(flash_json) == flash


def test_a_rig_is_frozen(flash):
    with pytest.raises(dataclasses.FrozenInstanceError):
        flash.recycle_s = 0.0


def test_all_file_faults_are_listed_with_paths(tmp_path, flash):
    file = tmp_path / "broken.toml"
    text = (
        'name = "flash"\nboxes = []\nwavelength = 3\n'
        '[[lights]]\nname = "a"\nposition_mm = [0.0, 0.0]\npolarizer_axis_deg = 200\n'
        "energy_ws = 1\nradius_mm = -1\n"
        '[[lights]]\nname = "b"\nposition_mm = [0, 0, nan]\npolarizer_axis_deg = 20\n'
        "energy_ws = 1\nradius_cm = 1\n"
    )
    file.write_text(text)
    with pytest.raises(RigError) as caught:
        load_rig(file)
    message = str(caught.value)
    assert message.startswith(str(file))
    paths = {fault.path for fault in caught.value.faults}
    assert {"wavelength", "views", "recycle_s", "lights[1].position_mm[2]"} <= paths
    assert {"lights[0].position_mm[2]", "lights[1].radius_cm", "lights[1].radius_mm"} <= paths
    assert "did you mean radius_mm? (x10)" in message


@pytest.mark.parametrize(
    ("wrong", "suggestion"),
    [
        ("pixel_nm", "did you mean pixel_um? (x0.001)"),
        ("focal_m", "did you mean focal_mm? (x1000)"),
        ("readout_ms", "did you mean readout_s? (x0.001)"),
        ("focal", "did you mean focal_mm? (in mm)"),
        ("f_numbr", "did you mean f_number?"),
        ("analyzer_axis_rad", "did you mean analyzer_axis_deg? (x57.2958)"),
    ],
)
def test_a_near_miss_is_suggested_with_its_factor(flash_json, wrong, suggestion):
    flash_json["views"][0][wrong] = 1.0
    with pytest.raises(RigError) as caught:
        rig_from_json(flash_json, where="some.toml")
    assert suggestion in str(caught.value)
    assert f"views[0].{wrong}" in str(caught.value)


@pytest.mark.parametrize(
    ("field", "value", "expected"),
    [
        ("cfa", "RGBG", "RGGB"),
        ("width_px", 3025, "even"),
        ("width_px", 10**9, "65535"),
        ("black_level", 20_000, "white_level"),
        ("white_level", 70_000, "<= 16383"),
        ("focal_mm", 0.0, "> 0"),
        ("focal_mm", "87", "number"),
        ("up", [0.0, 0.0, 1.0], "optical axis"),
        ("name", "../cam", "A-Z"),
        ("full_well_e", float("inf"), "finite"),
        ("readout_s", True, "number"),
    ],
)
def test_a_value_out_of_range_is_named(flash_json, field, value, expected):
    flash_json["views"][0][field] = value
    with pytest.raises(RigError) as caught:
        rig_from_json(flash_json)
    assert [fault.path for fault in caught.value.faults] == [f"views[0].{field}"] or (
        field == "black_level" and caught.value.faults[0].path == "views[0].white_level"
    )
    assert expected in str(caught.value)


@pytest.mark.parametrize(
    ("content", "reason"),
    [(b"name = [", "is not TOML"), (b"\xff\xfe", "is not TOML"), (b"", "faults")],
)
def test_file_that_is_not_rig_gives_single_error(tmp_path, content, reason):
    file = tmp_path / "rig.toml"
    file.write_bytes(content)
    with pytest.raises(RigError, match=reason):
        load_rig(file)


def test_error_code_ends_message_and_survives_pickle(tmp_path):
    with pytest.raises(RigError) as caught:
        load_rig(tmp_path / "none.toml")
    assert str(caught.value).endswith("[SR-CLI-012]")
    copy = pickle.loads(pickle.dumps(caught.value))
    assert (copy.code, str(copy)) == ("SR-CLI-012", str(caught.value))


def test_unknown_name_errors_list_valid_names(flash):
    with pytest.raises(RigError, match="did you mean flash"):
        load_rig("flahs")
    with pytest.raises(RigError, match="file not found"):
        load_rig("nowhere/rig.toml")
    with pytest.raises(RigError, match="did you mean cam"):
        flash.view("camm")
    with pytest.raises(RigError, match="left, right"):
        flash.light("top")


def test_two_lights_of_same_name_are_refused(flash_json):
    flash_json["lights"][1]["name"] = "LEFT"
    with pytest.raises(RigError, match="names that differ"):
        rig_from_json(flash_json)


@pytest.mark.parametrize("text", ["", ".", "..", "a/b", "a\\b", "a b", "ä", "x" * 65, "a+b", "a@b"])
def test_an_id_can_never_leave_its_folder(text):
    assert not is_id(text)


def test_dome_has_150_leds_16_cameras_none_occluded():
    dome = load_rig("dome")
    leds = np.array([light.position_mm for light in dome.lights])
    cameras = np.array([view.position_mm for view in dome.views])
    assert len(leds) == 150
    assert len(cameras) == 16
    apart = np.arccos(
        (cameras / np.linalg.norm(cameras, axis=1)[:, None])
        @ (leds / np.linalg.norm(leds, axis=1)[:, None]).T
    )
    assert np.degrees(apart.min()) > 4.0


def test_light_is_flash_or_led_not_both():
    with pytest.raises(RigError, match="one of the two"):
        Light(name="a", position_mm=(0, 0, 1), energy_ws=1.0, power_w=1.0, radius_mm=1.0)
    with pytest.raises(RigError, match="one of the two"):
        Light(name="a", position_mm=(0, 0, 1), radius_mm=1.0)


def test_an_led_without_lobe_shines_the_same_everywhere():
    led = Light(name="a", position_mm=(0, 0, 1), power_w=1.0, radius_mm=1.0)
    assert led.intensity(3.0) == 1.0


def test_subset_keeps_rig_order_and_refuses_foreign_name():
    dome = load_rig("dome")
    few = dome.subset(lights=["L007", "L003"], views=["C01"])
    assert [light.name for light in few.lights] == ["L003", "L007"]
    assert [view.name for view in few.views] == ["C01"]
    with pytest.raises(RigError, match="L7"):
        dome.subset(lights=["L7"])
