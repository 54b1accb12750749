"""A simulated person by a preset or a file: one text for all rigs, read and checked here.

A file is TOML; every key may be left out, and unknown ones are errors:

================ ==================================================================================
schema           "skinrig.subject/1"
preset           pigment, "I" to "VI", "palest" or "darkest"; "III"
melanin          volume fraction of melanosomes around which skin varies, 0.005 to 0.45, instead
blood            factor of all blood, 0.1 to 4
freckles         0 to 1; drawn by the seed where it is left out
oil              factor of the share of the surface that oil covers, 0 to 3
mesh             file of the face's geometry, .npz or .obj
melanin_map      texture of melanin, volume fraction of the epidermis, 0.0005 to 0.5
hemoglobin_map   texture of blood at rest, volume fraction of the dermis, 0 to 0.31
================ ==================================================================================

Files are named from the file's own folder. Textures are square, .npy or .exr of one channel, row 0
is the top (v = 1), on the texture coordinates of the mesh, or of the procedural head without one.
What is left to chance is drawn by the seed, as for a preset.
"""

import dataclasses
import functools
import hashlib
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, cast

import numpy as np

from capture.documents import Document, Fault, FaultCollector, parse_document, read_toml
from rigsim.fiber.probe_tissue import ProbedTissue, SkinTissue, TissueError, parse_tissue
from rigsim.geometry.mesh import Mesh, MeshError, load_mesh
from rigsim.population.textures import MAP_RANGES, SubjectFileError, load_texture, resample_texture
from rigsim.skin_patch.microrelief import MicroSkin, make_micro_skin
from rigsim.subject import PRESET_NAMES, SimulatedSubject, make_subject, pigment
from rigsim.subject.perfusion import MAX_HEMOGLOBIN

SCHEMA: Final = "skinrig.subject/1"
SUBJECT_SUFFIX: Final = ".toml"
PRESET_MELANIN_RANGE: Final = (0.005, 0.45)
"""That of the presets: what tables of light in skin are made for."""
_FILE_KEYS: Final = ("mesh", *MAP_RANGES)
_UNUSED_KEYS: Final[Mapping[str, tuple[str, ...]]] = {
    "gradient": ("blood", "freckles", "oil", *_FILE_KEYS),
    "probe": ("freckles", "oil", *_FILE_KEYS),
}
"""Keys that say nothing of what a rig sees: a patch of plain skin, and skin by its layers."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SubjectFile(Document):
    """What a simulated person is made of, but for the seed; see the module's text."""

    schema: str = SCHEMA
    preset: str = "III"
    melanin: float | None = None
    """None: that of the preset."""
    blood: float = 1.0
    freckles: float | None = None
    """None: drawn."""
    oil: float = 1.0
    mesh: str | None = None
    """Path; None: the procedural head."""
    melanin_map: str | None = None
    """Path; None: drawn around `melanin`."""
    hemoglobin_map: str | None = None
    """Path; None: drawn."""

    def __post_init__(self) -> None:
        """Check ranges, and that nothing is said twice."""
        checks = FaultCollector("the subject", SubjectFileError)
        checks.check("schema", self.schema, self.schema == SCHEMA, repr(SCHEMA))
        known = ", ".join(PRESET_NAMES)
        checks.check("preset", self.preset, self.preset in PRESET_NAMES, f"one of {known}")
        for name, low, high in (
            ("melanin", *PRESET_MELANIN_RANGE),
            ("blood", 0.1, 4.0),
            ("freckles", 0.0, 1.0),
            ("oil", 0.0, 3.0),
        ):
            value = getattr(self, name)
            good = value is None or low <= value <= high
            checks.check(name, value, good, f"{low:g} to {high:g}")
        if self.melanin_map is not None:
            drawn = self.melanin is None and self.freckles is None
            checks.check(
                "melanin_map", self.melanin_map, drawn, "no melanin and freckles beside it"
            )
        if self.hemoglobin_map is not None:
            checks.check(
                "hemoglobin_map", self.hemoglobin_map, self.blood == 1.0, "no blood beside it"
            )
        checks.close()

    @property
    def melanosome_fraction(self) -> float:
        """Volume fraction of melanosomes around which the skin varies."""
        return pigment.MELANIN_PRESETS[self.preset] if self.melanin is None else self.melanin

    @property
    def nearest_preset(self) -> str:
        """Name of the preset whose melanin is nearest, by its logarithm."""
        presets = pigment.MELANIN_PRESETS
        return min(
            presets, key=lambda name: abs(math.log(presets[name] / self.melanosome_fraction))
        )

    def face(
        self, *, seed: int, size: int = 512, mesh: Mesh | str | Path | None = None
    ) -> SimulatedSubject:
        """Return the face.

        Parameters
        ----------
        seed
            Of everything that is drawn, >= 0.
        size
            Texels along one side of the maps, 64 to 8192.
        mesh
            Geometry where the file names none.

        Raises
        ------
        SubjectFileError
            A texture cannot be used, or two meshes are named.
        rigsim.subject.SubjectError, rigsim.geometry.mesh.MeshError
            See `rigsim.subject.make_subject`.
        """
        if mesh is not None and self.mesh is not None:
            raise SubjectFileError(
                f"mesh: the subject's file names {self.mesh}; leave the other out"
            )
        found = make_subject(
            self.nearest_preset, seed=seed, size=size, mesh=mesh or self.mesh, blood=self.blood
        )
        if self == SubjectFile(preset=self.preset, blood=self.blood, mesh=self.mesh):
            return found
        perfusion = found.perfusion
        if self.melanin_map is not None:
            melanin = resample_texture("melanin_map", self.melanin_map, size)
        else:
            melanin = pigment.draw_melanin_map(
                perfusion.points_mm,
                perfusion.regions,
                self.melanosome_fraction,
                seed=seed,
                freckles=self.freckles,
            )
        if self.hemoglobin_map is not None:
            blood = resample_texture("hemoglobin_map", self.hemoglobin_map, size).astype(np.float64)
            # the fold of `Perfusion.blood`, backwards: compartments keep their shares
            wanted = blood / (1.0 - (blood / MAX_HEMOGLOBIN) ** 4) ** 0.25
            factor = wanted / perfusion.compartments.sum(axis=-1)
            perfusion = dataclasses.replace(
                perfusion,
                compartments=np.asarray(perfusion.compartments * factor[..., None], np.float32),
            )
        return dataclasses.replace(found, melanin=melanin, perfusion=perfusion, oiliness=self.oil)

    def patch(self, site: str, *, seed: int, size_mm: float) -> MicroSkin:
        """Return a patch of skin before the gradient sphere, see `make_micro_skin`."""
        return make_micro_skin(
            site, seed=seed, size_mm=size_mm, preset=self.nearest_preset, melanin=self.melanin
        )

    def tissue(self, *, seed: int) -> SkinTissue:
        """Return the skin under the fibre probe, see `SkinTissue`."""
        return SkinTissue(self.nearest_preset, seed=seed, melanin=self.melanin, blood=self.blood)

    def unused_keys(self, rig: str) -> tuple[str, ...]:
        """Return the keys that were given and say nothing of what a rig sees."""
        usual = SubjectFile()
        return tuple(k for k in _UNUSED_KEYS.get(rig, ()) if getattr(self, k) != getattr(usual, k))


def is_subject_file(text: str) -> bool:
    """Return whether a subject's text names a file.

    Examples
    --------
    >>> is_subject_file("people/ann.toml"), is_subject_file("IV"), is_subject_file("P12")
    (True, False, False)
    """
    return text.endswith(SUBJECT_SUFFIX)


def load_subject(text: str) -> SubjectFile:
    """Return the subject that a text names.

    Parameters
    ----------
    text
        A preset, or the path of a file whose name ends in .toml.

    Raises
    ------
    SubjectFileError
        It is neither, or the file cannot be used: every fault is named.

    Examples
    --------
    >>> load_subject("IV").melanosome_fraction
    0.047
    """
    if is_subject_file(text):
        return read_subject_file(text)
    if text not in PRESET_NAMES:
        raise SubjectFileError(
            f"subject: got {text!r}, expected one of {', '.join(PRESET_NAMES)}, or a file "
            f"NAME{SUBJECT_SUFFIX}"
        )
    return SubjectFile(preset=text)


def load_tissue(text: str, *, seed: int) -> ProbedTissue:
    """Return the tissue under the fibre probe that a text names.

    Parameters
    ----------
    text
        A file, or what `rigsim.fiber.probe_tissue.parse_tissue` takes.
    seed
        Of what differs between subjects.
    """
    if is_subject_file(text):
        return load_subject(text).tissue(seed=seed)
    try:
        return parse_tissue(text, seed=seed)
    except TissueError as error:
        if ":" in text:  # a medium whose numbers are wrong
            raise
        raise TissueError(f"{error}, or a file NAME{SUBJECT_SUFFIX}") from error


def read_subject_file(path: str | Path) -> SubjectFile:
    """Read a subject's file; the files that it names get its folder before them.

    Raises
    ------
    SubjectFileError
        It cannot be read, or holds what it must not: every fault is named.
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
            faults.append(Fault(key, name, "a file that is there"))
    if faults:
        number = "1 fault" if len(faults) == 1 else f"{len(faults)} faults"
        raise SubjectFileError(number, where=str(path), faults=faults)
    for key, name in files.items():
        if key in MAP_RANGES:
            load_texture(key, name)
        else:
            _check_mesh(str(path), name, Path(name).stat().st_mtime_ns)
    return dataclasses.replace(found, **cast(Any, files))


def _parse_document(document: Mapping[str, Any], where: str, faults: list[Fault]) -> SubjectFile:
    """Return what the right keys of a document say, the others' faults added to a list.

    Ranges are looked at only when all types are right: so that both are told at once, keys with
    faults are taken out, and the rest is looked at again.
    """
    rest = dict(document)
    while True:
        try:
            return parse_document(SubjectFile, rest, where=where, error=SubjectFileError)
        except SubjectFileError as error:
            faults += error.faults
            wrong = {re.split(r"[.\[]", fault.path)[0] for fault in error.faults}
            if not wrong & rest.keys():  # a name that is no key of ours, such as "a.b"
                raise SubjectFileError(error.what, where=where, faults=faults) from error
            rest = {key: value for key, value in rest.items() if key not in wrong}


@functools.lru_cache(maxsize=8)
def _check_mesh(where: str, path: str, changed_ns: int) -> None:
    """Raise where a mesh cannot be used; one is read once as long as it is not changed."""
    try:
        load_mesh(path)
    except MeshError as error:
        raise SubjectFileError(f"mesh: {error}", where=where) from error


def record_subject(text: str) -> str | dict[str, Any]:
    """Return what a manifest or a truth records of a subject: a preset, or all that a file says.

    Parameters
    ----------
    text
        As the command line has it; what is no file is returned as it is.

    Returns
    -------
    str or dict
        Of a file its name and the keys that it sets; of the files that it names the name and the
        SHA-256, so that others of the same name are told apart.
    """
    if not is_subject_file(text):
        return text
    found, usual = read_subject_file(text), SubjectFile()
    said: dict[str, Any] = {"file": Path(text).name, "preset": found.preset}
    for key in (field.name for field in dataclasses.fields(found)):
        value = getattr(found, key)
        if key in _FILE_KEYS and value is not None:
            digest = hashlib.sha256(Path(value).read_bytes()).hexdigest()
            said[key] = {"file": Path(value).name, "sha256": digest}
        elif value != getattr(usual, key):
            said[key] = value
    return said
