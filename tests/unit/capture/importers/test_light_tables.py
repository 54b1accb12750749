"""Lists of lights as JSON and NumPy files."""

import json

import numpy as np
import pytest

from capture.importers.light_tables import LightListError, read_light_table, split_row

VECTORS = [[0.0, 0.6, 0.8], [1.0, 0.0, 0.0]]


@pytest.mark.parametrize(
    ("document", "names"),
    [
        (VECTORS, []),
        ({"lights": VECTORS}, []),
        ({"a.png": VECTORS[0], "b.png": VECTORS[1]}, ["a.png", "b.png"]),
        (
            {"frames": [{"file_path": f"{n}.png", "light_dir": v} for n, v in enumerate(VECTORS)]},
            ["0.png", "1.png"],
        ),
        ([{"position": v, "power": 2} for v in VECTORS], []),
        ([{"name": f"L0{n}", "position": v} for n, v in enumerate(VECTORS)], []),
    ],
)
def test_json_forms_give_the_same_vectors(document, names, tmp_path):
    file = tmp_path / "lights.json"
    file.write_text(json.dumps(document))
    found, vectors = read_light_table(file)
    assert found == names
    np.testing.assert_array_equal(vectors, VECTORS)


def test_numpy_array_gives_its_rows(tmp_path):
    np.save(tmp_path / "lights.npy", VECTORS)
    assert read_light_table(tmp_path / "lights.npy")[1].tolist() == VECTORS


@pytest.mark.parametrize(
    "content",
    [
        b"[]",
        b"3",
        b'{"lights": 4}',
        b"[[1, 2]]",
        b"[[1, 2, NaN]]",
        b'[{"name": "a.png"}]',
        b'[{"name": "a.png", "dir": [0, 0, 1]}, {"dir": [0, 0, 1]}]',
        b"{",
        b"[[0, 0, 0]]",
    ],
)
def test_other_documents_are_refused(content, tmp_path):
    file = tmp_path / "lights.json"
    file.write_bytes(content)
    with pytest.raises(LightListError, match=r"lights\.json"):
        read_light_table(file)


def test_pickled_arrays_are_refused(tmp_path):
    np.save(tmp_path / "lights.npy", np.array([{"a": 1}], object), allow_pickle=True)
    with pytest.raises(LightListError, match="not a NumPy array"):
        read_light_table(tmp_path / "lights.npy")


def test_archive_of_arrays_is_refused(tmp_path):
    np.savez(tmp_path / "a.npz", VECTORS)
    (tmp_path / "a.npz").rename(tmp_path / "lights.npy")
    with pytest.raises(LightListError, match="not a NumPy array"):
        read_light_table(tmp_path / "lights.npy")


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("D:\\RTI, bowl\\img1.png 0.1 0.2 0.97", ["D:\\RTI, bowl\\img1.png", "0.1", "0.2", "0.97"]),
        ("img1.png, 0.1 0.2 0.97", ["img1.png", "0.1", "0.2", "0.97"]),
        ("img1.png, 0.1, 0.2, 0.97", ["img1.png", "0.1", "0.2", "0.97"]),
        ("img1.png,0.1,0.2,0.97", ["img1.png", "0.1", "0.2", "0.97"]),
        ("img1.png\t0,1\t0,2\t0,97", ["img1.png", "0,1", "0,2", "0,97"]),
        ("img 1.png; 0,1; 0,2; 0,97", ["img 1.png", "0,1", "0,2", "0,97"]),
        ("img0.png, 0,5, 0,3, 0,8", ["img0.png", "0", "5", "0", "3", "0", "8"]),
    ],
)
def test_row_is_split_where_its_numbers_are(line, words):
    assert split_row(line) == words
