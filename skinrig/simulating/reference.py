"""Build scenes of voxel skin for sessions: `--renderer reference` of all rigs."""

import dataclasses
from collections.abc import Callable, Collection
from typing import Any, Final

from capture.rig import Rig
from model.skin import SkinAppearance
from rigsim.as_built.sphere import ActualSphere
from rigsim.fiber.probe_tissue import SkinTissue
from rigsim.mitsuba.render_error import RenderError
from rigsim.mitsuba.variant import choose_renderer
from rigsim.population import files as subject_file
from rigsim.scenes.reference.dome_session import VoxelDomeScene, render_directions_of_views
from rigsim.scenes.reference.face_skin import N_PIGMENTS
from rigsim.scenes.reference.flash_session import VoxelFlashScene, render_skin
from rigsim.scenes.reference.gradient_session import COARSE_PX, VoxelGradientScene, render_grooves
from rigsim.scenes.reference.probe_session import VoxelProbeScene
from rigsim.subject import SimulatedSubject
from rigsim.subject.person_skin import ABDOMEN_SITE, SITE_NAMES
from skinrig.errors import require_choice
from skinrig.simulating.driving import encode_arrays
from skinrig.simulating.orders import (
    MIN_WIDTH_PX,
    DomeOrder,
    FlashOrder,
    GradientOrder,
    SimulationError,
)

MAX_PATCH_PX: Final = 32
"""Largest width of a patch, px."""
VOXEL_FILE: Final = "voxels.npz"
"""Voxels of a patch in the ground truth of the flash rig."""
FACE_SITE_NAMES: Final = tuple(name for name in SITE_NAMES if name != ABDOMEN_SITE)
DEFAULT_SITE: Final = "cheek"
PATCH_SAMPLES: Final = {"small": 512, "full": 2048}
"""Samples per pixel at the most sensitive wavelength; 512 leave 2.5 % of noise."""
MAX_GROOVES_PX: Final = 512
"""Largest width of the gradient rig's image, px."""
GROOVE_SAMPLES: Final = {"small": 1024, "full": 4096}
"""Samples per 8 x 8 pixels of grooves, for each three patterns and each of three wavelengths."""
GROOVE_SECONDS_PER_SAMPLE: Final = 2e-4
"""Processor seconds per 8 x 8 pixels and sample, all patterns and wavelengths (type III)."""
DIRECTION_SAMPLES: Final = {"small": 256, "full": 2048}
"""Samples per camera, light and pigment of a face at the most sensitive wavelength."""
PIGMENT_SECONDS: Final = {"small": 15.0, "full": 60.0}
"""Processor seconds per pigment of a face (two cores, type III)."""
PATCH_PHOTONS: Final = {"small": 10_000, "full": 40_000}
"""Photons per site, direction and wavelength below the probe."""
PATCH_SECONDS_PER_SAMPLE: Final = 4e-4
"""Processor seconds per pixel and sample, all wavelengths (two cores, type III)."""
PROBE_SECONDS_PER_PHOTON: Final = 8e-4
"""Processor seconds per photon at each wavelength, all wavelengths (two cores, type III)."""


def check_flash_order(order: FlashOrder) -> None:
    """Raise `SimulationError` for options that a patch lacks, or that a face lacks."""
    if order.renderer != "reference":
        order.refuse_options("flash (renderer mitsuba or fast)", "site")
        return
    names = ("mesh", "states", "nearer_mm", "bands", "sequence", "leave_out", "plan")
    order.refuse_options("flash (renderer reference)", *names)
    width_px = order.width_px or MIN_WIDTH_PX
    if width_px > MAX_PATCH_PX or width_px % 2:
        raise SimulationError(
            f"width: got {width_px}, expected an even number up to {MAX_PATCH_PX} pixels for "
            f"renderer reference, whose time grows with the pixels: {MIN_WIDTH_PX} take a minute "
            "of processor time at small scale; lower it"
        )


def check_dome_order(order: DomeOrder) -> None:
    """Raise `SimulationError` for options that a face of voxel skin lacks."""
    if order.renderer != "reference" or order.target is not None:
        return
    names = ("move", "subsurface", "interreflections", "leave_out")
    order.refuse_options("dome (renderer reference)", *names)
    if order.state != "neutral":
        raise SimulationError(
            f"state: got {order.state!r}, expected neutral for renderer reference; remove it"
        )


def make_dome_scene(
    rig: Rig,
    face: SimulatedSubject,
    *,
    noise_seed: int,
    size: str,
    progress: Callable[[str], None] | None,
    **scene: Any,
) -> VoxelDomeScene:
    """Render the voxels of a face's pigments, and return the face in the dome.

    Parameters
    ----------
    rig
        The nominal dome.
    face
        The face at its position.
    noise_seed
        Seed of the session.
    size
        "small" or "full": samples per pigment.
    progress
        Called with the expected time, and with a line per pigment.
    scene
        Further arguments of `VoxelDomeScene`.
    """
    _require_llvm()
    cameras = len({view.spectral_sensitivity for view in rig.views})
    _announce(progress, PIGMENT_SECONDS[size] * N_PIGMENTS * cameras)
    directions = render_directions_of_views(
        rig, face, samples=DIRECTION_SAMPLES[size], seed=noise_seed, progress=progress
    )
    return VoxelDomeScene(rig, face, directions, seed=noise_seed, **scene)


def check_gradient_order(order: GradientOrder) -> GradientOrder:
    """Return the order of skin at rest; raise `SimulationError` for options that voxels lack."""
    if order.renderer != "reference" or order.target is not None:
        return order
    order.refuse_options("gradient (renderer reference)", "plan", "leave_out")
    if order.steps not in (None, (0, 0)):
        first, last = order.steps
        raise SimulationError(
            f"steps: got {first}..{last}, expected 0..0 for renderer reference, whose skin is at "
            "rest; remove it"
        )
    if (order.width_px or 0) > MAX_GROOVES_PX:
        raise SimulationError(
            f"width: got {order.width_px}, expected at most {MAX_GROOVES_PX} pixels for renderer "
            "reference, whose time grows with the pixels; lower it"
        )
    return dataclasses.replace(order, steps=(0, 0))


def make_gradient_scene(
    rig: Rig,
    sphere: ActualSphere,
    *,
    subject: str,
    site: str,
    seed: int,
    noise_seed: int,
    size: str,
    on_s: float | None,
    progress: Callable[[str], None] | None,
) -> VoxelGradientScene:
    """Render grooves of a subject's skin as voxels, and return them in the gradient rig.

    Parameters
    ----------
    rig, sphere
        The rig with its cropped camera, and its actual LEDs.
    subject, site
        Preset of the skin, or a file; site of the skin.
    seed, noise_seed
        Seeds of subject, and of one session.
    size
        "small" or "full": samples.
    on_s
        Longest exposure of the plan, s.
    progress
        Called with the expected time, and with a line per wavelength.
    """
    _require_llvm()
    samples = GROOVE_SAMPLES[size]
    blocks = (rig.views[0].width_px / COARSE_PX) ** 2
    _announce(progress, GROOVE_SECONDS_PER_SAMPLE * samples * blocks)
    person = subject_file.load_subject(subject).skin(seed=seed)
    grooves = render_grooves(
        rig, sphere, person, site, samples=samples, seed=noise_seed, progress=progress
    )
    return VoxelGradientScene(rig, grooves, sphere=sphere, seed=noise_seed, on_s=on_s)


def make_patch_scene(
    rig: Rig,
    *,
    subject: str,
    site: str | None,
    seed: int,
    noise_seed: int,
    size: str,
    progress: Callable[[str], None] | None,
) -> VoxelFlashScene:
    """Render a patch of a subject's skin before the flash rig.

    Parameters
    ----------
    rig
        Result of `rigsim.scenes.reference.flash_session.crop_to_patch`.
    subject
        Preset of the skin, or a file.
    site
        Site of the face; None: `DEFAULT_SITE`.
    seed, noise_seed
        Seeds of subject, and of one session, whose repeats share the renderer's noise.
    size
        "small" or "full": samples per pixel.
    progress
        Called with the expected time, and with a line per wavelength.
    """
    _require_llvm()
    samples = PATCH_SAMPLES[size]
    pixels = rig.views[0].width_px * rig.views[0].height_px
    _announce(progress, PATCH_SECONDS_PER_SAMPLE * samples * pixels)
    person = subject_file.load_subject(subject).skin(seed=seed)
    skin = render_skin(
        rig, person, site or DEFAULT_SITE, samples=samples, seed=noise_seed, progress=progress
    )
    return VoxelFlashScene(rig, skin, seed=noise_seed)


def add_voxels(scene: VoxelFlashScene, truth: SkinAppearance) -> SkinAppearance:
    """Return the ground truth of a patch with its voxels as parameters and file."""
    about, maps = scene.describe_voxels()
    return dataclasses.replace(
        truth,
        parameters={**truth.parameters, "voxels": dict(about)},
        files={VOXEL_FILE: encode_arrays(maps)},
    )


def make_probe_scene(
    rig: Rig,
    *,
    subject: str,
    seed: int,
    noise_seed: int | None,
    size: str,
    places: Collection[tuple[str, float]],
    progress: Callable[[str], None] | None,
) -> VoxelProbeScene:
    """Return the scene of a subject's skin as voxels under the probe.

    Parameters
    ----------
    rig
        The probe.
    subject
        Preset of the skin, or a file.
    seed, noise_seed
        Seeds of subject and photons, and of one session.
    size
        "small" or "full": photons.
    places
        Sites with directions of the head, degrees.
    progress
        Called with the expected time, and with a line per traced place.

    Raises
    ------
    SimulationError
        The subject is not a person, or a site is not on the face.
    """
    tissue: Any = subject_file.load_tissue(subject, seed=seed)
    if not isinstance(tissue, SkinTissue):
        raise SimulationError(
            f"subject: got {subject!r}, expected a person for renderer reference; a medium has "
            "no voxels, so remove the renderer"
        )
    for site, _ in places:
        require_choice("site", site, FACE_SITE_NAMES, SimulationError)
    photons = PATCH_PHOTONS[size]
    _announce(progress, PROBE_SECONDS_PER_PHOTON * photons * len(places))
    return VoxelProbeScene(
        rig, tissue, photons=photons, seed=seed, noise_seed=noise_seed, progress=progress
    )


def _require_llvm() -> None:
    try:
        choose_renderer("reference")
    except RenderError as error:
        raise SimulationError(str(error)) from error


def _announce(progress: Callable[[str], None] | None, seconds: float) -> None:
    if progress is not None:
        progress(f"voxels: about {max(round(seconds, -1), 10.0):.0f} s of processor time")
