"""Compare scenes of drawn people with the tissue that rules select and with all of it."""

import dataclasses
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any, Final, cast

import numpy as np

from capture.rig import load_rig
from rigsim.fiber.probe_profile import ProfileCache
from rigsim.fiber.probe_tissue import SkinTissue
from rigsim.needs.effects import EffectSelection, PixelNoise, SceneEffects
from rigsim.needs.probe import equivalent_pixels, predict_profiles
from rigsim.needs.tissue import TISSUE_RULES
from rigsim.population.files import SubjectFile
from rigsim.scenes.dome.scene import DomeScene
from rigsim.scenes.flash.scene import FlashScene
from rigsim.scenes.gradient.reference import NEUTRAL_GRIP
from rigsim.scenes.gradient.scene import GRADIENT_METER_RATE_PER_S, GradientScene
from rigsim.scenes.probe.detector import render_fiber_images
from rigsim.scenes.probe.scene import ProbeScene
from rigsim.skin_patch.microrelief import change_patch_tissue, make_micro_skin
from rigsim.subject.person_skin import PersonSkin, draw_tissue
from rigsim.tissue.skin_layers import TYPICAL_SKIN, TissueProperties
from skinrig.arrays import Float64Array
from skinrig.benchmarks.measurement import measure_processor_seconds, measure_processor_time
from skinrig.simulating.dome import small_dome

MELANIN_RANGE: Final = (0.005, 0.3)
POWER_RANGE: Final = (0.01, 1.0)
"""Signal of the brightest skin, or power of the flash."""
DEVIATION_RANGE: Final = (1e-5, 1.0)
"""Factor of each property's deviation from typical skin, so that rules omit some and build some."""
THICKNESS_RANGE_MM: Final = (0.06, 0.13)
BASAL_FRACTION_RANGE: Final = (TYPICAL_SKIN.basal_melanin_fraction, 0.6)
FACE_TEXELS: Final = 96
FLASH_PX, DOME_PX, GRADIENT_PX = 64, 48, 48
PATCH_MM: Final = 1.5
PROBE_PHOTONS: Final = 4000
PROBE_SITE: Final = "cheek"
ALL_TISSUE: Final = SceneEffects(**{rule.switch: True for rule in TISSUE_RULES})
"""Every property of the tissue is built."""


@dataclass(frozen=True, slots=True)
class TissueComparison:
    """One scene with the selected tissue against the same scene with all of it."""

    omitted: tuple[str, ...]
    """Names of the properties that are negligible."""
    change: float
    """Largest change of a pixel, or of a fiber's reading, over its noise."""
    all_s: float
    """Processor seconds of the scene with all properties."""
    selected_s: float
    """Processor seconds with the selected ones."""

    @property
    def error_growth(self) -> float:
        """Relative growth of a pixel's error: noise alone to noise and change.

        Examples
        --------
        >>> round(TissueComparison((), 0.1, 1.0, 1.0).error_growth, 4)
        0.005
        """
        return float(np.hypot(1.0, self.change)) - 1.0


def draw_person(rng: np.random.Generator) -> PersonSkin:
    """Draw a person whose properties deviate from typical skin by very different amounts.

    Examples
    --------
    >>> first, second = (draw_person(np.random.default_rng(seed)) for seed in (1, 2))
    >>> first == second
    False
    """
    low, high = np.log(MELANIN_RANGE)
    melanin, seed = float(np.exp(rng.uniform(low, high))), int(rng.integers(2**31))
    drawn = dataclasses.replace(
        draw_tissue(seed),
        epidermis_mm=float(rng.uniform(*THICKNESS_RANGE_MM)),
        basal_melanin_fraction=float(rng.uniform(*BASAL_FRACTION_RANGE)),
    )
    values = {}
    for rule in TISSUE_RULES:
        scale = _draw_log_uniform(rng, DEVIATION_RANGE)
        for name in rule.fields:
            typical = getattr(TYPICAL_SKIN, name)
            values[name] = typical + scale * (getattr(drawn, name) - typical)
    return PersonSkin(melanin, seed=seed, tissue=TissueProperties(**values))


def _draw_log_uniform(rng: np.random.Generator, ends: tuple[float, float]) -> float:
    return float(np.exp(rng.uniform(*np.log(ends))))


def compare_scenes(rig: str, count: int) -> Iterator[TissueComparison]:
    """Compare scenes of one rig, of fixed seeds.

    Parameters
    ----------
    rig
        Name of the rig.
    count
        Number of people.
    """
    compare = _COMPARISONS[rig]
    for number in range(count):
        rng = np.random.default_rng([list(_COMPARISONS).index(rig), number])
        yield compare(draw_person(rng), _draw_log_uniform(rng, POWER_RANGE))


def _compare_flash(person: PersonSkin, power: float) -> TissueComparison:
    rig, face = load_rig("flash").resized(FLASH_PX), _face(person)

    def make(tissue: TissueProperties, effects: SceneEffects) -> FlashScene:
        subject = dataclasses.replace(face, tissue=tissue)
        return FlashScene(rig, subject, power=power, effects=effects)

    def light(scene: FlashScene) -> Float64Array:
        stops = ("parallel", "crossed")
        return power * np.stack([scene.radiance(name) for name in stops]).astype(np.float64)

    return _compare(person.tissue, make, light)


def _compare_dome(person: PersonSkin, power: float) -> TissueComparison:
    rig, face = small_dome(load_rig("dome"), lights=1, views=1, width_px=DOME_PX), _face(person)
    view = rig.views[0].name
    on_s = power / float(DomeScene(rig, face).radiance(view).max())

    def make(tissue: TissueProperties, effects: SceneEffects) -> DomeScene:
        return DomeScene(rig, dataclasses.replace(face, tissue=tissue), on_s=on_s, effects=effects)

    def light(scene: DomeScene) -> Float64Array:
        return on_s * scene.radiance(view).astype(np.float64)

    return _compare(person.tissue, make, light)


def _compare_gradient(person: PersonSkin, power: float) -> TissueComparison:
    rig = load_rig("gradient").cropped(GRADIENT_PX)
    patch = make_micro_skin("cheek", seed=person.seed, size_mm=PATCH_MM, person=person)
    on_s = power / (GRADIENT_METER_RATE_PER_S * float(patch.albedo.max()))

    def make(tissue: TissueProperties, effects: SceneEffects) -> GradientScene:
        skin = change_patch_tissue(patch, tissue)
        return GradientScene(rig, skin, on_s=on_s, effects=effects)

    def light(scene: GradientScene) -> Float64Array:
        stops = scene.moments(NEUTRAL_GRIP).values()
        return on_s * np.stack([part[0] for part in stops]).astype(np.float64)

    return _compare(person.tissue, make, light)


def _compare_probe(person: PersonSkin, power: float) -> TissueComparison:
    """Compare readings of fibers by the tables; their exposures adapt to any power.

    Photons would not resolve the change: other layers scatter them elsewhere. They are timed alone.
    """
    del power
    rig = load_rig("probe")
    skin = SkinTissue(person)
    scene = ProbeScene(rig, skin)
    omitted, tissues = _negligible(scene.needs), (skin, cast(SkinTissue, scene.profiles.tissue))
    have, lack = (predict_profiles(rig, skin, one.person.tissue) for one in tissues)
    images = render_fiber_images(scene.build, rig.views[0])
    sigma = float(PixelNoise.of(scene.sensor()).sigma(1.0)) / equivalent_pixels(images) ** 0.5
    all_s, selected_s = (
        measure_processor_seconds(
            partial(ProfileCache(rig, one, photons=PROBE_PHOTONS, seed=0).profile, PROBE_SITE)
        )
        for one in tissues
    )
    change = float(np.abs(lack / have - 1.0).max()) / sigma
    return TissueComparison(omitted, change, all_s, selected_s if omitted else all_s)


def _compare(
    tissue: TissueProperties,
    make: Callable[[TissueProperties, SceneEffects], Any],
    light: Callable[[Any], Float64Array],
) -> TissueComparison:
    """Compare the images of a scene, in fractions of full scale."""
    shared = make(TYPICAL_SKIN, SceneEffects())
    light(shared)  # traces what all scenes of this face share while it exists

    def render(effects: SceneEffects) -> tuple[Any, Float64Array]:
        made = make(tissue, effects)
        return made, light(made)

    all_s, (_, have) = measure_processor_time(partial(render, ALL_TISSUE))
    selected_s, (scene, lack) = measure_processor_time(partial(render, SceneEffects()))
    sigma = PixelNoise.of(scene.sensor()).sigma(have)
    change = np.abs(np.minimum(lack, 1.0) - np.minimum(have, 1.0)) / sigma
    omitted = _negligible(scene.needs)
    # the second scene finds the tables of the first only where it omits nothing
    return TissueComparison(omitted, float(change.max()), all_s, selected_s if omitted else all_s)


def _face(person: PersonSkin) -> Any:
    face = SubjectFile(melanin=person.melanin).face(seed=0, size=FACE_TEXELS)
    return dataclasses.replace(face, tissue=person.tissue)


def _negligible(needs: EffectSelection) -> tuple[str, ...]:
    names = [rule.name for rule in TISSUE_RULES]
    return tuple(name for name in names if needs[name].verdict == "negligible")


_COMPARISONS: Final[dict[str, Callable[[PersonSkin, float], TissueComparison]]] = {
    "flash": _compare_flash,
    "dome": _compare_dome,
    "gradient": _compare_gradient,
    "probe": _compare_probe,
}
RIG_NAMES: Final = tuple(_COMPARISONS)
"""Rigs whose scenes can be compared."""
