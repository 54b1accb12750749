import io

import cv2
import numpy as np
import pytest
from PIL import Image

from skinrig.drawing import png


@pytest.mark.parametrize("shape", [(3, 5), (4, 2, 3)])
def test_8_bit_image_reads_back_equal_elsewhere(shape):
    image = np.random.default_rng(12345).integers(0, 256, shape, dtype=np.uint8)
    np.testing.assert_array_equal(np.asarray(Image.open(io.BytesIO(png.encode(image)))), image)


def test_a_16_bit_gray_image_reads_back_equal():
    image = np.arange(12, dtype=np.uint16).reshape(3, 4) * 5000
    np.testing.assert_array_equal(np.asarray(Image.open(io.BytesIO(png.encode(image)))), image)


@pytest.mark.parametrize("quick", [False, True])
@pytest.mark.parametrize("channels", [3, 4])
def test_16_bit_color_image_keeps_all_bits(rng, channels, quick):
    image = rng.integers(0, 65536, (5, 7, channels), dtype=np.uint16)
    data = png.encode(image, quick=quick)
    assert data[24:26] == bytes([16, {3: 2, 4: 6}[channels]])  # depth and color type
    read = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(read[..., [2, 1, 0, 3][:channels]], image)


def test_image_view_is_encoded_as_read(rng):
    image = rng.integers(0, 256, (8, 9, 4), dtype=np.uint8)[::-2, ::2]
    np.testing.assert_array_equal(np.asarray(Image.open(io.BytesIO(png.encode(image)))), image)


@pytest.mark.parametrize(
    "image", [np.zeros((2, 2)), np.zeros((0, 2), np.uint8), np.zeros((2, 2, 5), np.uint8)]
)
def test_an_image_that_png_cannot_hold_is_refused(image):
    with pytest.raises(ValueError, match="image: got"):
        png.encode(image)


def test_invalid_pixels_are_gray_and_extremes_are_clamped():
    values = np.array([[0.0, 1.0, np.nan, 2.0, 0.5]])
    valid = np.array([[True, True, True, True, False]])
    image = png.Scale(0.0, 1.0).colors(values, valid)
    np.testing.assert_array_equal(image[0, 2], 128)
    np.testing.assert_array_equal(image[0, 4], 128)
    np.testing.assert_array_equal(image[0, 1], image[0, 3])
    assert (image[0, 0] != image[0, 1]).any()


@pytest.mark.parametrize("shape", [(37, 41, 3), (37, 41)])
def test_smooth_images_read_back_equal_through_every_filter(shape):
    rows, columns = np.mgrid[: shape[0], : shape[1]]
    for smooth in (3 * rows, 3 * columns, rows + columns, rows * columns):
        image = np.broadcast_to(
            smooth.reshape(*smooth.shape, *(1,) * (len(shape) - 2)) % 256, shape
        ).astype(np.uint8)
        np.testing.assert_array_equal(np.asarray(Image.open(io.BytesIO(png.encode(image)))), image)


def test_color_scale_of_subnormal_span_is_constant():
    values = np.array([[0.0, 5e-324], [1e-3, 0.0]])
    shown = png.Scale(0.0, 5e-324).colors(values)
    assert (shown[0] == png.sample_palette("viridis", 256)[0]).all()
