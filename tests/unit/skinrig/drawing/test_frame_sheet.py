"""The sheet of frames: where each frame is, its file, and the style that plays it."""

import io
import re

import numpy as np
import pytest
from PIL import Image

from skinrig.drawing.frame_sheet import (
    FIRST_LIGHT,
    FRAME_PX,
    N_LIGHTS,
    N_STEPS,
    build_style,
    encode_sheet,
    join_frames,
)

WIDTH, HEIGHT = FRAME_PX


@pytest.fixture
def frames():
    """Return frames of one gray level each."""
    level = 10 * np.arange(N_LIGHTS * N_STEPS, dtype=np.uint8).reshape(N_LIGHTS, N_STEPS)
    return np.broadcast_to(
        level[..., None, None, None], (N_LIGHTS, N_STEPS, HEIGHT, WIDTH, 3)
    ).copy()


def test_rows_are_lights_and_columns_steps(frames):
    frames[3, 2, 0, 0] = 255  # the upper left pixel of one frame
    sheet = join_frames(frames)
    assert sheet[3 * HEIGHT, 2 * WIDTH].tolist() == [255, 255, 255]
    for light in range(N_LIGHTS):
        for step in range(N_STEPS):
            inside = sheet[(light + 1) * HEIGHT - 1, (step + 1) * WIDTH - 1]
            assert np.all(inside == frames[light, step, -1, -1])


def test_frames_of_other_size_are_refused(frames):
    with pytest.raises(ValueError, match="expected"):
        join_frames(frames[:, :-1])


def test_encoded_sheet_keeps_every_frame(frames):
    image = np.asarray(Image.open(io.BytesIO(encode_sheet(frames))), float)
    middle = image[HEIGHT // 2 :: HEIGHT, WIDTH // 2 :: WIDTH].mean(axis=-1)
    np.testing.assert_allclose(middle, frames[:, :, 0, 0, 0], atol=4)


def test_style_reaches_each_light_and_the_last_step():
    style = build_style()
    before, supported = style.split("@supports selector(:has(*)){")
    assert f"translate:0 -{100 * FIRST_LIGHT / N_LIGHTS:g}%" in before
    assert "fieldset,.player .play{display:none}" in before
    assert "animation" not in before
    rows = [float(part) for part in re.findall(r"translate:0 -([0-9.]+)%", supported)]
    np.testing.assert_allclose(rows, 100.0 * np.arange(N_LIGHTS) / N_LIGHTS)
    assert float(re.search(r"translateX\(-([0-9.]+)%\)", style)[1]) == pytest.approx(
        100.0 * (1.0 - 1.0 / N_STEPS)
    )
    assert "prefers-reduced-motion:reduce" in style
