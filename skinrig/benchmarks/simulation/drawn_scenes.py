"""Draw scenes of the flash rig, the dome and the gradient rig, and compare their effects."""

import dataclasses
import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from capture.rig import load_rig
from rigsim.as_built.sphere import PATTERN_WEIGHTS, build_sphere
from rigsim.needs.effects import EffectSelection, PixelNoise, SceneEffects
from rigsim.population.files import SubjectFile
from rigsim.scenes.dome.scene import DomeScene
from rigsim.scenes.flash.scene import FlashScene
from rigsim.scenes.gradient.scene import GRADIENT_METER_RATE_PER_S, GradientScene
from rigsim.skin_patch.microrelief import make_micro_skin
from rigsim.subject.perfusion import STATE_NAMES
from rigsim.world.taped_skin import GripState
from skinrig.arrays import Float64Array
from skinrig.benchmarks.simulation.tissue_omissions import draw_person
from skinrig.simulating.dome import MIN_FRONT_COSINE, small_dome

FACE_TEXELS: Final = 128
FLASH_WIDTHS_PX: Final = (48, 72, 112)
DOME_WIDTHS_PX: Final = (40, 64, 96)
GRADIENT_WIDTHS_PX: Final = (40, 56, 72)
LEVEL_RANGE: Final = (0.003, 1.5)
"""Signal of the brightest skin, full scales; power of the flash up to 1."""
NEUTRAL_PROBABILITY: Final = 0.4
MOVED_LIGHT_PROBABILITY: Final = 0.5
LIGHT_ANGLES_DEG: Final = (5.0, 85.0)
"""Angle of a moved flash to the camera's axis."""
BRIGHT_QUANTILE: Final = 0.9999
PATCH_MM: Final = 1.8
PATCH_SITES: Final = ("forehead", "cheek")
PATCH_STRETCHES: Final = (1.0, 0.7)
"""Stretches of a patch: at rest, and nearly the strongest compression of the usual plan."""
PATCH_ANGLES_DEG: Final = (0.0, 45.0, 90.0)
APERTURE_MM: Final = 8.0

BUILT_SWITCHES: Final[Mapping[str, Mapping[str, Any]]] = {
    "flash": {
        **dict.fromkeys(("lateral", "interreflections", "spectral"), True),
        **dict.fromkeys(("optics", "relief_shadows"), True),
        "spectral_step": 1,
        "last_bounce": 1e-7,
    },
    "dome": {
        **dict.fromkeys(("subsurface", "interreflections", "spectral"), True),
        **dict.fromkeys(("optics", "relief_shadows"), True),
        "last_bounce": 1e-7,
    },
    "gradient": dict.fromkeys(("shadows", "lateral", "interreflections", "optics"), True),
}
"""Switches of a scene with all effects."""

NOT_COMPARED: Final = {"dome": ("subsurface", "last_bounce"), "flash": ("last_bounce",)}
"""Switches without comparison: lateral scattering in the dome also moves shadows from rays to
texels, and further bounces are negligible."""


@dataclass(frozen=True, slots=True)
class DrawnEffect:
    """One effect of one drawn scene."""

    name: str
    """Its name."""
    verdict: str
    """Verdict of the scene's rule."""
    predicted: float
    """Largest change over noise by the rule."""
    found: float
    """Largest change of a pixel over its noise, against the scene with all effects."""


@dataclass(frozen=True, slots=True, eq=False)
class DrawnScene:
    """A drawn scene by its requested effects."""

    make: Callable[[SceneEffects], Any]
    """Returns the scene with requested effects."""
    render: Callable[[Any], Float64Array]
    """Returns images of a scene, full scales."""


def compare_drawn(rig: str, seed: int) -> Iterator[DrawnEffect]:
    """Compare a drawn scene with all effects with the same scene without each of them.

    Parameters
    ----------
    rig
        "flash", "dome" or "gradient".
    seed
        Seed of the person, the exposure, the lights and the state.
    """
    drawn = _DRAWS[rig](np.random.default_rng([list(_DRAWS).index(rig), seed]))
    everything = BUILT_SWITCHES[rig]
    full = drawn.make(SceneEffects.from_switches(everything))
    have = drawn.render(full)
    sigma = PixelNoise.of(full.sensor()).sigma(have)
    needs: EffectSelection = drawn.make(SceneEffects()).needs
    for effect in needs:
        if effect.switch not in everything or effect.switch in NOT_COMPARED.get(rig, ()):
            continue
        # without a choice of the rule, the next coarser wavelengths would change pixels
        coarser = int(effect.choice or 1) if (effect.choice or 1) > 1 else 2
        off = coarser if effect.switch == "spectral_step" else False
        other = drawn.make(SceneEffects.from_switches({**everything, effect.switch: off}))
        change = np.abs(np.minimum(have, 1.0) - np.minimum(drawn.render(other), 1.0)) / sigma
        predicted = float(effect.over_noise or 0.0)
        yield DrawnEffect(effect.name, effect.verdict, predicted, float(change.max()))


def _draw_level(rng: np.random.Generator, highest: float) -> float:
    low, high = math.log(LEVEL_RANGE[0]), math.log(highest)
    return float(np.exp(rng.uniform(low, high)))


def _draw_face(rng: np.random.Generator) -> tuple[Any, str]:
    """Return a face in a state, and the state."""
    person = draw_person(rng)
    seed = int(rng.integers(2**31))
    face = SubjectFile(melanin=person.melanin).face(seed=seed, size=FACE_TEXELS)
    neutral = rng.random() < NEUTRAL_PROBABILITY
    state = "neutral" if neutral else str(rng.choice(STATE_NAMES))
    return dataclasses.replace(face, tissue=person.tissue).with_expression(state), state


def _draw_flash(rng: np.random.Generator) -> DrawnScene:
    rig = load_rig("flash").resized(int(rng.choice(FLASH_WIDTHS_PX)))
    face, state = _draw_face(rng)
    power = _draw_level(rng, 1.0)
    lights = []
    for light in rig.lights[: int(rng.integers(1, len(rig.lights) + 1))]:
        if rng.random() < MOVED_LIGHT_PROBABILITY:
            off, around = np.radians([rng.uniform(*LIGHT_ANGLES_DEG), rng.uniform(0.0, 360.0)])
            way = np.array(
                [np.sin(off) * np.cos(around), np.sin(off) * np.sin(around), np.cos(off)]
            )
            x, y, z = (float(part) for part in math.hypot(*light.position_mm) * way)
            light = dataclasses.replace(light, position_mm=(x, y, z))
        lights.append(light)
    lit = dataclasses.replace(rig, lights=tuple(lights))
    return DrawnScene(
        lambda effects: FlashScene(lit, face, state=state, power=power, effects=effects),
        lambda scene: power * np.stack([scene.radiance(stop) for stop in ("parallel", "crossed")]),
    )


def _draw_dome(rng: np.random.Generator) -> DrawnScene:
    rig = small_dome(load_rig("dome"), views=1, width_px=int(rng.choice(DOME_WIDTHS_PX)))
    front = [
        light.name
        for light in rig.lights
        if light.position_mm[2] > MIN_FRONT_COSINE * math.hypot(*light.position_mm)
    ]
    lit = rig.subset(lights=[str(name) for name in rng.choice(front, 2, replace=False)])
    face, state = _draw_face(rng)
    level, view = _draw_level(rng, LEVEL_RANGE[1]), rig.views[0].name
    bright = np.quantile(DomeScene(lit, face, state=state).radiance(view), BRIGHT_QUANTILE)
    on_s = level / float(bright)
    return DrawnScene(
        lambda effects: DomeScene(lit, face, state=state, on_s=on_s, effects=effects),
        lambda scene: on_s * np.asarray(scene.radiance(view), np.float64),
    )


def _draw_gradient(rng: np.random.Generator) -> DrawnScene:
    rig = load_rig("gradient").cropped(int(rng.choice(GRADIENT_WIDTHS_PX)))
    person = draw_person(rng)
    site = str(rng.choice(PATCH_SITES))
    patch = make_micro_skin(site, seed=person.seed, size_mm=PATCH_MM, person=person)
    level = _draw_level(rng, LEVEL_RANGE[1])
    on_s = level / (GRADIENT_METER_RATE_PER_S * float(patch.albedo.max()))
    sphere = build_sphere(rig, seed=int(rng.integers(1000)))
    angle = float(rng.choice(PATCH_ANGLES_DEG))
    grips = [
        GripState(angle if r != 1.0 else 0.0, 0, APERTURE_MM * r, r, True, False)
        for r in PATCH_STRETCHES
    ]
    patterns = [name for name in PATTERN_WEIGHTS if name != "dark"]

    def render(scene: Any) -> Float64Array:
        images = [
            scene.radiance(pattern, grip=grip, analyzer_deg=reading)
            for grip in grips
            for pattern in patterns
            for reading in (0.0, 90.0)
        ]
        return on_s * np.stack(images).astype(np.float64)

    return DrawnScene(
        lambda effects: GradientScene(rig, patch, sphere=sphere, on_s=on_s, effects=effects), render
    )


_DRAWS: Final[Mapping[str, Callable[[np.random.Generator], DrawnScene]]] = {
    "flash": _draw_flash,
    "dome": _draw_dome,
    "gradient": _draw_gradient,
}
RIG_NAMES: Final = tuple(_DRAWS)
"""Rigs whose scenes can be drawn."""
