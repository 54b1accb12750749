"""The tensor container to the byte, and files that are broken."""

import struct

import numpy as np
import pytest

from model.brdf import tensor_file
from model.brdf.tensor_file import TensorFileError


@pytest.fixture
def fields(rng):
    return {
        "text": np.frombuffer(b"skin", np.uint8),
        "flag": np.ones(1, np.uint8),
        "grid": rng.normal(size=(2, 3, 5)).astype(np.float32),
        "wide": rng.normal(size=7),
        "none": np.zeros((0, 4), np.int64),
    }


def test_arrays_round_trip_with_types_and_same_bytes(fields, tmp_path):
    tensor_file.write(tmp_path / "a", fields)
    back = tensor_file.read(tmp_path / "a")
    assert list(back) == list(fields)
    for name, array in fields.items():
        assert back[name].dtype == array.dtype
        np.testing.assert_array_equal(back[name], array)
    tensor_file.write(tmp_path / "b", back)
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()


def test_layout_matches_published_format_to_the_byte(tmp_path):
    tensor_file.write(tmp_path / "a", {"ab": np.array([[1.5, -2.0]], np.float32)})
    head = b"tensor_file\0" + struct.pack("<BBI", 1, 0, 1)
    entry = struct.pack("<H", 2) + b"ab" + struct.pack("<HBQQQ", 2, 10, 56, 1, 2)
    padding = b"\0" * (56 - len(head) - len(entry))
    assert (tmp_path / "a").read_bytes() == head + entry + padding + struct.pack("<2f", 1.5, -2.0)


def test_broken_files_are_named_wherever_they_are_cut(fields, tmp_path):
    tensor_file.write(tmp_path / "whole", fields)
    whole = (tmp_path / "whole").read_bytes()
    cut = tmp_path / "cut"
    last = max(i for i in range(len(whole)) if whole[i])
    for length in [*range(0, 180), len(whole) - 1, last]:
        cut.write_bytes(whole[:length])
        with pytest.raises(TensorFileError, match="cut: "):
            tensor_file.read(cut)
    for content, message in [
        (whole[:12] + b"\2" + whole[13:], "version"),
        (whole[:14] + b"\xff" * 4 + whole[18:], "fields"),
        (whole.replace(b"\4\0text\1\0\1", b"\4\0text\1\0\x0c"), "type 12"),
    ]:
        cut.write_bytes(content)
        with pytest.raises(TensorFileError, match=message):
            tensor_file.read(cut)


def test_an_array_of_another_type_is_refused(tmp_path):
    with pytest.raises(TensorFileError, match="complex128"):
        tensor_file.write(tmp_path / "a", {"x": np.zeros(2, complex)})
