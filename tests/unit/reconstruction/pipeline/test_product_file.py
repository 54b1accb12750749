"""Products of stages come back from a file equal, in the same memory layout, and without pickle."""

import dataclasses
import io
import json
import pickle
import zipfile

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from model.skin import SkinMap
from reconstruction.pipeline.product_file import (
    DamagedFileError,
    UnstorableError,
    estimate_bytes,
    read_product,
    write_product,
)

KEYS = st.text(max_size=5) | st.integers() | st.tuples(st.integers(), st.text(max_size=3))
LEAVES = (
    st.none()
    | st.booleans()
    | st.integers()
    | st.floats(allow_nan=False)
    | st.text(max_size=8)
    | st.binary(max_size=20)
    | arrays.arrays(arrays.scalar_dtypes(), arrays.array_shapes(min_dims=0, max_dims=3, min_side=0))
)
VALUES = st.recursive(
    LEAVES,
    lambda parts: (
        st.lists(parts, max_size=3)
        | st.tuples(parts, parts)
        | st.dictionaries(KEYS, parts, max_size=3)
    ),
    max_leaves=8,
)


def is_same(one, other):
    """Compare types and values; arrays by type, shape and bytes."""
    if type(one) is not type(other):
        return False
    if isinstance(one, np.ndarray | np.generic):
        same = one.dtype == other.dtype and one.shape == other.shape
        return same and one.tobytes() == other.tobytes()
    if isinstance(one, dict):
        return len(one) == len(other) and all(
            is_same(a, b) for a, b in zip(one.items(), other.items(), strict=True)
        )
    if isinstance(one, list | tuple):
        return len(one) == len(other) and all(map(is_same, one, other))
    return one == other


@given(value=VALUES)
def test_product_nested_comes_back_equal(tmp_path_factory, value):
    path = tmp_path_factory.getbasetemp() / "product.npz"
    write_product(path, value)
    assert is_same(read_product(path), value)


def test_record_of_own_package_comes_back(tmp_path):
    values = np.arange(6.0, dtype=np.float32).reshape(2, 3)
    given_map = SkinMap(values, "1", 0.1 * values, values > 2, "albedo")
    size = write_product(tmp_path / "a.npz", {"r_d": (given_map, np.float64(np.nan))})
    found, scalar = read_product(tmp_path / "a.npz")["r_d"]
    assert type(found) is SkinMap
    assert np.isnan(scalar)
    for field in dataclasses.fields(SkinMap):
        assert is_same(getattr(found, field.name), getattr(given_map, field.name))
    assert estimate_bytes(given_map) == 54 <= size


@pytest.mark.parametrize("axes", [(0, 1, 2), (2, 1, 0), (1, 2, 0)])
def test_array_transposed_keeps_memory_layout(tmp_path, rng, axes):
    """Sums over axes add in memory order, so that their last digits depend on the layout."""
    array = rng.normal(size=(40, 30, 20)).astype(np.float32).transpose(axes)
    write_product(tmp_path / "a.npz", array)
    found = read_product(tmp_path / "a.npz")
    assert found.strides == array.strides
    assert found.sum(axis=(0, 1)).tobytes() == array.sum(axis=(0, 1)).tobytes()


class Stranger:
    """A type of another package."""


@pytest.mark.parametrize("value", [Stranger(), {"a": [Stranger()]}, np.array([Stranger()]), {1j}])
def test_product_of_foreign_type_is_refused(tmp_path, value):
    with pytest.raises(UnstorableError, match="expected"):
        write_product(tmp_path / "a.npz", value)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "record",
    [
        *("os:system", "subprocess:Popen", "model.skin:np", "model.store:write", "model:a.b"),
        "model.store:SkinMap",  # a name that the module imports
    ],
)
def test_file_naming_foreign_record_is_refused(tmp_path, record):
    text = json.dumps({"record": record, "fields": {}}).encode()
    np.savez(tmp_path / "a.npz", document=np.frombuffer(text, np.uint8))
    with pytest.raises(DamagedFileError, match="remove the file"):
        read_product(tmp_path / "a.npz")


def test_file_with_pickle_is_refused(tmp_path):
    """NumPy pickles arrays of objects; reading them would run a stranger's code."""
    stream = io.BytesIO()
    np.save(stream, np.array([{}], object), allow_pickle=True)
    for content in (stream.getvalue(), pickle.dumps({})):
        with zipfile.ZipFile(tmp_path / "a.npz", "w") as file:
            file.writestr("document.npy", content)
        with pytest.raises(DamagedFileError):
            read_product(tmp_path / "a.npz")


@pytest.mark.long
def test_file_cut_or_changed_is_refused(tmp_path):
    """Every bit, and every length: an error of one type, or the same content."""
    path = tmp_path / "a.npz"
    value = {"x": np.arange(40.0), "n": 3}
    write_product(path, value)
    content = path.read_bytes()
    accepted = 0
    for bit in range(8 * len(content)):
        changed = bytearray(content)
        changed[bit // 8] ^= 1 << bit % 8
        path.write_bytes(changed)
        try:
            # a bit of a ZIP header can lack meaning (dates, rights), never one of the content
            assert is_same(read_product(path), value)
            accepted += 1
        except DamagedFileError:
            continue
    for size in range(len(content)):
        path.write_bytes(content[:size])
        with pytest.raises(DamagedFileError):
            read_product(path)
    assert accepted < 0.2 * 8 * len(content)


def test_array_header_shortened_is_refused(tmp_path):
    """NumPy stops reading at the shorter length, before the ZIP reader compares the checksum."""
    path = tmp_path / "a.npz"
    write_product(path, np.arange(800.0))
    content = path.read_bytes()
    assert content.count(b"(800,)") == 1
    path.write_bytes(content.replace(b"(800,)", b"(100,)"))
    with pytest.raises(DamagedFileError, match="CRC"):
        read_product(path)


def test_record_of_nested_class_is_refused(tmp_path):
    @dataclasses.dataclass
    class Local:
        x: int = 1

    for qualified in ("Local", "SkinMap"):
        Local.__module__, Local.__qualname__ = "model.skin", qualified
        with pytest.raises(UnstorableError, match="module level"):
            write_product(tmp_path / "a.npz", Local())
