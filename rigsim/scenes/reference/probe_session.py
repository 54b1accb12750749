"""Voxels of a person's skin below the fiber probe, as a scene of sessions."""

from collections.abc import Callable, Collection
from typing import Final

import numpy as np

from capture.rig import Rig
from rigsim.fiber.probe_profile import BandProfile, ProfileCache
from rigsim.fiber.probe_tissue import SkinTissue, TissueError
from rigsim.mitsuba.variant import Renderer
from rigsim.needs.effects import Effect, EffectSelection, omitted_effects
from rigsim.needs.face import BAND_EFFECT, POLARIZATION_EFFECT
from rigsim.needs.probe import (
    COLOR_EFFECT,
    CROSSTALK_EFFECT,
    DARK_CURRENT_EFFECT,
    LAYERS_EFFECT,
    TRANSPORT_EFFECT,
    WINGS_EFFECT,
)
from rigsim.needs.tissue import TISSUE_RULES
from rigsim.scenes.probe.scene import ProbeScene
from rigsim.scenes.reference.placed_paths import HeadPlace
from rigsim.scenes.reference.probe_skin import read_person
from rigsim.subject.person_skin import PersonSkinError

PHOTONS_PER_LAID_PATH: Final = 100
PROBE_EFFECTS: Final = (
    POLARIZATION_EFFECT,
    BAND_EFFECT,
    TRANSPORT_EFFECT,
    CROSSTALK_EFFECT,
    WINGS_EFFECT,
    DARK_CURRENT_EFFECT,
    COLOR_EFFECT,
)
"""Effects of the probe that hold for any tissue of several bands."""
UNEVEN_EFFECT: Final = "pigment and blood that vary below the head"


class VoxelProfiles(ProfileCache):
    """Readings of voxels of a person's skin, see `rigsim.scenes.reference.probe_skin`.

    Parameters
    ----------
    rig, tissue, photons, seed
        As for `ProfileCache`; photons are those at each wavelength.
    progress
        Called with a line per traced place.
    """

    tissue: SkinTissue

    def __init__(
        self,
        rig: Rig,
        tissue: SkinTissue,
        *,
        photons: int,
        seed: int,
        progress: Callable[[str], None] | None = None,
    ) -> None:
        super().__init__(rig, tissue, photons=photons, seed=seed)
        self._progress = progress
        self._allowed: frozenset[tuple[str, float]] | None = None

    def trace_only(self, places: Collection[tuple[str, float]]) -> None:
        """Trace places now, and refuse all others from now on.

        Parameters
        ----------
        places
            Sites with directions of the head, degrees.

        Raises
        ------
        TissueError
            The person's face has no such site.
        """
        for site, angle_deg in places:
            self.profile(site, angle_deg)
        self._allowed = frozenset(places)

    def profile(self, site: str, angle_deg: float = 0.0, suction_mbar: float = 0.0) -> BandProfile:
        """Return the fibers' reflectance at a site, under the probe's nominal suction.

        Parameters
        ----------
        site, angle_deg
            As for `ProfileCache.profile`.
        suction_mbar
            Ignored.

        Raises
        ------
        TissueError
            The person's face has no such site, or `trace_only` has excluded the place.
        """
        del suction_mbar
        if self._allowed is not None and (site, angle_deg) not in self._allowed:
            known = ", ".join(f"{name} at {turn:g} degrees" for name, turn in sorted(self._allowed))
            raise TissueError(
                f"place: got {site} at {angle_deg:g} degrees, expected one whose voxels were "
                f"traced before the first request: {known}; place the head there"
            )
        return self._profiles.get((site, angle_deg), lambda: self._read(site, angle_deg))

    def _read(self, site: str, angle_deg: float) -> BandProfile:
        if self._progress is not None:
            self._progress(f"voxels: {site}, {angle_deg:g} degrees")
        try:
            found = read_person(
                self.tissue.person,
                site,
                self.rig,
                (HeadPlace(angle_deg=angle_deg),),
                photons=self.photons,
                laid_paths=max(self.photons // PHOTONS_PER_LAID_PATH, 1),
                seed=self.seed,
            )
        except PersonSkinError as error:
            raise TissueError(str(error)) from error
        value = found.reflectance_per_mm2[0]
        stderr = np.hypot(
            found.ratio[0] * found.even_stderr, found.even_per_mm2 * found.ratio_stderr[0]
        )
        return BandProfile(value, stderr)


class VoxelProbeScene(ProbeScene):
    """A person's skin as voxels under the probe.

    Parameters
    ----------
    rig, seed, noise_seed, photons
        As for `ProbeScene`; photons are those at each wavelength.
    tissue
        The person's skin.
    progress
        Called with a line per traced place.
    """

    profiles: VoxelProfiles
    renderer: Renderer = "reference"
    """Renderer of the detector's image and of the skin."""

    def __init__(
        self,
        rig: Rig,
        tissue: SkinTissue,
        *,
        photons: int,
        seed: int = 0,
        noise_seed: int | None = None,
        progress: Callable[[str], None] | None = None,
    ) -> None:
        super().__init__(rig, tissue, seed=seed, noise_seed=noise_seed, photons=photons)
        self.profiles = VoxelProfiles(rig, tissue, photons=photons, seed=seed, progress=progress)
        self.needs = EffectSelection(
            (
                *(self.needs[name] for name in PROBE_EFFECTS),
                *(Effect(rule.name, "built", "voxels have the person's") for rule in TISSUE_RULES),
                Effect(LAYERS_EFFECT, "built", "epidermis above dermis, thinned by suction"),
                Effect(UNEVEN_EFFECT, "built", "those of the face"),
                *omitted_effects("probe", "probe_voxels"),
            )
        )
