"""Color tables keep their colors, axes and description in files; other files are refused."""

import numpy as np
import pytest

from model import color_table, store
from model.color_table import ColorTableError
from model.color_table_file import read_color_table, write_color_table
from model.tissue_optics.constants import PAPER_CONSTANTS


@pytest.fixture(scope="module")
def table():
    return color_table.build("linear sRGB", "D55", size=12, constants=PAPER_CONSTANTS)


@pytest.mark.parametrize(("name", "lost"), [("t.exr", 1e-7), ("t.csv", 0.0)])
def test_table_read_back_gives_equal_colors(tmp_path, table, name, lost):
    write_color_table(tmp_path / name, table)
    found = read_color_table(tmp_path / name)
    np.testing.assert_allclose(found.rgb, table.rgb, rtol=lost)
    assert found.constants == PAPER_CONSTANTS
    assert (found.illuminant, found.c_m_max, found.c_hd_max) == ("D55", 0.5, 0.32)
    c_m, c_hd = np.array([0.01, 0.2]), np.array([0.3, 0.001])
    np.testing.assert_allclose(found.lookup(c_m, c_hd), table.lookup(c_m, c_hd), rtol=1e-6)


def test_image_has_melanin_right_and_blood_upwards(tmp_path, table):
    write_color_table(tmp_path / "t.exr", table)
    image = store.read_exr(tmp_path / "t.exr")
    np.testing.assert_allclose(image[-1, :, 0], table.rgb[:, 0, 0], rtol=1e-7)  # no blood
    np.testing.assert_allclose(image[::-1, 0, 1], table.rgb[0, :, 1], rtol=1e-7)  # no melanin


def test_image_without_description_has_ranges_of_table_1(tmp_path, table):
    image = table.rgb.transpose(1, 0, 2)[::-1]
    store.write_exr(tmp_path / "other.exr", image.astype(np.float32))
    found = read_color_table(tmp_path / "other.exr")
    assert found.camera == "not named in the file"
    np.testing.assert_allclose(found.lookup(0.5, 0.32), table.rgb[-1, -1], rtol=1e-6)


def test_csv_columns_are_cube_roots(tmp_path, table):
    write_color_table(tmp_path / "t.csv", table)
    rows = np.loadtxt(tmp_path / "t.csv", delimiter=",", skiprows=2)
    np.testing.assert_allclose(rows[:, :2] ** 3, rows[:, 2:4], atol=1e-15)
    assert rows[-1, 2:4].tolist() == pytest.approx([0.5, 0.32])


@pytest.mark.parametrize(
    ("change", "word"),
    [
        (lambda text: text.replace("color-table/1", "color-table/9"), "another schema"),
        (lambda text: text.replace("cbrt_c_m,", "c,"), "columns"),
        (lambda text: text.rsplit("\n", 2)[0], "square"),
        (lambda text: text.replace("0.", "x.", 40), "expected"),
        (lambda text: text.replace('"oxygenation": 0.', '"oxygenation": 7.'), "oxygenation"),
    ],
)
def test_damaged_table_is_refused(tmp_path, table, change, word):
    path = tmp_path / "t.csv"
    write_color_table(path, table)
    path.write_text(change(path.read_text()))
    with pytest.raises(ColorTableError, match=word):
        read_color_table(path)


def test_other_suffix_is_refused(tmp_path, table):
    with pytest.raises(ColorTableError, match="rename"):
        write_color_table(tmp_path / "t.png", table)
