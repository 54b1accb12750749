"""Describe a study in a TOML file: groups of cases over subjects, seeds, sizes, ages and ISO.

::

    schema = "skinrig.study/1"
    title = "Accuracy by skin type"

    [[groups]]
    rig = "flash"
    subjects = ["I", "II", "III", "IV", "V", "VI", "ita:-40..50/4"]
    seeds = "1000..1299"
    sizes = [{width_px = 96}, {width_px = 384}]
    calibration_age_days = [0, 30]

Seeds go round the subjects: subject k mod n gets seed k. With ``every_seed = true`` each subject
gets each seed. ``P01..P87`` names members of the population, ``ita:LOW..HIGH/N`` N individual
typology angles from LOW to HIGH, degrees.
"""

import dataclasses
import functools
import hashlib
import itertools
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from capture.calibration.record import DEFAULT_VALIDITY_DAYS
from capture.documents import (
    Document,
    FaultCollector,
    InputError,
    canonical_json,
    parse_document,
    read_toml,
)
from capture.plan.rig_kinds import RIG_KINDS
from reconstruction.pipeline.library_versions import list_library_versions
from rigsim.population import files as subject_file
from rigsim.population.subject_melanin import subject_melanin
from rigsim.subject import pigment
from skinrig.errors import UnusableError
from skinrig.kernel_cache import PACKAGES_FOLDER
from skinrig.simulating.orders import order_for

SCHEMA: Final = "skinrig.study/1"
HASHED_PACKAGES: Final = ("capture", "model", "reconstruction", "rigsim", "skinrig")
MEDIUM_TYPE: Final = "medium"
"""Skin type of a homogeneous or anisotropic medium."""
MAX_CASES: Final = 100_000
MAX_AGE_DAYS: Final = DEFAULT_VALIDITY_DAYS - 1
"""Oldest calibration: it is valid until the end of a simulation that passes midnight."""
ISO_RANGE: Final = (0.25, 64.0)
"""Range of ISO over the nominal one."""
DEFAULT_WIDTHS_PX: Final = {"flash": 384, "dome": 320, "gradient": 128}
_SEEDS = re.compile(r"(\d{1,9})(?:\.\.(\d{1,9}))?")
_MEMBERS = re.compile(r"P(\d{2})\.\.P(\d{2})")
_MEMBER = re.compile(r"P\d+")
_ANGLES = re.compile(r"ita:(-?\d+(?:\.\d+)?)\.\.(-?\d+(?:\.\d+)?)/([1-9]\d{0,4})")


class StudyError(InputError):
    """A study that is malformed, or that cannot run in its folder."""


@dataclass(frozen=True, slots=True, kw_only=True)
class CaseSize(Document):
    """Size of the captures of a case; None: the default."""

    width_px: int | None = None
    """Width of each image, pixels."""
    lights: int | None = None
    """Lights of the dome."""
    views: int | None = None
    """Cameras of the dome."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Case:
    """One simulated person, or medium, before one rig."""

    rig: str
    subject: str
    skin: str
    """Preset of the nearest melanin, or `MEDIUM_TYPE`."""
    seed: int
    """Seed of the subject, the rig as built, its calibration and all noise."""
    size: CaseSize
    calibration_age_days: int
    """Days between calibration and capture."""
    iso_factor: float
    """ISO of the cameras over the nominal one, of calibration and capture."""
    site: str
    """Site of the skin before the gradient sphere; empty for other rigs."""
    leave_out: tuple[str, ...]
    """Effects that the simulation omits."""

    @property
    def setup(self) -> str:
        """Text of size, site and omitted effects, which are part of a quantity's name."""
        size = self.size
        parts = [
            f"{size.width_px} px" if size.width_px else "",
            f"{size.lights} lights" if size.lights else "",
            f"{size.views} cameras" if size.views else "",
            self.site,
            *(f"without {name}" for name in self.leave_out),
        ]
        return ", ".join(filter(None, parts))

    @property
    def name(self) -> str:
        """Text of all that distinguishes the case from others, for progress and messages."""
        parts = [
            f"{self.rig} {self.subject} {self.seed}",
            self.setup,
            f"calibrated {self.calibration_age_days} days ago" if self.calibration_age_days else "",
            f"ISO x {self.iso_factor:g}" if self.iso_factor != 1.0 else "",
        ]
        return ", ".join(filter(None, parts))

    def key(self, software: str) -> str:
        """Return the hash of all that the case's result depends on.

        Parameters
        ----------
        software
            See `software_hash`.
        """
        described = dataclasses.asdict(self)
        if subject_file.is_subject_file(self.subject):  # its folder changes no result
            described["subject"] = Path(self.subject).name
        content = canonical_json([described, _hash_subject_files(self.subject), software])
        return hashlib.sha256(content).hexdigest()[:20]


@dataclass(frozen=True, slots=True, kw_only=True)
class CaseGroup(Document):
    """Cases of one rig: subjects, seeds, sizes, ages of the calibration and ISO."""

    rig: str
    subjects: tuple[str, ...]
    """Presets, tones, members, files, media, or the ranges of the module's text."""
    seeds: str
    """FIRST..LAST, or one number."""
    every_seed: bool = False
    """True: each subject with each seed; False: seeds go round the subjects."""
    sizes: tuple[CaseSize, ...] = (CaseSize(),)
    calibration_age_days: tuple[int, ...] = (0,)
    iso_factors: tuple[float, ...] = (1.0,)
    """ISO of the cameras over the nominal one; levels of images stay, noise grows."""
    site: str = ""
    """Site of the skin (gradient); empty: forehead."""
    leave_out: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        """Check names and ranges; the subjects are read by `list_cases`."""
        checks = FaultCollector("the group of cases", StudyError)
        rigs = ", ".join(RIG_KINDS)
        checks.check("rig", self.rig, self.rig in RIG_KINDS, f"one of {rigs}")
        for name in ("subjects", "sizes", "calibration_age_days", "iso_factors"):
            checks.check(name, "none", bool(getattr(self, name)), "at least one")
        ages = self.calibration_age_days
        young = all(0 <= age <= MAX_AGE_DAYS for age in ages)
        wanted = f"0 to {MAX_AGE_DAYS} days: calibrations expire"
        checks.check("calibration_age_days", ages, young, wanted)
        low, high = ISO_RANGE
        usual = all(low <= factor <= high for factor in self.iso_factors)
        checks.check("iso_factors", self.iso_factors, usual, f"{low:g} to {high:g}")
        for text in self.subjects:
            some = next(expand_subjects(text), None) is not None
            checks.check("subjects", text, some, 'range "FIRST..LAST" with FIRST <= LAST')
        found = _SEEDS.fullmatch(self.seeds)
        ordered = found is not None and int(found[1]) <= int(found[2] or found[1])
        checks.check("seeds", self.seeds, ordered, 'text "FIRST..LAST" with FIRST <= LAST')
        known = ("", "forehead", "cheek", "chin") if self.rig == "gradient" else ("",)
        checks.check("site", self.site, self.site in known, "a site, for the gradient rig only")
        checks.close()

    def list_seeds(self) -> range:
        """Return the seeds."""
        found = _SEEDS.fullmatch(self.seeds)
        first, last = (found[1], found[2] or found[1]) if found else ("0", "-1")
        return range(int(first), int(last) + 1)

    def list_subjects(self) -> list[str]:
        """Return the subjects; files by absolute path, as the folders of workers differ."""
        subjects = (one for text in self.subjects for one in expand_subjects(text))
        return [
            str(Path(one).absolute()) if subject_file.is_subject_file(one) else one
            for one in subjects
        ]

    def iterate_cases(self) -> Iterator[Case]:
        """Yield the cases, seed by seed."""
        subjects = self.list_subjects()
        seeds = self.list_seeds()
        pairs = (
            itertools.product(subjects, seeds)
            if self.every_seed
            else ((subjects[k % len(subjects)], seed) for k, seed in enumerate(seeds))
        )
        width_px = DEFAULT_WIDTHS_PX.get(self.rig)
        for (subject, seed), size, age, factor in itertools.product(
            pairs, self.sizes, self.calibration_age_days, self.iso_factors
        ):
            given = size if size.width_px else dataclasses.replace(size, width_px=width_px)
            yield Case(
                rig=self.rig,
                subject=subject,
                skin=skin_type(subject, seed=seed),
                seed=seed,
                size=given,
                calibration_age_days=age,
                iso_factor=factor,
                site=self.site or ("forehead" if self.rig == "gradient" else ""),
                leave_out=self.leave_out,
            )


@dataclass(frozen=True, slots=True, kw_only=True)
class StudyFile(Document):
    """Groups of cases with a title."""

    schema: str
    title: str
    groups: tuple[CaseGroup, ...]

    def __post_init__(self) -> None:
        """Check the schema, and that there are cases."""
        checks = FaultCollector("the study", StudyError)
        checks.check("schema", self.schema, self.schema == SCHEMA, repr(SCHEMA))
        checks.check("groups", "none", bool(self.groups), "at least one [[groups]]")
        checks.close()

    def list_cases(self, *, where: str = "") -> list[Case]:
        """Return the cases in the file's order, each once.

        Parameters
        ----------
        where
            Name of the file, for messages.

        Raises
        ------
        StudyError
            For a subject, a size or an effect that a rig does not take, or too many cases.
        """
        count = sum(
            len(g.sizes)
            * len(g.calibration_age_days)
            * len(g.iso_factors)
            * len(g.list_seeds())
            * (sum(sum(1 for _ in expand_subjects(s)) for s in g.subjects) if g.every_seed else 1)
            for g in self.groups
        )
        if count > MAX_CASES:
            raise StudyError.at(
                "has too many cases",
                "groups",
                f"{count} cases",
                f"at most {MAX_CASES}",
                where=where,
                advice="Divide it into several studies.",
            )
        cases: dict[Case, None] = {}
        for number, group in enumerate(self.groups):
            try:
                for size in group.sizes:
                    _check_order(group, size)
                for subject in group.list_subjects():
                    _check_subject(group.rig, subject)
                cases |= dict.fromkeys(group.iterate_cases())
            except ValueError as error:
                if isinstance(error, StudyError):
                    raise
                raise StudyError(
                    f"groups[{number}], rig {group.rig}: {error}",
                    where=where,
                    advice="Correct this group.",
                ) from error
        return list(cases)


def _check_order(group: CaseGroup, size: CaseSize) -> None:
    """Raise if a rig's simulation refuses the options of a group."""
    options = {key: value for key, value in dataclasses.asdict(size).items() if value is not None}
    order_for(group.rig, out=Path("session"), leave_out=group.leave_out, **options)


def _check_subject(rig: str, subject: str) -> None:
    """Raise if a rig's simulation does not take a subject."""
    if rig == "probe":
        subject_file.load_tissue(subject, seed=0)
    elif rig == "dome" and _MEMBER.fullmatch(subject):
        subject_melanin(subject, seed=0)
    else:
        subject_file.load_subject(subject)


def read_study(path: Path) -> StudyFile:
    """Read a study's file.

    Raises
    ------
    StudyError
        It cannot be read, or is not valid; every fault is listed.
    """
    document = read_toml(path, error=StudyError)
    return parse_document(
        StudyFile, document, where=str(path), error=StudyError, advice="Correct these keys."
    )


def expand_subjects(text: str) -> Iterator[str]:
    """Yield the subjects of a text: one, or those of a range.

    Examples
    --------
    >>> [*expand_subjects("P07..P09"), *expand_subjects("ita:-30..30/3"), *expand_subjects("IV")]
    ['P07', 'P08', 'P09', 'ita:-30', 'ita:0', 'ita:30', 'IV']
    """
    if (found := _MEMBERS.fullmatch(text)) is not None:
        yield from (f"P{k:02d}" for k in range(int(found[1]), int(found[2]) + 1))
    elif (found := _ANGLES.fullmatch(text)) is not None:
        angles = np.linspace(float(found[1]), float(found[2]), int(found[3]))
        yield from (f"ita:{angle:.4g}" for angle in angles.tolist())
    else:
        yield text


def skin_type(subject: str, *, seed: int) -> str:
    """Return the preset of the melanin nearest to a subject's; `MEDIUM_TYPE` for a medium.

    Examples
    --------
    >>> skin_type("VI", seed=0), skin_type("homogeneous:0.1,1", seed=0)
    ('VI', 'medium')
    """
    if subject.startswith(("homogeneous:", "anisotropic:")):
        subject_file.load_tissue(subject, seed=seed)
        return MEDIUM_TYPE
    return pigment.nearest_preset(subject_melanin(subject, seed=seed))


def _hash_subject_files(subject: str) -> str:
    """Return the hash of a subject's file and of the files that it names; empty for a name."""
    if not subject_file.is_subject_file(subject):
        return ""
    described = subject_file.read_subject_file(subject)
    named = (described.mesh, described.melanin_map, described.hemoglobin_map)
    return _hash_files([Path(subject), *(Path(name) for name in named if name)])


def _hash_files(paths: list[Path]) -> str:
    found = hashlib.sha256()
    for path in paths:
        found.update(hashlib.sha256(path.read_bytes()).digest())
    return found.hexdigest()


@functools.cache
def software_hash() -> str:
    """Return the hash of skinrig's sources and data and of its libraries' versions.

    A result of other software is never taken for one of this.
    """
    paths: list[Path] = []
    for package in HASHED_PACKAGES:
        files = (PACKAGES_FOLDER / package).rglob("*")
        paths += sorted(p for p in files if p.is_file() and "__pycache__" not in p.parts)
    content = canonical_json([_hash_files(paths), list_library_versions()])
    return hashlib.sha256(content).hexdigest()[:20]


def require_software(expected: str) -> None:
    """Raise if this process has other software than the command that ordered its task.

    Parameters
    ----------
    expected
        `software_hash` of the command.

    Raises
    ------
    UnusableError
        If the hash here differs.
    """
    if software_hash() != expected:
        raise UnusableError(
            "worker: got another installation of skinrig than that of the command, "
            "expected the same on every machine; install it there"
        )
