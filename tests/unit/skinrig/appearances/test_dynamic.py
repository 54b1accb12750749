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


def test_a_part_replaces_its_older_self_and_keeps_the_others(tmp_path):
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


def test_simulated_data_in_any_part_makes_the_whole_simulated(tmp_path):
    dynamic.add(tmp_path / "m", FACIAL_COLOR, part(1.0))
    assert store.read(tmp_path / "m").source == "measured"
    dynamic.add(tmp_path / "m", MICROSTRUCTURE, part(2.0, "b", "simulated"))
    assert store.read(tmp_path / "m").source == "simulated"


def test_a_folder_of_other_maps_is_left_untouched(tmp_path):
    out = tmp_path / "maps"
    store.write(out, SkinAppearance({}, "measured", parameters={"kind": "appearance"}))
    before = hashlib.sha256((out / store.DOCUMENT_FILE).read_bytes()).hexdigest()
    with pytest.raises(DynamicAppearanceError, match="nothing was touched"):
        dynamic.add(out, FACIAL_COLOR, part(1.0))
    with pytest.raises(DynamicAppearanceError, match="nothing was touched"):
        dynamic.check_target(out)
    assert hashlib.sha256((out / store.DOCUMENT_FILE).read_bytes()).hexdigest() == before


def test_two_parts_cannot_share_a_map(tmp_path):
    dynamic.add(tmp_path / "m", FACIAL_COLOR, part(1.0))
    with pytest.raises(DynamicAppearanceError, match=r"a\.json"):
        dynamic.add(tmp_path / "m", MICROSTRUCTURE, part(2.0))
    assert set(dynamic.read(tmp_path / "m")[1]) == {FACIAL_COLOR}


def test_a_folder_without_the_part_names_the_command_that_makes_it(tmp_path):
    dynamic.add(tmp_path / "m", FACIAL_COLOR, part(1.0))
    with pytest.raises(DynamicAppearanceError, match="skinrig fit microstructure"):
        dynamic.read(tmp_path / "m", parts=(MICROSTRUCTURE,))
