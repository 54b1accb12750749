"""Fine maps of a simulated person are that person's own, and packed by what suits them."""

from __future__ import annotations

import gzip
import zlib

import numpy as np
import pytest

from rigsim.subject.person import make_subject
from skinrig.viewer import packing as arrays
from skinrig.viewer.fine_skin import FineSkin


def test_fine_maps_match_person_at_that_size():
    person = make_subject("II", seed=2, size=64)
    whole = make_subject("II", seed=2, size=128)
    skin = FineSkin(person, 128)
    np.testing.assert_array_equal(skin.covered, whole.atlas.covered)
    inside = skin.covered
    np.testing.assert_array_equal(skin.melanin()[inside], whole.melanin[inside])
    np.testing.assert_array_equal(skin.hemoglobin()[inside], whole.hemoglobin()[inside])
    np.testing.assert_array_equal(skin.height_um()[inside], whole.height_um[inside])
    # the coarse ones repeated are others
    coarse = np.repeat(np.repeat(person.melanin, 2, 0), 2, 1)
    assert np.abs(coarse - whole.melanin)[inside].max() > 1e-4


@pytest.mark.parametrize("count", [0, 1, 5, 200_000])
def test_gzipped_parts_are_recovered_from_single_member(count, rng):
    noise = rng.integers(0, 256, count, dtype=np.uint8).tobytes()
    steps = rng.choice(np.array([0, 0, 0, 1, 255], np.uint8), 3 * count).tobytes()
    text = b"vertex of a face, " * count
    packed = arrays.gzip_parts([noise, b"", steps, text])
    assert gzip.decompress(packed) == noise + steps + text
    assert packed == arrays.gzip_parts([noise, b"", steps, text])
    assert len(packed) < len(noise) + 0.3 * len(steps) + 0.1 * len(text) + 100
    # one member: what a browser's stream takes, which ends at the first
    reader = zlib.decompressobj(zlib.MAX_WBITS | 16)
    reader.decompress(packed)
    assert reader.eof
    assert reader.unused_data == b""


def test_noise_packs_as_small_as_with_repetition_search(rng):
    noise = np.clip(rng.normal(128.0, 6.0, 300_000), 0, 255).astype(np.uint8).tobytes()
    assert len(arrays.gzip_parts([noise])) <= len(gzip.compress(noise, 9))
    repeated = noise[:1000] * 300
    assert len(arrays.gzip_parts([repeated])) <= 1.01 * len(gzip.compress(repeated, 9)) + 16
