"""Parts of a moving face in one folder: each fit adds its own and leaves the others."""

import hashlib

import numpy as np
import pytest

from model import store
from model.skin import SkinAppearance, SkinMap
from skinrig.appearances import dynamic
from skinrig.appearances.dynamic import FACIAL_COLOR, MICROSTRUCTURE, DynamicAppearanceError


def part(value: float, name: str = "a", source: str = "measured") -> SkinAppearance:
    maps = {f"map_{name}": SkinMap(np.full((4, 4), value, np.float32), "1")}
    return SkinAppearance(
        maps,
        source,
        {"value": value},
        {"session": name},
        files={f"{name}.json": b"{}"},
        left_out=((name, "because"),),
    )


def test_part_replaces_older_version_and_keeps_others(tmp_path):
    out = tmp_path / "moving"
    dynamic.add(out, FACIAL_COLOR, part(1.0))
    dynamic.add(out, MICROSTRUCTURE, part(2.0, "b"))
    dynamic.add(out, FACIAL_COLOR, part(3.0, "c"))
    appearance, parts = dynamic.read(out)
    assert set(parts) == {FACIAL_COLOR, MICROSTRUCTURE}
    assert set(appearance.maps) == {"map_b", "map_c"}
    assert set(appearance.files) == {"b.json", "c.json"}
    assert parts[FACIAL_COLOR]["value"] == 3.0
    assert dict(appearance.inputs) == {"facial_color: session": "c", "microstructure: session": "b"}
    assert sorted(appearance.left_out) == [
        ("facial_color: c", "because"),
        ("microstructure: b", "because"),
    ]


def test_simulated_part_makes_whole_appearance_simulated(tmp_path):
    dynamic.add(tmp_path / "m", FACIAL_COLOR, part(1.0))
    assert store.read(tmp_path / "m").source == "measured"
    dynamic.add(tmp_path / "m", MICROSTRUCTURE, part(2.0, "b", "simulated"))
    assert store.read(tmp_path / "m").source == "simulated"


def test_a_folder_of_other_maps_is_left_untouched(tmp_path):
    out = tmp_path / "maps"
    store.write(out, SkinAppearance({}, "measured", parameters={"kind": "appearance"}))
    before = hashlib.sha256((out / store.DOCUMENT_FILE).read_bytes()).hexdigest()
    with pytest.raises(DynamicAppearanceError, match="it was not changed"):
        dynamic.add(out, FACIAL_COLOR, part(1.0))
    with pytest.raises(DynamicAppearanceError, match="it was not changed"):
        dynamic.check_target(out)
    assert hashlib.sha256((out / store.DOCUMENT_FILE).read_bytes()).hexdigest() == before


def test_same_map_in_two_parts_is_refused(tmp_path):
    dynamic.add(tmp_path / "m", FACIAL_COLOR, part(1.0))
    with pytest.raises(DynamicAppearanceError, match=r"a\.json"):
        dynamic.add(tmp_path / "m", MICROSTRUCTURE, part(2.0))
    assert set(dynamic.read(tmp_path / "m")[1]) == {FACIAL_COLOR}


def test_folder_without_part_names_command_to_make_one(tmp_path):
    dynamic.add(tmp_path / "m", FACIAL_COLOR, part(1.0))
    with pytest.raises(DynamicAppearanceError, match="skinrig fit microstructure"):
        dynamic.read(tmp_path / "m", parts=(MICROSTRUCTURE,))
