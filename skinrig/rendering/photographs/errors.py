"""Compute errors of renderings against photographs with the same camera and light.

Both are white-balanced linear camera RGB, relative to a perfect white Lambertian patch at the rig's
origin that faces the light. The luminance is that of ITU-R BT.709 with the camera's channels in
place of its primaries.

A pixel is **lit** if it and its eight neighbors are entirely on measured skin with full visibility
of the light for every ray, by the rendered geometry, and if the photograph is not saturated and at
least `MIN_SIGNAL_SIGMAS` times its own noise. The agreement of the two is not a criterion. Other
skin, such as shadows and their borders, contributes only to `total_error`.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage

from skinrig.arrays import BoolArray, Float64Array
from skinrig.console import Console
from skinrig.drawing import png
from skinrig.evaluating.skin_bands import classify_typology
from skinrig.rendering.camera import RenderingError
from skinrig.rendering.render import Subsurface

LUMINANCE_WEIGHTS: Final = (0.2126, 0.7152, 0.0722)
MIN_SIGNAL_SIGMAS: Final = 10.0
"""Minimum ratio of a photograph's luminance to its standard deviation."""
MAX_MEDIAN_ERROR: Final = 0.05
"""Limit of a model's median relative error of the luminance on lit pixels."""
ERROR_PERCENTILES: Final = (50.0, 68.0, 90.0, 95.0)
WHITE_PERCENTILE: Final = 99.0
"""Percentile of a photograph's skin luminance that is mapped to white before SSIM."""


@dataclass(frozen=True, slots=True, eq=False)
class Photograph:
    """One linear photograph.

    Attributes
    ----------
    rgb, variance
        (H, W, 3), see this module.
    valid
        (H, W) bool; False: saturated.
    """

    rgb: Float64Array
    variance: Float64Array
    valid: BoolArray

    def __post_init__(self) -> None:
        shape = np.shape(self.rgb)
        if len(shape) != 3 or shape[2] != 3 or np.shape(self.variance) != shape:
            raise RenderingError(
                f"photograph: got rgb {shape} and variance {np.shape(self.variance)}, "
                "expected (H, W, 3) both"
            )
        if np.shape(self.valid) != shape[:2]:
            raise RenderingError(f"valid: got {np.shape(self.valid)}, expected {shape[:2]}")


@dataclass(frozen=True, slots=True, eq=False)
class PairErrors:
    """Errors of a rendering relative to a photograph.

    Attributes
    ----------
    relative
        (H, W) |rendering - photograph| / photograph of the luminance; NaN where not `lit`.
    signed
        The same without the absolute value.
    lit
        (H, W) bool, see this module.
    noise
        Median of `relative` by the photograph's noise alone; NaN without lit pixels.
    total_error
        Sum of |rendering - photograph| over all skin, relative to that of the photograph.
    ssim
        Mean structural similarity of the tone-mapped pair over the skin, -1 to 1.
    delta_e
        Mean color difference CIEDE2000 of the tone-mapped pair over the skin, camera RGB taken as
        linear sRGB.
    """

    relative: Float64Array
    signed: Float64Array
    lit: BoolArray
    noise: float
    total_error: float
    ssim: float
    delta_e: float

    @property
    def median(self) -> float:
        """Median relative error over lit pixels; NaN without any."""
        return float(np.median(self.relative[self.lit])) if self.lit.any() else float("nan")


def luminance(rgb: ArrayLike) -> Float64Array:
    """Return the luminance of white-balanced linear RGB, (...).

    Examples
    --------
    >>> round(float(luminance([1.0, 1.0, 1.0])), 6)
    1.0
    """
    return np.asarray(np.asarray(rgb, np.float64) @ np.array(LUMINANCE_WEIGHTS))


def find_lit_pixels(photograph: Photograph, *, covered: ArrayLike, lit: ArrayLike) -> BoolArray:
    """Return the lit pixels, see this module.

    Parameters
    ----------
    photograph
        The photograph.
    covered, lit
        (H, W) bool of the rendering: entirely on measured skin; full visibility of the light.
    """
    light = luminance(photograph.rgb)
    sigma = _sigma(photograph)
    inner = ndimage.binary_erosion(
        np.asarray(covered, bool) & np.asarray(lit, bool), np.ones((3, 3)), border_value=0
    )
    return np.asarray(
        inner & photograph.valid & (light > 0) & (light >= MIN_SIGNAL_SIGMAS * sigma) & (sigma > 0)
    )


def compare_pair(
    photograph: Photograph, rendering: ArrayLike, *, covered: ArrayLike, lit: ArrayLike
) -> PairErrors:
    """Compare a rendering with a photograph.

    Parameters
    ----------
    photograph
        The photograph.
    rendering
        (H, W, 3), in the photograph's unit.
    covered, lit
        (H, W) bool of the rendering: pixels entirely on measured skin, and those with full
        visibility of the light. Renderings that are compared with each other share one mask.

    Raises
    ------
    RenderingError
        If shapes differ or no pixel is covered.
    """
    image = np.asarray(rendering, np.float64)
    skin = np.asarray(covered, bool) & photograph.valid
    if image.shape != photograph.rgb.shape or skin.shape != image.shape[:2]:
        raise RenderingError(
            f"rendering: got {image.shape}, covered {skin.shape}, expected {photograph.rgb.shape}"
        )
    if not skin.any():
        raise RenderingError(
            "covered: got no unsaturated pixel of measured skin, expected some; check view and "
            "exposure"
        )
    chosen = find_lit_pixels(photograph, covered=covered, lit=lit)
    real, made = luminance(photograph.rgb), luminance(image)
    signed = np.full(real.shape, np.nan)
    signed[chosen] = made[chosen] / real[chosen] - 1.0
    noise = (
        _sigma(photograph)[chosen] / real[chosen]
    ) * 0.6745  # median magnitude of a standard normal variable
    middle = float(np.median(noise)) if chosen.any() else float("nan")
    total = float(np.sum(np.abs(made - real)[skin]) / max(float(np.sum(real[skin])), 1e-30))
    alike = structural_similarity(photograph.rgb, image, skin)
    difference = color_difference(photograph.rgb, image, skin)
    return PairErrors(np.abs(signed), signed, chosen, middle, total, alike, difference)


def tone_map(rgb: ArrayLike, white: float) -> Float64Array:
    """Apply the sRGB curve to linear light over `white`, clipped to 0 to 1.

    Examples
    --------
    >>> tone_map([0.0, 0.5, 2.0], 1.0).round(4).tolist()
    [0.0, 0.7354, 1.0]
    """
    return png.srgb_curve(np.clip(np.asarray(rgb, np.float64) / white, 0.0, 1.0))


def structural_similarity(photograph: ArrayLike, rendering: ArrayLike, skin: BoolArray) -> float:
    """Return the mean structural similarity over the skin of a tone-mapped pair.

    Both are scaled so that `WHITE_PERCENTILE` of the photograph's skin is white, and are black
    outside the skin. Windows are Gaussian, 1.5 pixels (Wang et al. 2004,
    doi:10.1109/TIP.2003.819861).
    """
    from skimage.metrics import structural_similarity

    pair = [image * skin[..., None] for image in _tone_map_pair(photograph, rendering, skin)]
    if min(skin.shape) < 11:
        raise RenderingError(f"image: got {skin.shape}, expected at least 11 x 11 pixels")
    windows = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False}
    _, full = structural_similarity(*pair, data_range=1.0, channel_axis=-1, full=True, **windows)
    return float(np.mean(np.asarray(full)[skin]))


def color_difference(photograph: ArrayLike, rendering: ArrayLike, skin: BoolArray) -> float:
    """Return the mean CIEDE2000 over the skin of a tone-mapped pair, as of `PairErrors`.

    Examples
    --------
    >>> gray = np.full((4, 4, 3), 0.5)
    >>> [round(color_difference(gray, f * gray, np.ones((4, 4), bool)), 2) for f in (1.0, 0.98)]
    [0.0, 0.45]
    """
    from skimage.color import deltaE_ciede2000, rgb2lab

    pair = _tone_map_pair(photograph, rendering, skin)
    return float(np.mean(deltaE_ciede2000(*(rgb2lab(image[skin]) for image in pair))))


def _tone_map_pair(
    photograph: ArrayLike, rendering: ArrayLike, skin: BoolArray
) -> tuple[Float64Array, Float64Array]:
    """Return both as sRGB codes, 0 to 1; `WHITE_PERCENTILE` of the photograph's skin is 1."""
    light = luminance(photograph)[skin]
    white = max(float(np.percentile(light, WHITE_PERCENTILE)), 1e-30)
    return tone_map(photograph, white), tone_map(rendering, white)


@dataclass(frozen=True, slots=True)
class Summary:
    """Errors of many pairs.

    Attributes
    ----------
    pairs, pixels
        Number of photographs, and of their lit pixels.
    median, p68, p90, p95
        Percentiles of the relative error of the luminance over all lit pixels.
    interval
        68 % bootstrap interval of the median, 200 resamples of the photographs.
    bias
        Median of the signed error.
    noise
        Median relative error by noise alone, mean over the photographs.
    total_error, ssim, delta_e
        Means over the photographs, see `PairErrors`.
    """

    pairs: int
    pixels: int
    median: float
    p68: float
    p90: float
    p95: float
    interval: tuple[float, float]
    bias: float
    noise: float
    total_error: float
    ssim: float
    delta_e: float


def summarize_pairs(pairs: Sequence[PairErrors], *, rng: np.random.Generator) -> Summary:
    """Summarize the errors of pairs.

    Raises
    ------
    RenderingError
        If they have no lit pixel.
    """
    values = [pair.relative[pair.lit] for pair in pairs]
    if not sum(len(v) for v in values):
        raise RenderingError("photographs: got no lit pixel, expected some; check their exposure")
    every = np.concatenate(values)
    again = [
        float(np.median(np.concatenate(drawn)))
        for drawn in (
            [values[k] for k in rng.integers(len(values), size=len(values))] for _ in range(200)
        )
        if sum(len(v) for v in drawn)
    ]
    low, high = np.quantile(again, [0.16, 0.84]).tolist()
    p50, p68, p90, p95 = np.percentile(every, ERROR_PERCENTILES).tolist()
    return Summary(
        len(pairs),
        len(every),
        p50,
        p68,
        p90,
        p95,
        (low, high),
        bias=float(np.median(np.concatenate([pair.signed[pair.lit] for pair in pairs]))),
        noise=float(np.mean([pair.noise for pair in pairs if pair.lit.any()])),
        total_error=float(np.mean([pair.total_error for pair in pairs])),
        ssim=float(np.mean([pair.ssim for pair in pairs])),
        delta_e=float(np.mean([pair.delta_e for pair in pairs])),
    )


def group_errors_by_band(
    pairs: Sequence[PairErrors], bands: Sequence[NDArray[np.str_]]
) -> Mapping[str, tuple[int, float]]:
    """Return the number of lit pixels and their median relative error by band.

    Parameters
    ----------
    pairs
        See `compare_pair`.
    bands
        Band of each pixel per pair, (H, W); "": none.
    """
    names = np.concatenate([band[p.lit] for p, band in zip(pairs, bands, strict=True)])
    errors = np.concatenate([p.relative[p.lit] for p in pairs])
    return {
        str(name): (int(np.count_nonzero(names == name)), float(np.median(errors[names == name])))
        for name in np.unique(names)
        if name
    }


def _sigma(photograph: Photograph) -> Float64Array:
    return np.asarray(
        np.sqrt(np.asarray(photograph.variance, np.float64) @ np.square(LUMINANCE_WEIGHTS))
    )


FULL_MODEL: Final = "full model"


@dataclass(frozen=True, slots=True, eq=False)
class Comparison:
    """Errors of a model over all held-out photographs.

    Attributes
    ----------
    subject
        Pseudonym of the face.
    full
        Errors of the full model.
    by_kind
        Errors by the reason for which photographs were held out: "light", "view", ...
    ablation
        Errors of ablated models; the key names the replacement.
    by_band
        Lit pixels and median error by band of skin color, see `skinrig.evaluating.skin_bands`.
    typology_angle_deg
        Median over the face, of the ground truth if given, else of R_d.
    typology_of
        "truth" or "r_d".
    shots
        Result of each photograph: view, light, held_out, median, lit pixels, noise, ssim.
    assumed
        Assumptions.
    subsurface
        Treatment of subsurface light in the full model.
    seconds
        Run time.
    """

    subject: str
    full: Summary
    by_kind: Mapping[str, Summary]
    ablation: Mapping[str, Summary]
    by_band: Mapping[str, tuple[int, float]]
    typology_angle_deg: float
    typology_of: str
    shots: tuple[dict[str, Any], ...]
    assumed: tuple[str, ...]
    subsurface: Subsurface
    seconds: float

    @property
    def passed(self) -> bool:
        """Whether the median relative error is within the limit."""
        return self.full.median < MAX_MEDIAN_ERROR

    def document(self) -> dict[str, Any]:
        """Return the comparison as JSON values."""
        document = dataclasses.asdict(self)
        document[FULL_MODEL], document["photographs"] = document.pop("full"), document.pop("shots")
        document["by_band"] = {
            band: {"pixels": pixels, "median": median}
            for band, (pixels, median) in self.by_band.items()
        }
        return {
            **document,
            "band": str(classify_typology(self.typology_angle_deg)),
            "lit_pixels": (
                "pixel and neighbors entirely on measured skin with full visibility of the light, "
                f"not saturated, at least {MIN_SIGNAL_SIGMAS:g} times its noise"
            ),
            "limit": MAX_MEDIAN_ERROR,
            "passed": self.passed,
        }


def print_comparison(console: Console, record: Mapping[str, Any]) -> None:
    """Print a record of `evaluate_folders`."""
    for assumption in record["assumed"]:
        console.print_line(f"assumed: {assumption}")
    full = record[FULL_MODEL]
    held_out = {f"{name} held out": row for name, row in record["by_kind"].items()}
    rows = {FULL_MODEL: full, **held_out, **record["ablation"]}
    shares = ("median", "p68", "p95", "bias", "total_error")
    console.print_table(
        (
            *("model", "photographs", "median error, %", "68 %", "95 %", "bias", "all skin, %"),
            *("SSIM", "Delta E"),
        ),
        [
            (
                *(name, row["pairs"], *(round(100 * row[k], 2) for k in shares)),
                *(round(row["ssim"], 4), round(row["delta_e"], 3)),
            )
            for name, row in rows.items()
        ],
    )
    for band, row in record["by_band"].items():
        console.print_line(f"{band} skin: {100 * row['median']:.2f} %, {row['pixels']} pixels")
    word = "kept" if record["passed"] else "MISSED"
    console.print_line(
        f"{word}: median relative error of the luminance on lit pixels: "
        f"{100 * full['median']:.2f} % (< {100 * record['limit']:g}); by noise alone "
        f"{100 * full['noise']:.2f} %"
    )
    console.print_line(f"{record['out']}: {', '.join(record['files'])}, {record['seconds']:.1f} s")
    console.print_document(record["schema"], {k: v for k, v in record.items() if k != "schema"})
