import json

import numpy as np
import pytest

from model import store
from model.skin import MAP_UNITS, SkinAppearance, SkinMap


@pytest.fixture
def appearance(rng):
    melanin = rng.uniform(0, 0.5, (5, 7)).astype(np.float32)
    valid = rng.random((5, 7)) > 0.3
    melanin[~valid] = np.nan
    return SkinAppearance(
        maps={
            "melanin": SkinMap(melanin, MAP_UNITS["melanin"], np.full((5, 7), 0.01), valid),
            "diffuse": SkinMap(rng.random((5, 7, 3)), "1", description="camera RGB"),
        },
        source="simulated",
        parameters={"iterations": 4},
        inputs={"session": "ab12"},
        left_out=(("normals", "not wanted"),),
        files={"mesh.ply": b"ply not really"},
        seed=7,
    )


def test_written_appearance_reads_back_equal(tmp_path, appearance):
    back = store.read(store.write(tmp_path / "a", appearance))
    for name, written in appearance.maps.items():
        np.testing.assert_array_equal(back.maps[name].values, written.values)
        assert back.maps[name].unit == written.unit
    np.testing.assert_array_equal(back.maps["melanin"].valid, appearance.maps["melanin"].valid)
    np.testing.assert_array_equal(back.maps["melanin"].stderr, appearance.maps["melanin"].stderr)
    assert back.maps["diffuse"].stderr is None
    assert (back.source, back.seed, back.left_out) == ("simulated", 7, appearance.left_out)
    assert back.parameters == {"iterations": 4}
    assert back.files == appearance.files


def test_folder_is_replaced_whole_without_leftovers(tmp_path, appearance):
    store.write(tmp_path / "a", appearance)
    store.write(tmp_path / "a", SkinAppearance({}, "measured"))
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a"]
    assert sorted(p.name for p in (tmp_path / "a").iterdir()) == [store.DOCUMENT_FILE]


def test_a_failed_write_leaves_the_old_folder(tmp_path, appearance):
    store.write(tmp_path / "a", appearance)
    bad = SkinAppearance(dict(appearance.maps), "simulated", parameters={"x": object()})
    with pytest.raises(store.StoreError, match="JSON"):
        store.write(tmp_path / "a", bad)
    assert store.read(tmp_path / "a").seed == 7
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a"]


def test_somebody_elses_folder_is_not_replaced(tmp_path, appearance):
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / "thesis.txt").write_text("years of work")
    with pytest.raises(store.StoreError, match=r"is not an APPEARANCE/"):
        store.write(tmp_path / "a", appearance)
    assert (tmp_path / "a" / "thesis.txt").read_text() == "years of work"


def test_flipped_bit_in_any_file_is_reported(tmp_path, appearance, rng):
    folder = store.write(tmp_path / "a", appearance)
    for path in sorted(folder.iterdir()):
        whole = path.read_bytes()
        data = bytearray(whole)
        data[rng.integers(len(data))] ^= 1 << int(rng.integers(8))
        path.write_bytes(bytes(data))
        with pytest.raises(store.StoreError, match=path.name):
            store.read(folder)
        path.write_bytes(whole)
    store.read(folder)


def test_another_schema_version_is_refused(tmp_path, appearance):
    folder = store.write(tmp_path / "a", appearance)
    document = json.loads((folder / store.DOCUMENT_FILE).read_text())
    document["schema"] = "skinrig.appearance/9"
    (folder / store.DOCUMENT_FILE).write_text(json.dumps(document))
    with pytest.raises(store.StoreError, match=r"appearance/9.*expected"):
        store.read(folder)


def test_a_path_trick_in_the_document_is_refused(tmp_path, appearance):
    folder = store.write(tmp_path / "a", appearance)
    document = json.loads((folder / store.DOCUMENT_FILE).read_text())
    document["maps"]["melanin"]["values"]["file"] = "../secret.exr"
    del document["seal"]
    document["seal"] = store._seal(document)
    (folder / store.DOCUMENT_FILE).write_text(json.dumps(document))
    with pytest.raises(store.StoreError, match="plain name"):
        store.read(folder)


def test_file_name_with_path_traversal_is_refused(tmp_path, appearance):
    folder = store.write(tmp_path / "a", appearance)
    document = json.loads((folder / store.DOCUMENT_FILE).read_text())
    document["files"] = {"../secret.ply": document["files"].pop("mesh.ply")}
    del document["seal"]
    document["seal"] = store._seal(document)
    (folder / store.DOCUMENT_FILE).write_text(json.dumps(document))
    with pytest.raises(store.StoreError, match="plain name"):
        store.read(folder)


@pytest.mark.parametrize("name", ["../mesh.ply", "Mesh.ply", "melanin.exr", "mesh", ".mesh.ply"])
def test_hidden_or_clashing_file_name_is_refused(name):
    with pytest.raises(ValueError, match="files: got name"):
        SkinAppearance({}, "simulated", files={name: b""})


def test_missing_map_error_lists_available_maps(tmp_path, appearance):
    folder = store.write(tmp_path / "a", appearance)
    with pytest.raises(store.StoreError, match=r"no map 'normals'; it has diffuse, melanin"):
        store.read(folder, map_names=("normals",))


def test_folder_that_is_not_appearance_is_reported(tmp_path):
    with pytest.raises(store.StoreError, match=r"is not an APPEARANCE/ folder"):
        store.read(tmp_path)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"values": np.zeros(3)}, "values: got shape"),
        ({"stderr": np.zeros((1, 2))}, "stderr: got shape"),
        ({"valid": np.zeros((2, 2))}, "valid: got float64"),
        ({"unit": ""}, "unit"),
        ({"values": np.full((2, 2), np.nan)}, "got nan"),
    ],
)
def test_inconsistent_map_is_refused(change, message):
    arguments = {"values": np.zeros((2, 2)), "unit": "1"} | change
    with pytest.raises(ValueError, match=message):
        SkinMap(**arguments)


def test_a_unit_that_contradicts_the_name_is_refused():
    with pytest.raises(ValueError, match=r"melanin: got unit '%'"):
        SkinAppearance({"melanin": SkinMap(np.zeros((1, 1)), "%")}, "measured")


def test_a_map_that_the_disk_refuses_is_named(tmp_path):
    pixels = np.zeros((4, 4), np.float32)
    with pytest.raises(store.StoreError, match=r"nothing/a\.exr: cannot be written"):
        store.write_exr(tmp_path / "nothing" / "a.exr", pixels)


@pytest.mark.parametrize("folder", [".", "..", "a/..", "/"])
def test_folder_without_name_is_refused_beforehand(folder):
    with pytest.raises(store.StoreError, match="give its full path"):
        store.require_free(folder)


def test_irreplaceable_folder_is_refused_beforehand(tmp_path):
    store.require_free(tmp_path / "new" / "deep")
    (tmp_path / "notes.txt").write_text("mine")
    for taken in (tmp_path, tmp_path / "notes.txt", tmp_path / "notes.txt" / "below"):
        with pytest.raises(store.StoreError, match="name another"):
            store.require_free(taken)
