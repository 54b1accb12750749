"""Read and validate a simulated person from a preset or a file, which serves all rigs.

A file is TOML; every key is optional, and unknown keys are errors:

================ ==================================================================================
schema           "skinrig.subject/1"
preset           pigment, "I" to "VI", "palest" or "darkest"; "III"
member           "P01" to "P87" of the simulated population, with own head, seed and conditions;
                 of the other keys it takes melanin, blood, freckles, oil and beard
melanin          volume fraction of melanosomes around which skin varies, 0.001 to 0.45; replaces it
tone             "ita:DEGREES" or "monk:N": the melanin of a skin of that tone
blood            factor of all blood, 0.1 to 4
freckles         0 to 1; drawn from the seed if omitted
oil              factor of the surface fraction covered by oil, 0 to 3
beard            stubble of a member, 0 to 1; its own if omitted
tissue_model     other properties of the skin: "drawn" from the seed as people vary (default),
                 "published" (from whole published ranges), "typical", or "papers" (papers' model)
epidermis_mm     thickness of the epidermis, mm, at equal melanin per area; this and the next ones
                 replace those of the model, in `rigsim.tissue.skin_layers.PROPERTY_RANGES`
...              site_contrast, basal_melanin_fraction, epidermal_blood_ratio, oxygenation,
                 scattering_per_mm, rayleigh_fraction, scattering_slope, baseline_amplitude,
                 eumelanin_fraction
mesh             file of the face's geometry, .npz or .obj
melanin_map      texture of melanin, volume fraction of the epidermis, 0.0005 to 0.5
hemoglobin_map   texture of blood at rest, volume fraction of the dermis, 0 to 0.31
================ ==================================================================================

Paths are relative to the file's own folder. Textures are square, .npy or .exr of one channel, row 0
is the top (v = 1), on the texture coordinates of the mesh, or of the procedural head without one.
All random properties are drawn from the seed, as for a preset.
"""

import dataclasses
import functools
import hashlib
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, cast

import numpy as np

from capture.documents import Document, Fault, FaultCollector, parse_document, read_toml
from rigsim.fiber.probe_tissue import ProbedTissue, SkinTissue, TissueError, parse_tissue
from rigsim.geometry.mesh import Mesh, MeshError, load_mesh
from rigsim.population.population import Member, PopulationError, get_member
from rigsim.population.textures import MAP_RANGES, SubjectFileError, load_texture, resample_texture
from rigsim.skin_patch.microrelief import MicroSkin, make_micro_skin
from rigsim.subject import PRESET_NAMES, SimulatedSubject, make_subject, pigment
from rigsim.subject.perfusion import MAX_HEMOGLOBIN, draw_perfusion
from rigsim.subject.person_skin import MELANIN_RANGE, PUBLISHED_SPREAD, PersonSkin, draw_tissue
from rigsim.subject.skin_tone import SkinToneError, is_skin_tone, melanin_of_tone
from rigsim.tissue.skin_layers import PAPER_SKIN, PROPERTY_RANGES, TYPICAL_SKIN, TissueProperties

SCHEMA: Final = "skinrig.subject/1"
SUBJECT_SUFFIX: Final = ".toml"
DRAWN_TISSUE: Final = "drawn"
TISSUE_SPREADS: Final[Mapping[str, float]] = {DRAWN_TISSUE: 1.0, "published": PUBLISHED_SPREAD}
"""Spreads of the properties that are drawn from the seed, by name."""
NAMED_TISSUES: Final[Mapping[str, TissueProperties]] = {
    "typical": TYPICAL_SKIN,
    "papers": PAPER_SKIN,
}
"""Named properties of skin that do not vary."""
_FILE_KEYS: Final = ("mesh", *MAP_RANGES)
_MEMBER_KEYS: Final = ("schema", "member", "melanin", "blood", "freckles", "oil", "beard")
_UNUSED_KEYS: Final = dict.fromkeys(("gradient", "probe"), ("oil", *_FILE_KEYS))
"""Keys without effect in a rig: a patch of plain skin, and skin by its layers."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SubjectFile(Document):
    """Description of a simulated person except for the seed; see the module's text."""

    schema: str = SCHEMA
    preset: str = "III"
    member: str | None = None
    """Name of a member of the population; None: the person is drawn from the seed."""
    melanin: float | None = None
    """None: that of the tone, the preset or the member."""
    tone: str | None = None
    """A text of `rigsim.subject.skin_tone`; None: that of the preset."""
    blood: float = 1.0
    freckles: float | None = None
    """None: drawn."""
    oil: float = 1.0
    beard: float | None = None
    """None: that of the member."""
    tissue_model: str = DRAWN_TISSUE
    """One of `TISSUE_SPREADS` or `NAMED_TISSUES`."""
    epidermis_mm: float | None = None
    """None: that of the model, as for the next ones."""
    site_contrast: float | None = None
    basal_melanin_fraction: float | None = None
    epidermal_blood_ratio: float | None = None
    oxygenation: float | None = None
    scattering_per_mm: float | None = None
    rayleigh_fraction: float | None = None
    scattering_slope: float | None = None
    baseline_amplitude: float | None = None
    eumelanin_fraction: float | None = None
    mesh: str | None = None
    """Path; None: the procedural head."""
    melanin_map: str | None = None
    """Path; None: drawn around `melanin`."""
    hemoglobin_map: str | None = None
    """Path; None: drawn."""

    def __post_init__(self) -> None:
        """Check ranges, and that no property is set twice."""
        checks = FaultCollector("the subject", SubjectFileError)
        checks.check("schema", self.schema, self.schema == SCHEMA, repr(SCHEMA))
        known = ", ".join(PRESET_NAMES)
        checks.check("preset", self.preset, self.preset in PRESET_NAMES, f"one of {known}")
        models = (*TISSUE_SPREADS, *NAMED_TISSUES)
        known = f"one of {', '.join(models)}"
        checks.check("tissue_model", self.tissue_model, self.tissue_model in models, known)
        for name, low, high in (
            ("melanin", *MELANIN_RANGE),
            ("blood", 0.1, 4.0),
            ("freckles", 0.0, 1.0),
            ("oil", 0.0, 3.0),
            ("beard", 0.0, 1.0),
            *((name, *ends) for name, ends in PROPERTY_RANGES.items()),
        ):
            value = getattr(self, name)
            good = value is None or low <= value <= high
            checks.check(name, value, good, f"{low:g} to {high:g}")
        self._check_member(checks)
        if self.tone is not None:
            try:
                melanin_of_tone(self.tone)
            except SkinToneError as error:
                raise SubjectFileError(str(error)) from error
            alone = self.melanin is None and self.melanin_map is None
            checks.check("tone", self.tone, alone, "no melanin or melanin_map together with it")
        if self.melanin_map is not None:
            drawn = self.melanin is None and self.freckles is None
            checks.check(
                "melanin_map", self.melanin_map, drawn, "no melanin or freckles together with it"
            )
        if self.hemoglobin_map is not None:
            checks.check(
                "hemoglobin_map",
                self.hemoglobin_map,
                self.blood == 1.0,
                "no blood together with it",
            )
        checks.close()

    def _check_member(self, checks: FaultCollector) -> None:
        """Check that a member exists, and that no other key describes the same person."""
        if self.member is None:
            checks.check("beard", self.beard, self.beard is None, "a member together with it")
            return
        own = [f for f in dataclasses.fields(self) if f.name not in _MEMBER_KEYS]
        others = ", ".join(f.name for f in own if getattr(self, f.name) != f.default)
        checks.check("member", self.member, not others, f"no {others} together with it")
        try:
            self.person()
        except PopulationError as error:
            raise SubjectFileError(str(error)) from error

    def person(self) -> Member | None:
        """Return the member with the file's changes; None without a member."""
        if self.member is None:
            return None
        own, names = get_member(self.member), ("melanin", "freckles", "beard")
        given: Any = {k: v for k in names if (v := getattr(self, k)) is not None}
        return dataclasses.replace(
            own, blood=self.blood * own.blood, oil=self.oil * own.oil, **given
        )

    def melanosome_fraction(self, *, seed: int) -> float:
        """Return the volume fraction of melanosomes around which the skin varies."""
        if self.melanin is not None:
            return self.melanin
        if self.tone is not None:
            return melanin_of_tone(self.tone, self.properties(seed=seed))
        return pigment.MELANIN_PRESETS[self.preset]

    def properties(self, *, seed: int) -> TissueProperties:
        """Return the properties of the skin except for melanin and blood."""
        given = {name: getattr(self, name) for name in PROPERTY_RANGES}
        own = {name: value for name, value in given.items() if value is not None}
        spread = TISSUE_SPREADS.get(self.tissue_model, 0.0)
        model = NAMED_TISSUES.get(self.tissue_model) or draw_tissue(seed, spread=spread)
        return dataclasses.replace(model, **own)

    def face(
        self, *, seed: int, size: int = 512, mesh: Mesh | str | Path | None = None
    ) -> SimulatedSubject:
        """Return the simulated face.

        Parameters
        ----------
        seed
            Seed of all random draws, >= 0.
        size
            Texels along each side of the maps, 64 to 8192.
        mesh
            Geometry where the file has none.

        Raises
        ------
        SubjectFileError
            An unusable texture, or two meshes.
        rigsim.subject.SubjectError, rigsim.geometry.mesh.MeshError
            See `rigsim.subject.make_subject`.
        """
        if mesh is not None and (own := self.mesh or self.member) is not None:
            raise SubjectFileError(f"mesh: the subject's file sets {own}; omit the other mesh")
        if (member := self.person()) is not None:
            return member.face(size)
        fraction = self.melanosome_fraction(seed=seed)
        found = make_subject(
            pigment.nearest_preset(fraction),
            seed=seed,
            size=size,
            mesh=mesh or self.mesh,
            blood=self.blood,
        )
        found = dataclasses.replace(found, tissue=self.properties(seed=seed), oiliness=self.oil)
        if fraction == pigment.MELANIN_PRESETS[found.preset] and not self._has_own_maps:
            return found
        perfusion = draw_perfusion(
            found.perfusion.points_mm,
            found.perfusion.regions,
            pigment.typical_blood(fraction),
            seed=seed,
            amount=self.blood,
        )
        if self.melanin_map is not None:
            melanin = resample_texture("melanin_map", self.melanin_map, size)
        else:
            melanin = pigment.draw_melanin_map(
                perfusion.points_mm, perfusion.regions, fraction, seed=seed, freckles=self.freckles
            )
        if self.hemoglobin_map is not None:
            blood = resample_texture("hemoglobin_map", self.hemoglobin_map, size).astype(np.float64)
            # The fold b = t / (1 + (t / m)^4)^(1/4) of `Perfusion.blood` has the inverse
            # t = b / (1 - (b / m)^4)^(1/4); compartments keep their fractions.
            wanted = blood / (1.0 - (blood / MAX_HEMOGLOBIN) ** 4) ** 0.25
            factor = wanted / perfusion.compartments.sum(axis=-1)
            perfusion = dataclasses.replace(
                perfusion,
                compartments=np.asarray(perfusion.compartments * factor[..., None], np.float32),
            )
        return dataclasses.replace(found, melanin=melanin, perfusion=perfusion)

    @property
    def _has_own_maps(self) -> bool:
        return any(v is not None for v in (self.freckles, self.melanin_map, self.hemoglobin_map))

    def patch(self, site: str, *, seed: int, size_mm: float) -> MicroSkin:
        """Return a patch of skin for the gradient sphere, see `make_micro_skin`."""
        return make_micro_skin(site, seed=seed, size_mm=size_mm, person=self.skin(seed=seed))

    def tissue(self, *, seed: int) -> SkinTissue:
        """Return the skin below the fiber probe, see `SkinTissue`."""
        return SkinTissue(self.skin(seed=seed))

    def skin(self, *, seed: int) -> PersonSkin:
        """Return the skin that every rig simulates."""
        if (member := self.person()) is not None:
            return member.skin
        return PersonSkin(
            self.melanosome_fraction(seed=seed),
            self.blood,
            seed,
            self.freckles,
            self.properties(seed=seed),
        )

    def unused_keys(self, rig: str) -> tuple[str, ...]:
        """Return the given keys that have no effect in a rig."""
        usual = SubjectFile()
        return tuple(k for k in _UNUSED_KEYS.get(rig, ()) if getattr(self, k) != getattr(usual, k))


def is_subject_file(text: str) -> bool:
    """Return whether a subject's text is the path of a file.

    Examples
    --------
    >>> is_subject_file("people/ann.toml"), is_subject_file("IV"), is_subject_file("P12")
    (True, False, False)
    """
    return text.endswith(SUBJECT_SUFFIX)


def load_subject(text: str) -> SubjectFile:
    """Load the subject of a text: a preset, a skin tone or a file.

    Parameters
    ----------
    text
        A preset, a tone of `rigsim.subject.skin_tone`, or the path of a file whose name ends in
        .toml.

    Raises
    ------
    SubjectFileError
        It is neither, or the file is unusable; every fault is listed.

    Examples
    --------
    >>> load_subject("IV").melanosome_fraction(seed=0)
    0.0395
    """
    if is_subject_file(text):
        return read_subject_file(text)
    if is_skin_tone(text):
        return SubjectFile(tone=text)
    if text not in PRESET_NAMES:
        raise SubjectFileError(
            f"subject: got {text!r}, expected one of {', '.join(PRESET_NAMES)}, ita:DEGREES, "
            f"monk:1 to monk:10, or a file NAME{SUBJECT_SUFFIX}; choose one [SR-SIM-005]"
        )
    return SubjectFile(preset=text)


def load_tissue(text: str, *, seed: int) -> ProbedTissue:
    """Load the tissue below the fiber probe from a text.

    Parameters
    ----------
    text
        A file, a skin tone, a member of the population, "P01" to "P87", or an argument of
        `rigsim.fiber.probe_tissue.parse_tissue`.
    seed
        Seed of the variation between subjects.
    """
    if is_subject_file(text) or is_skin_tone(text) or text in PRESET_NAMES:
        return load_subject(text).tissue(seed=seed)
    if re.fullmatch(r"P\d+", text):
        return SkinTissue(load_member_skin(text))
    try:
        return parse_tissue(text, seed=seed)
    except TissueError as error:
        if ":" in text:  # a medium with wrong numbers
            raise
        raise TissueError(f"{error}, or a file NAME{SUBJECT_SUFFIX}") from error


def load_member_skin(name: str) -> PersonSkin:
    """Return the skin of a member of the population; an unknown name raises `TissueError`."""
    try:
        return get_member(name).skin
    except PopulationError as error:
        raise TissueError(f"subject: {error}") from error


def read_subject_file(path: str | Path) -> SubjectFile:
    """Read a subject's file; its paths become relative to the file's folder.

    Raises
    ------
    SubjectFileError
        It cannot be read or is invalid; every fault is listed.
    """
    place = Path(path)
    document = read_toml(place, error=SubjectFileError)
    faults: list[Fault] = []
    if "schema" not in document:
        faults.append(Fault("schema", "nothing", f'a first line schema = "{SCHEMA}"'))
    found = _parse_document(document, str(path), faults)
    files = {
        key: str(place.parent / name)
        for key in _FILE_KEYS
        if (name := getattr(found, key)) is not None
    }
    for key, name in files.items():
        if not Path(name).is_file():
            faults.append(Fault(key, name, "an existing file"))
    if faults:
        raise _faults_error(str(path), faults)
    for key, name in files.items():
        if key in MAP_RANGES:
            load_texture(key, name)
        else:
            _check_mesh(str(path), name, Path(name).stat().st_mtime_ns)
    return dataclasses.replace(found, **cast(Any, files))


def _parse_document(document: Mapping[str, Any], where: str, faults: list[Fault]) -> SubjectFile:
    """Return the valid keys of a document, and add the faults of the others to a list.

    Ranges are checked only when all types are valid. To report both kinds at once, faulty keys are
    removed and the rest is checked again.
    """
    rest = dict(document)
    while True:
        try:
            return parse_document(SubjectFile, rest, where=where, error=SubjectFileError)
        except SubjectFileError as error:
            faults += error.faults
            wrong = {re.split(r"[.\[]", fault.path)[0] for fault in error.faults}
            if not wrong & rest.keys():  # an unknown key, such as "a.b"
                raise _faults_error(where, faults) from error
            rest = {key: value for key, value in rest.items() if key not in wrong}


def _faults_error(where: str, faults: list[Fault]) -> SubjectFileError:
    return SubjectFileError(
        "1 fault" if len(faults) == 1 else f"{len(faults)} faults",
        where=where,
        faults=faults,
        advice="Correct these keys of the file.",
        code="SR-SIM-006",
    )


@functools.lru_cache(maxsize=8)
def _check_mesh(where: str, path: str, changed_ns: int) -> None:
    """Raise if a mesh is unusable; a mesh is read once as long as it is unchanged."""
    try:
        load_mesh(path)
    except MeshError as error:
        raise SubjectFileError(f"mesh: {error}", where=where) from error


def record_subject(text: str) -> str | dict[str, Any]:
    """Return the record of a subject for manifest and ground truth: a preset, or a file's content.

    Parameters
    ----------
    text
        Text from the command line; other text than a file's path is returned unchanged.

    Returns
    -------
    str or dict
        For a file, its name and the keys that it sets; for the files that it lists, name and
        SHA-256, which distinguishes files of the same name.
    """
    if not is_subject_file(text):
        return text
    found, usual = read_subject_file(text), SubjectFile()
    record: dict[str, Any] = {"file": Path(text).name, "preset": found.preset}
    for key in (field.name for field in dataclasses.fields(found)):
        value = getattr(found, key)
        if key in _FILE_KEYS and value is not None:
            digest = hashlib.sha256(Path(value).read_bytes()).hexdigest()
            record[key] = {"file": Path(value).name, "sha256": digest}
        elif value != getattr(usual, key):
            record[key] = value
    return record
