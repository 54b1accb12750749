"""Join frames of a face into one image, and write the style that plays it without a script.

A row is a light direction, a column a step of the movement. Radio buttons choose the row; an
animation of the style sheet runs along the columns.
"""

import io
from typing import Final

import numpy as np
from numpy.typing import NDArray

from skinrig.arrays import UInt8Array

N_LIGHTS: Final = 5
"""Rows of a sheet: directions of the light."""
N_STEPS: Final = 5
"""Columns of a sheet: steps from rest to the full expression."""
FIRST_LIGHT: Final = 1
"""Row shown first."""
FRAME_PX: Final = (240, 270)
"""Width and height of a frame."""
PERIOD_S: Final = 1.6
"""Seconds from rest to the full expression, with a pause at both ends."""
PAUSE_PERCENT: Final = 15
"""Part of the period that either end is held, %."""
WEBP_QUALITY: Final = 60


def join_frames(frames: NDArray[np.uint8]) -> UInt8Array:
    """Return frames, (`N_LIGHTS`, `N_STEPS`, H, W, 3), as one image, (L H, S W, 3).

    Raises
    ------
    ValueError
        If the numbers of frames or their size are others.

    Examples
    --------
    >>> join_frames(np.zeros((5, 5, 270, 240, 3), np.uint8)).shape
    (1350, 1200, 3)
    """
    width, height = FRAME_PX
    expected = (N_LIGHTS, N_STEPS, height, width, 3)
    if frames.shape != expected:
        raise ValueError(f"frames: got shape {frames.shape}, expected {expected}")
    joined = np.moveaxis(frames, 2, 1).reshape(N_LIGHTS * height, N_STEPS * width, 3)
    return np.ascontiguousarray(joined)


def encode_sheet(frames: NDArray[np.uint8]) -> bytes:
    """Encode frames as one lossy WebP file; see `join_frames`."""
    from PIL import Image

    file = io.BytesIO()
    Image.fromarray(join_frames(frames)).save(file, "WEBP", quality=WEBP_QUALITY, method=4)
    return file.getvalue()


def build_style() -> str:
    """Return the style of sheets: rows by the chosen radio button, columns by an animation.

    The animation runs where the user's system does not ask for reduced motion. The check box
    stops it there, and starts it elsewhere. A browser without `:has` gets row `FIRST_LIGHT` at
    rest, without buttons: they would have no effect.
    """
    width, height = FRAME_PX
    end = 100.0 * (N_STEPS - 1) / N_STEPS
    steps = f"steps({N_STEPS},jump-none)"
    rows = [
        f".player:has(input[type=radio]:nth-of-type({row + 1}):checked) .frame img"
        f"{{translate:0 -{100.0 * row / N_LIGHTS:g}%}}"
        for row in range(N_LIGHTS)
    ]
    play, stop = "animation-play-state:running", "animation-play-state:paused"
    return "\n".join(
        [
            f".player .frame{{overflow:hidden;aspect-ratio:{width}/{height}}}",
            f".player .frame img{{width:{100 * N_STEPS}%;max-width:none;border:0;"
            f"translate:0 -{100.0 * FIRST_LIGHT / N_LIGHTS:g}%}}",
            ".player fieldset,.player .play{display:none}",
            "@supports selector(:has(*)){",
            ".player fieldset{display:grid}.player .play{display:flex}",
            f".player .frame img{{animation:express {PERIOD_S:g}s {steps} infinite alternate}}",
            f"@keyframes express{{0%,{PAUSE_PERCENT}%{{transform:none}}"
            f"{100 - PAUSE_PERCENT}%,100%{{transform:translateX(-{end:g}%)}}}}",
            f".player:has(.toggle:checked) .frame img{{{stop}}}",
            ".player .rests{display:none}",
            "@media(prefers-reduced-motion:reduce){"
            f".player .frame img{{{stop}}}"
            f".player:has(.toggle:checked) .frame img{{{play}}}"
            ".player .moves{display:none}.player .rests{display:inline}}",
            *rows,
            "}",
        ]
    )
