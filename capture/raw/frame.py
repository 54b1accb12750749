"""One raw frame in memory: sensor values, levels, settings and provenance."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import datetime
from typing import Any

import numpy as np

from capture.arrays import Float64Array, UInt16Array
from capture.documents import FaultCollector, InputError, canonical_json
from capture.rig import CFA_PATTERNS, MAX_SIDE_PX

# 2**28 pixels: ten times the largest sensor of a capture rig, and 512 MiB of memory
MAX_PIXELS = 2**28

# EXIF LightSource codes, EXIF 2.32 table 9
ILLUMINANT_CODES: Mapping[str, int] = {"A": 17, "D55": 20, "D65": 21, "D75": 22, "D50": 23}


class RawError(InputError):
    """Raised for a raw file, or the content of one, that cannot be used."""


@dataclass(frozen=True, slots=True, eq=False)
class CameraColor:
    """Color of a camera under the light of a rig, for programs that develop raw files."""

    matrix: Float64Array
    """(3, 3) from CIE XYZ of D65 to camera RGB."""
    neutral: tuple[float, float, float]
    """Camera RGB of a neutral surface in the light of the rig, largest 1."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RawFrame:
    """Sensor values as read out, with black and white levels and the settings of the exposure."""

    cfa: UInt16Array
    """(H, W) uint16 DN, row 0 at the top; may be read-only."""
    pattern: str
    """Colors of the 2 x 2 cell row by row ("RGGB", "BGGR", "GRBG", "GBRG"), or "MONO"."""
    black: tuple[float, ...]
    """Black level, DN, for each position of the cell, row by row; a single value for MONO."""
    white: int
    """Saturation level, DN."""
    exposure_s: float | None = None
    """Exposure time, s; None when the file does not contain it."""
    iso: int | None = None
    """Sensitivity; None when the file does not contain it."""
    camera_model: str = ""
    camera_serial: str = ""
    color_matrix: Float64Array | None = None
    """(3, 3) from CIE XYZ of ``color_illuminant`` to camera RGB; None when unknown."""
    color_illuminant: str = "D65"
    """Illuminant of ``color_matrix``: "A", "D50", "D55", "D65" or "D75"."""
    neutral: tuple[float, float, float] | None = None
    """Camera RGB of a neutral surface, largest 1; None when unknown."""
    noise_profile: tuple[float, float] | None = None
    """(scale, offset): variance = scale * x + offset, x in fractions of full scale (DNG 1.3)."""
    f_number: float | None = None
    focal_mm: float | None = None
    captured_at: datetime | None = None
    """Time of capture with its zone; None when the file does not contain it."""
    step_id: str = ""
    """Step of the plan the frame belongs to, empty for foreign files."""
    session_id: str = ""
    light: Mapping[str, Any] = field(default_factory=dict)
    """Light of the frame: polarizer, power, token, analyzer."""
    path: str = ""
    """File the frame was read from, empty for a frame made in memory."""
    orientation: int = 1
    """EXIF orientation of a foreign file, 1 to 8, by which ``cfa`` is not turned; 1: upright."""

    def __post_init__(self) -> None:
        checks = FaultCollector(
            f"Raw frame{' of step ' + self.step_id if self.step_id else ''}", RawError
        )
        shape, dtype = self.cfa.shape, self.cfa.dtype
        checks.check("cfa", f"{dtype} {shape}", self.cfa.ndim == 2, "uint16 of shape (H, W)")
        checks.check("cfa", str(dtype), dtype == np.uint16, "uint16")
        mono = self.pattern == "MONO"
        checks.check(
            "pattern", self.pattern, self.pattern in CFA_PATTERNS, f"one of {CFA_PATTERNS}"
        )
        if self.cfa.ndim == 2:
            even = mono or (shape[0] % 2 == 0 and shape[1] % 2 == 0)
            size = 1 <= min(shape) and max(shape) <= MAX_SIDE_PX and self.cfa.size <= MAX_PIXELS
            checks.check("cfa", shape, size, f"sides of 1 to {MAX_SIDE_PX}, {MAX_PIXELS} pixels")
            checks.check("cfa", shape, even, "even height and width for a color filter array")
        cells = 1 if mono else 4
        checks.check("black", self.black, len(self.black) == cells, f"{cells} value(s)")
        checks.check("white", self.white, 0 < self.white <= 65_535, "1 to 65535")
        below = all(math.isfinite(b) and 0 <= b < self.white for b in self.black)
        checks.check("black", self.black, below, f"0 <= black < white {self.white}")
        for name in ("exposure_s", "iso", "f_number", "focal_mm"):
            value = getattr(self, name)
            good = value is None or (math.isfinite(value) and value > 0)
            checks.check(name, value, good, "a finite number > 0, or None")
        if self.color_matrix is not None:
            good = self.color_matrix.shape == (3, 3) and bool(np.isfinite(self.color_matrix).all())
            checks.check("color_matrix", self.color_matrix, good, "(3, 3) finite numbers")
        codes = ", ".join(ILLUMINANT_CODES)
        good = self.color_illuminant in ILLUMINANT_CODES
        checks.check("color_illuminant", self.color_illuminant, good, f"one of {codes}")
        if self.neutral is not None:
            good = len(self.neutral) == 3 and all(0 < x < math.inf for x in self.neutral)
            checks.check("neutral", self.neutral, good, "three finite numbers > 0")
        colored = self.color_matrix is not None or self.neutral is not None
        checks.check("color_matrix, neutral", "given", not (mono and colored), "None for MONO")
        if self.noise_profile is not None:
            good = len(self.noise_profile) == 2 and all(
                0 <= x < math.inf for x in self.noise_profile
            )
            checks.check("noise_profile", self.noise_profile, good, "(scale, offset), finite, >= 0")
        for name in ("camera_model", "camera_serial", "step_id", "session_id"):
            text = getattr(self, name)
            good = text.isascii() and (text.isprintable() or not text) and len(text) <= 200
            checks.check(name, text, good, "at most 200 printable ASCII characters")
        if self.captured_at is not None:
            zoned = self.captured_at.utcoffset() is not None
            checks.check("captured_at", self.captured_at.isoformat(), zoned, "a time with its zone")
        try:
            size_bytes = len(canonical_json(dict(self.light)))
            checks.check(
                "light", f"{size_bytes} bytes", size_bytes <= 16_384, "at most 16 KiB of JSON"
            )
        except (TypeError, ValueError, RecursionError) as exc:
            checks.check("light", str(exc), False, "values that JSON can hold, all finite")
        checks.close()


def noise_profile(
    gain_e_per_dn: float, read_noise_e: float, *, black: float, white: float
) -> tuple[float, float]:
    """Return (scale, offset) of a sensor in the DNG convention.

    Parameters
    ----------
    gain_e_per_dn : float
        Electrons per DN, > 0.
    read_noise_e : float
        Read noise, electrons rms, >= 0 (with quantization, where that matters).
    black, white : float
        Levels in DN, black < white.

    Returns
    -------
    tuple of float
        With x = (DN - black) / (white - black): variance of x = scale * x + offset.

    Notes
    -----
    Shot noise of N electrons has variance N; x = N / (gain * (white - black)).

    Examples
    --------
    >>> noise_profile(2.0, 4.0, black=24, white=1024)
    (0.0005, 4e-06)
    """
    checks = FaultCollector("Noise profile", RawError)
    checks.check_positive(gain_e_per_dn=gain_e_per_dn)
    checks.check("read_noise_e", read_noise_e, 0 <= read_noise_e < math.inf, ">= 0")
    checks.check("white", white, white > black, f"> black {black}")
    checks.close()
    full_scale_e = gain_e_per_dn * (white - black)
    return 1.0 / full_scale_e, (read_noise_e / full_scale_e) ** 2
