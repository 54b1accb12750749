"""NumPy archives of strangers: limits are checked before anything is unpacked."""

import io
import zipfile

import numpy as np
import pytest

from model.checks.files import read_arrays


def write_archive(compression):
    stream, array = io.BytesIO(), io.BytesIO()
    np.save(array, np.zeros(100_000))
    with zipfile.ZipFile(stream, "w", compression) as archive:
        archive.writestr("a.npy", array.getvalue())
    return stream.getvalue()


@pytest.mark.parametrize("compression", [zipfile.ZIP_LZMA, zipfile.ZIP_BZIP2])
def test_foreign_compression_is_refused(compression):
    with pytest.raises(ValueError, match=r"a\.npy: got compression .* expected none or deflate"):
        read_arrays(write_archive(compression))


@pytest.mark.parametrize("compression", [zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED])
def test_compression_of_numpy_is_read(compression):
    assert read_arrays(write_archive(compression))["a"].shape == (100_000,)
