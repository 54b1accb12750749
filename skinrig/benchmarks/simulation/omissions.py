"""Benchmark of what scenes leave out: how much pixels change by it, and the seconds it saves."""

from __future__ import annotations

from collections.abc import Iterator

from rigsim.needs.face import LATERAL_EFFECT
from skinrig.benchmarks.measurement import Limit, Point, StageBenchmark, Timing
from skinrig.benchmarks.simulation import omission_cases, omission_probe
from skinrig.benchmarks.simulation.omission_cases import Omission

MAX_OMITTED_NOISE_RATIO = 0.1
"""Of a pixel's noise: what may be left out. Not `rigsim.needs.effects.NEGLIGIBLE_NOISE_RATIO`
itself, so that a rule that was loosened shows here."""

WHY_NO_MEMORY = "scenes share what they trace: a picture's memory is not its own"
FLASH_PX = 192
GRAZED_PX = 96
GRAZING_DEG = 88.0
"""A plate that faces the camera gets 1/29 of what faces the light."""
DOME_PX = 100
GRADIENT_PX = 128
N_DOME_LIGHTS = 3


def omissions(*, toy: bool) -> StageBenchmark:
    """Render scenes of each rig with and without what their rules decide on.

    A point is one effect of one scene: its seconds are those of the picture without the effect, its
    error the largest change of any pixel over that pixel's noise. All pictures but the probe's are
    sums without chance, so that what is uncertain is rounding; the probe's are of equal photons.
    """
    found = list(_cases(toy))
    points, limits = [], []
    for one in found:
        spent = one.without_s
        timing = Timing(spent, (spent, spent), spent, None, no_memory=WHY_NO_MEMORY)
        knobs: dict[str, str | int | float | bool] = {
            "rig": one.rig,
            "subject": one.subject,
            "effect": one.effect,
            "verdict": one.verdict,
        }
        also: dict[str, str | int | float | bool] = {"seconds saved": one.with_s - one.without_s}
        if one.told is not None:
            also["told by the rule"] = one.told
        interval = (max(one.found - one.uncertain, 0.0), one.found + one.uncertain)
        points.append(Point(knobs, timing, one.found, interval, also=also))
        if one.verdict == "negligible":
            limits.append(
                Limit(
                    f"{one.rig}, {one.subject}: {one.effect}: change with 3 standard errors",
                    one.at_most,
                    MAX_OMITTED_NOISE_RATIO,
                    "<=",
                    "of the noise",
                )
            )
    built = [one for one in found if one.verdict == "built"]
    told = [one for one in built if one.told is not None and not _other_shadows(one)]
    limits.append(
        Limit(
            "largest change, less its rounding, over what the rule told, of what is built",
            max(((one.found - one.uncertain) / (one.told or 1e-30) for one in told), default=0.0),
            1.0,
            "<=",
        )
    )
    return StageBenchmark(
        "omissions",
        "largest change of a pixel by leaving it out, over its noise",
        "the same scene with the effect",
        max(one.uncertain for one in found),
        tuple(points),
        tuple(limits),
        left_out=(
            ("effects that no scene can build", "a session's and a report's table names them"),
            ("effects that the simulated world has not", "there is nothing to render"),
            (
                "what the rule told of spreading in the dome's skin",
                "its switch also takes shadows from texels instead of from rays; "
                "the flash rig's does not",
            ),
        ),
        no_bands="subjects are points of their own",
        condition=("rig", "subject", "effect", "verdict"),
        interval_of="rounding in single precision: pictures with and without share all chance",
    )


def _other_shadows(one: Omission) -> bool:
    """Return whether switching an effect changes more than the effect."""
    return one.rig == "dome" and one.effect == LATERAL_EFFECT


def _cases(toy: bool) -> Iterator[Omission]:
    yield from omission_cases.flat_targets()
    yield from omission_probe.gray_tissue()
    if toy:
        yield from omission_cases.flash_face("darkest", width_px=64, texels=64)
        return
    for preset in ("II", "VI", "darkest"):
        yield from omission_cases.flash_face(preset, width_px=FLASH_PX)
    yield from omission_cases.flash_face("darkest", width_px=GRAZED_PX, light_deg=GRAZING_DEG)
    for preset in ("II", "darkest"):
        yield from omission_cases.dome_face(preset, width_px=DOME_PX, lights=N_DOME_LIGHTS)
    yield from omission_cases.moved_face("II", width_px=DOME_PX, lights=N_DOME_LIGHTS)
    yield from omission_cases.gradient_skin("forehead", width_px=GRADIENT_PX)
