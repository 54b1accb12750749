"""Benchmark of effects that scenes omit: change of pixels over noise, and saved time."""

import dataclasses
import time
from collections import Counter
from collections.abc import Iterator, Mapping
from functools import partial
from typing import Any

import numpy as np

from capture.rig import load_rig
from rigsim.fiber.probe_tissue import HomogeneousTissue, parse_tissue
from rigsim.needs.effects import NEGLIGIBLE_NOISE_RATIO, SceneEffects
from rigsim.needs.face import LATERAL_EFFECT, RELIEF_SHADOW_EFFECT
from rigsim.needs.probe import (
    COLOR_EFFECT,
    CROSSTALK_EFFECT,
    DARK_CURRENT_EFFECT,
    WINGS_EFFECT,
    predict_light,
)
from rigsim.needs.tissue import TISSUE_RULES
from rigsim.scenes.probe.scene import MAX_USUAL_EXPOSURE_S, PHOTONS_PER_ANGLE, ProbeScene
from rigsim.subject.person_skin import SITE_NAMES
from rigsim.world.suction import HeadState
from skinrig.arrays import Float32Array, Float64Array
from skinrig.benchmarks.measurement import measure_processor_time
from skinrig.benchmarks.results import ErrorEstimate, Knobs, Timing
from skinrig.benchmarks.simulation import drawn_scenes, omission_cases, tissue_omissions
from skinrig.benchmarks.simulation.omission_cases import (
    FLOAT32_ROUNDING,
    ComparedScene,
    EffectComparison,
)
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
PROBE_SITE = "cheek"
PRESET_NAMES = ("I", "II", "III", "IV", "V", "VI")
N_PEOPLE = 20
N_TOY_PEOPLE = 1
FIRST_DRAWN_SEED = 120
"""Scenes of lower seeds set the rules' factors."""
TOY_PHOTONS = 20_000


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
    for rig in ("flash",) if stage.toy else drawn_scenes.RIG_NAMES:
        _add_drawn(stage, rig)
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


def _add_drawn(stage: BenchmarkStage, rig: str) -> None:
    """Add the effects of drawn scenes: predicted over found, and the omitted ones' changes."""
    count = N_TOY_PEOPLE if stage.toy else N_PEOPLE
    begun_s = time.process_time()
    found: dict[str, list[drawn_scenes.DrawnEffect]] = {}
    for number in range(count):
        for effect in drawn_scenes.compare_drawn(rig, FIRST_DRAWN_SEED + number):
            found.setdefault(effect.name, []).append(effect)
    seconds = (time.process_time() - begun_s) / max(len(found), 1)
    for name, effects in found.items():
        visible = [one for one in effects if one.found >= NEGLIGIBLE_NOISE_RATIO]
        ratios = [one.predicted / one.found for one in visible]
        omitted = [one for one in effects if one.verdict == "negligible"]
        knobs: Knobs = {"rig": rig, "subject": f"{count} drawn scenes"}
        knobs |= {"effect": name, "verdict": "by the rules"}
        also: Knobs = {"visible": len(visible), "omitted": len(omitted)}
        if ratios:
            least, median, high, most = np.quantile(ratios, (0.0, 0.5, 0.9, 1.0))
            also |= {"predicted over found, least": float(least), "median": float(median)}
            also |= {"9 of 10": float(high), "largest": float(most)}
            if name != RELIEF_SHADOW_EFFECT:  # a few pixels decide it: the rule is a bound
                stage.limits["tight", rig, name] = float(high)
        change = max((one.found for one in omitted), default=0.0)
        timing = Timing.single(seconds, no_memory_reason=NO_MEMORY_REASON)
        stage.add(knobs, timing, ErrorEstimate.nonnegative(change, 0.0), also)
        stage.limits["drawn", rig, name] = change


def _changes_more_than_effect(comparison: EffectComparison) -> bool:
    """Return whether the switch of an effect also changes other parts of the scene."""
    return comparison.rig == "dome" and comparison.effect == LATERAL_EFFECT


def _cases(toy: bool) -> Iterator[EffectComparison]:
    yield from omission_cases.check_flat_targets()
    yield from compare_probe(toy=toy)
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


def compare_probe(*, toy: bool = False) -> Iterator[EffectComparison]:
    """Compare scenes of the probe: a gray medium by color, and people by the actual probe.

    The medium has one color or 31 wavelengths, by the same photons.
    """
    rig = load_rig("probe")
    gray = HomogeneousTissue(0.05, 1.5)
    bands = tuple(float(nm) for nm in range(400, 701, 10))
    colored = dataclasses.replace(gray, sigma_a_per_mm=(0.05,) * len(bands), wavelength_nm=bands)
    head = HeadState("forehead", 0.0, True, 0.0, 5.0)
    images, seconds = [], []

    def profiled(tissue: HomogeneousTissue) -> tuple[ProbeScene, Any]:
        made = ProbeScene(rig, tissue, photons=TOY_PHOTONS if toy else PHOTONS_PER_ANGLE)
        return made, made.profile(head)

    for tissue in (colored, gray):
        spent_s, (made, profile) = measure_processor_time(partial(profiled, tissue))
        seconds.append(spent_s)
        if profile is None:
            raise ValueError("gray tissue: got no profile, expected a head on skin; place the head")
        images.append(made.image(made.transmit_through_fibers(profile.reflectance_per_mm2)))
    brightest = np.float32(images[0].max())
    compared = ComparedScene("probe", "gray medium", ProbeScene(rig, gray))
    have, lack = (part / brightest for part in images)  # stored photons, the same for both
    effect = compared.scene.needs[COLOR_EFFECT]
    yield compared.compare_images(effect, have, lack, (seconds[0], seconds[1]))
    bare = {
        switch: ProbeScene(rig, gray, effects=SceneEffects.from_switches({switch: False}))
        for switch in ("crosstalk", "wings")
    }
    for number in range(1 if toy else N_PEOPLE):
        preset = PRESET_NAMES[number % len(PRESET_NAMES)]
        skin = parse_tissue(preset, seed=number)
        compared = ComparedScene("probe", f"{preset}, seed {number}", ProbeScene(rig, skin))
        yield from _compare_probe_build(compared, bare)


def spot_masks(scene: ProbeScene) -> Float32Array:
    """Return the pixels of each fiber's spot, 0 or 1, shape (F, H W)."""
    view, build = scene.rig.views[0], scene.build
    y, x = np.mgrid[: view.height_px, : view.width_px].reshape(2, 1, -1)
    left, top = build.spot_px.T[:, :, None]
    inside = np.hypot(x - left, y - top) <= build.radius_px[:, None]
    return inside.astype(np.float32)


def read_spots(scene: ProbeScene, spots: ProbeScene, reflectance: Float64Array) -> Float64Array:
    """Return the mean signal in each spot in the longest exposure, full scales, (F, 3).

    Parameters
    ----------
    scene
        Scene of the light.
    spots
        Scene of the spots.
    reflectance
        Light in the fibers, 1/mm^2, (F, 3).
    """
    masks = spot_masks(spots)
    image = scene.image(scene.transmit_through_fibers(reflectance)).reshape(-1, 3)
    mean = masks @ image / masks.sum(axis=1)[:, None]
    return np.asarray(MAX_USUAL_EXPOSURE_S * mean, np.float64)


def _compare_probe_build(
    compared: ComparedScene, bare: Mapping[str, ProbeScene]
) -> Iterator[EffectComparison]:
    """Compare the actual probe with one without cross-talk, wings or dark current.

    ``bare`` has scenes without an effect by its switch, of any tissue.
    """
    scene = compared.scene
    # by the tables: ratios of neighbors with few photons are those of noise
    reflectance = predict_light(scene.rig, scene.tissue)[SITE_NAMES.index(PROBE_SITE)]
    with_s, have = measure_processor_time(partial(read_spots, scene, scene, reflectance))
    for name in (CROSSTALK_EFFECT, WINGS_EFFECT):
        other = bare[scene.needs[name].switch]
        without_s, lack = measure_processor_time(partial(read_spots, other, scene, reflectance))
        # in the longest exposure in which the spot is not saturated
        share = 1.0 / np.maximum(have, 1.0)
        over = np.abs(have - lack) * share / compared.noise.sigma(have * share)
        found = float((over * spot_masks(scene).sum(axis=1)[:, None] ** 0.5).max())
        effect = scene.needs[name]
        yield EffectComparison(
            *(compared.rig, compared.subject, name, effect.verdict, effect.over_noise),
            *(found, found * FLOAT32_ROUNDING, with_s, without_s),
        )
    sensor = scene.sensor()
    full_e = sensor.gain_e_per_dn * (sensor.white - sensor.black)
    hot_s, hot = measure_processor_time(
        lambda: np.asarray(scene.hot_e_per_s * MAX_USUAL_EXPOSURE_S / full_e, np.float32)
    )
    none_s, none = measure_processor_time(lambda: np.zeros_like(hot))
    yield compared.compare_images(scene.needs[DARK_CURRENT_EFFECT], hot, none, (hot_s, none_s))
