"""Benchmark of what scenes leave out: how much pixels change by it, and the seconds it saves."""

from collections.abc import Iterator

from rigsim.needs.face import LATERAL_EFFECT
from skinrig.benchmarks.results import BandError, Knobs, Timing
from skinrig.benchmarks.simulation import omission_cases, omission_probe
from skinrig.benchmarks.simulation.omission_cases import Omission
from skinrig.benchmarks.stage import Stage

WHY_NO_MEMORY = "scenes share what they trace: a picture's memory is not its own"
FLASH_PX = 192
GRAZED_PX = 96
GRAZING_DEG = 88.0
"""A plate that faces the camera gets 1/29 of what faces the light."""
DOME_PX = 100
GRADIENT_PX = 128
N_DOME_LIGHTS = 3


def omissions(stage: Stage) -> None:
    """Render scenes of each rig with and without what their rules decide on.

    A point is one effect of one scene: its seconds are those of the picture without the effect, its
    error the largest change of any pixel over that pixel's noise. All pictures but the probe's are
    sums without chance, so that what is uncertain is rounding; the probe's are of equal photons.
    """
    found = list(_cases(stage.toy))
    for one in found:
        timing = Timing.single(one.without_s, no_memory=WHY_NO_MEMORY)
        knobs: Knobs = {"rig": one.rig, "subject": one.subject}
        knobs |= {"effect": one.effect, "verdict": one.verdict}
        also: Knobs = {"seconds saved": one.with_s - one.without_s}
        if one.told is not None:
            also["told by the rule"] = one.told
        stage.add(knobs, timing, BandError.of_size(one.found, one.uncertain), also)
        if one.verdict == "negligible":
            stage.limits["change", one.rig, one.subject, one.effect] = one.at_most
    built = [one for one in found if one.verdict == "built"]
    told = [one for one in built if one.told is not None and not _other_shadows(one)]
    stage.limits["over_rule"] = max(
        ((one.found - one.uncertain) / (one.told or 1e-30) for one in told), default=0.0
    )
    stage.reference_error = max(one.uncertain for one in found)


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
