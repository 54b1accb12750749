"""What photographs say of a fitted model: numbers, their record, and words for them."""

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

from skinrig.console import Console
from skinrig.evaluating.skin_bands import bands_of
from skinrig.rendering.photographs.errors import MAX_MEDIAN_ERROR, MIN_SIGNAL_SIGMAS, Summary
from skinrig.rendering.render import Subsurface

FULL_MODEL: Final = "full model"


@dataclass(frozen=True, slots=True, eq=False)
class Comparison:
    """What the photographs say of a model.

    Attributes
    ----------
    subject
        Pseudonym of the face.
    full
        Errors of the whole model.
    by_kind
        The same by why the photographs were not in the fit: "light", "view", ...
    ablation
        The same without parts; the key says what stands in.
    by_band
        Lit pixels and median error by band of skin color, see `skinrig.evaluating.skin_bands`.
    typology_angle_deg
        Median over the face, of the truth where there is one, else of R_d.
    typology_of
        "truth" or "r_d".
    shots
        What each photograph says: view, light, held_out, median, lit pixels, noise, ssim.
    assumed
        What was taken for granted.
    subsurface
        How the whole model treats light from inside.
    seconds
        Of rendering and comparing.
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
        """Whether the median relative error keeps to the limit."""
        return self.full.median < MAX_MEDIAN_ERROR

    def document(self) -> dict[str, Any]:
        """Return this as JSON values."""
        told = dataclasses.asdict(self)
        told[FULL_MODEL], told["photographs"] = told.pop("full"), told.pop("shots")
        told["by_band"] = {
            band: {"pixels": pixels, "median": median}
            for band, (pixels, median) in self.by_band.items()
        }
        return {
            **told,
            "band": str(bands_of(self.typology_angle_deg)),
            "lit_pixels": (
                "pixel and neighbors wholly on measured skin, every ray sees the whole light, not "
                f"saturated, at least {MIN_SIGNAL_SIGMAS:g} times its noise"
            ),
            "limit": MAX_MEDIAN_ERROR,
            "passed": self.passed,
        }


def print_comparison(console: Console, record: Mapping[str, Any]) -> None:
    """Print a record of `evaluate_folders`."""
    for assumption in record["assumed"]:
        console.say(f"assumed: {assumption}")
    full = record[FULL_MODEL]
    held_out = {f"{name} held out": row for name, row in record["by_kind"].items()}
    rows = {FULL_MODEL: full, **held_out, **record["ablation"]}
    shares = ("median", "p68", "p95", "bias", "total_error")
    console.rows(
        ("model", "photographs", "median error, %", "68 %", "95 %", "bias", "all skin, %", "SSIM"),
        [
            (name, row["pairs"], *(round(100 * row[k], 2) for k in shares), round(row["ssim"], 4))
            for name, row in rows.items()
        ],
    )
    for band, row in record["by_band"].items():
        console.say(f"{band} skin: {100 * row['median']:.2f} %, {row['pixels']} pixels")
    word = "kept" if record["passed"] else "MISSED"
    console.say(
        f"{word}: median relative error of the luminance on lit pixels: "
        f"{100 * full['median']:.2f} % (< {100 * record['limit']:g}); noise alone makes "
        f"{100 * full['noise']:.2f} %"
    )
    console.say(f"{record['out']}: {', '.join(record['files'])}, {record['seconds']:.1f} s")
    console.document(record["schema"], {k: v for k, v in record.items() if k != "schema"})
