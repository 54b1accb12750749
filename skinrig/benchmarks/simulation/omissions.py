"""Benchmark of effects that scenes omit: change of pixels over noise, and saved time."""

import dataclasses
from collections import Counter
from collections.abc import Iterator
from functools import partial
from typing import Any

import numpy as np

from capture.rig import load_rig
from rigsim.fiber.probe_tissue import HomogeneousTissue
from rigsim.needs.face import LATERAL_EFFECT
from rigsim.needs.probe import COLOR_EFFECT, CROSSTALK_EFFECT, DARK_CURRENT_EFFECT, WINGS_EFFECT
from rigsim.needs.tissue import TISSUE_RULES
from rigsim.scenes.probe.scene import MAX_USUAL_EXPOSURE_S, ProbeScene
from rigsim.world.suction import HeadState
from skinrig.arrays import Float32Array
from skinrig.benchmarks.measurement import measure_processor_time
from skinrig.benchmarks.results import ErrorEstimate, Knobs, Timing
from skinrig.benchmarks.simulation import omission_cases, tissue_omissions
from skinrig.benchmarks.simulation.omission_cases import ComparedScene, EffectComparison
from skinrig.benchmarks.stage import BenchmarkStage

NO_MEMORY_REASON = "scenes share traced rays, so that memory has no single scene"
FLASH_PX = 192
GRAZING_LIGHT_PX = 96
GRAZING_DEG = 88.0
"""Light angle at which a plate that faces the camera has 1/29 of the irradiance at normal
incidence (cos 88 degrees)."""
DOME_PX = 100
GRADIENT_PX = 128
N_DOME_LIGHTS = 3
N_PEOPLE = 20
N_TOY_PEOPLE = 1


def measure_omissions(stage: BenchmarkStage) -> None:
    """Measure scenes of each rig with and without the effects that their rules evaluate.

    A point is one effect of one scene. Its seconds are those of the image without the effect; its
    error is the largest change of any pixel over that pixel's noise. All images but the probe's are
    deterministic sums, whose error is rounding; the probe's images use the same photons.
    """
    found = list(_cases(stage.toy))
    for one in found:
        timing = Timing.single(one.without_s, no_memory_reason=NO_MEMORY_REASON)
        knobs: Knobs = {"rig": one.rig, "subject": one.subject}
        knobs |= {"effect": one.effect, "verdict": one.verdict}
        also: Knobs = {"seconds saved": one.with_s - one.without_s}
        if one.predicted_change is not None:
            also["predicted by the rule"] = one.predicted_change
        stage.add(knobs, timing, ErrorEstimate.nonnegative(one.found, one.change_stderr), also)
        if one.verdict == "negligible":
            stage.limits["change", one.rig, one.subject, one.effect] = one.max_change
    for rig in tissue_omissions.RIG_NAMES:
        _add_tissue(stage, rig)
    built = [one for one in found if one.verdict == "built"]
    predicted = [
        one
        for one in built
        if one.predicted_change is not None and not _changes_more_than_effect(one)
    ]
    stage.limits["over_rule"] = max(
        ((one.found - one.change_stderr) / (one.predicted_change or 1e-30) for one in predicted),
        default=0.0,
    )
    stage.reference_error = max(one.change_stderr for one in found)


def _add_tissue(stage: BenchmarkStage, rig: str) -> None:
    """Add scenes of drawn people with the tissue that the rules select, against all of it."""
    count = N_TOY_PEOPLE if stage.toy else N_PEOPLE
    found = list(tissue_omissions.compare_scenes(rig, count))
    omitted = Counter(name for one in found for name in one.omitted)
    knobs: Knobs = {"rig": rig, "subject": f"{count} people"}
    knobs |= {"effect": "tissue", "verdict": "by the rules"}
    growth = max(one.error_growth for one in found)
    also: Knobs = {f"omitted, {rule.name}": omitted[rule.name] for rule in TISSUE_RULES}
    also["seconds saved"] = sum(one.all_s - one.selected_s for one in found)
    also["growth of a pixel's error"] = growth
    spent_s = sum(one.selected_s for one in found)
    timing = Timing.single(spent_s, no_memory_reason=NO_MEMORY_REASON)
    change = max(one.change for one in found)
    stage.add(knobs, timing, ErrorEstimate.nonnegative(change, 0.0), also)
    stage.limits["growth", rig, count] = growth


def _changes_more_than_effect(comparison: EffectComparison) -> bool:
    """Return whether the switch of an effect also changes other parts of the scene."""
    return comparison.rig == "dome" and comparison.effect == LATERAL_EFFECT


def _cases(toy: bool) -> Iterator[EffectComparison]:
    yield from omission_cases.check_flat_targets()
    yield from compare_gray_tissue()
    if toy:
        yield from omission_cases.compare_flash_face("darkest", width_px=64, texels=64)
        return
    for preset in ("II", "VI", "darkest"):
        yield from omission_cases.compare_flash_face(preset, width_px=FLASH_PX)
    yield from omission_cases.compare_flash_face(
        "darkest", width_px=GRAZING_LIGHT_PX, light_deg=GRAZING_DEG
    )
    dome_face = partial(omission_cases.compare_dome_face, width_px=DOME_PX, lights=N_DOME_LIGHTS)
    for preset in ("II", "darkest"):
        yield from dome_face(preset)
    yield from dome_face("II", state="surprise")
    yield from omission_cases.compare_gradient_skin("forehead", width_px=GRADIENT_PX)


def compare_gray_tissue() -> Iterator[EffectComparison]:
    """Compare a gray medium with one color and with 31 wavelengths, by the same photons."""
    rig = load_rig("probe")
    gray = HomogeneousTissue(0.05, 1.5)
    bands = tuple(float(nm) for nm in range(400, 701, 10))
    colored = dataclasses.replace(gray, sigma_a_per_mm=(0.05,) * len(bands), wavelength_nm=bands)
    head = HeadState("forehead", 0.0, True, 0.0, 5.0)
    images, seconds = [], []

    def profiled(tissue: HomogeneousTissue) -> tuple[ProbeScene, Any]:
        made = ProbeScene(rig, tissue)
        return made, made.profile(head)

    for tissue in (colored, gray):
        spent_s, (made, profile) = measure_processor_time(partial(profiled, tissue))
        seconds.append(spent_s)
        if profile is None:
            raise ValueError("gray tissue: got no profile, expected a head on skin; place the head")
        images.append(made.image(made.transmit_through_fibers(profile.reflectance_per_mm2)))
    brightest = np.float32(images[0].max())
    scene = ProbeScene(rig, gray)
    compared = ComparedScene("probe", "gray medium", scene)
    have, lack = (part / brightest for part in images)  # stored photons, the same for both
    yield compared.compare_images(scene.needs[COLOR_EFFECT], have, lack, (seconds[0], seconds[1]))
    yield from _compare_probe_build(compared, head)


def _compare_probe_build(compared: ComparedScene, head: HeadState) -> Iterator[EffectComparison]:
    """Compare the actual probe with one without cross-talk, wings or dark current."""
    scene = compared.scene
    profile, build = scene.profile(head), scene.build

    def timed(made: ProbeScene) -> tuple[float, Float32Array]:
        return measure_processor_time(
            lambda: made.image(made.transmit_through_fibers(profile.reflectance_per_mm2))
        )

    with_s, have = timed(scene)
    unit = np.float32(have.max())
    plain = {
        CROSSTALK_EFFECT: dataclasses.replace(build, crosstalk=np.eye(len(build.crosstalk))),
        WINGS_EFFECT: dataclasses.replace(build, wings=0.0),
    }
    for name, without in plain.items():
        without_s, lack = timed(ProbeScene(scene.rig, scene.tissue, build=without))
        yield compared.compare_images(
            scene.needs[name], have / unit, lack / unit, (with_s, without_s)
        )
    sensor = scene.sensor()
    full_e = sensor.gain_e_per_dn * (sensor.white - sensor.black)
    hot_s, hot = measure_processor_time(
        lambda: np.asarray(scene.hot_e_per_s * MAX_USUAL_EXPOSURE_S / full_e, np.float32)
    )
    none_s, none = measure_processor_time(lambda: np.zeros_like(hot))
    yield compared.compare_images(scene.needs[DARK_CURRENT_EFFECT], hot, none, (hot_s, none_s))
