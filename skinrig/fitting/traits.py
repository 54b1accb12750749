"""Fit trait spaces to labeled appearances: `skinrig fit traits`."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from model.texture_statistics.space import TextureSpace
from model.traits import TraitSpace
from model.traits.storage import TraitLibrary
from model.traits.vectors import Contrast
from reconstruction import brdf_basis
from reconstruction.correspondence import common_regions
from reconstruction.correspondence.common_parameterization import CommonFrame
from skinrig import consent
from skinrig.appearances import face_textures
from skinrig.appearances.contents import hash_document, hash_file
from skinrig.appearances.face_textures import Face
from skinrig.atomic_file import write_atomically
from skinrig.editing import surface_mixtures
from skinrig.editing.surface_mixtures import SurfaceMixtureError
from skinrig.errors import UsageError
from skinrig.traits import albedo_vectors, regions
from skinrig.traits import labels as trait_labels
from skinrig.traits.albedo_vectors import AlbedoSample, VectorKind
from skinrig.traits.labels import TraitLabels

MAX_SURFACE_RANK: Final = 8
"""Maximum number of basis BRDFs of a population (Weyrich et al. 2005, figure 15)."""
MIN_REGION_PIXELS: Final = 200
"""Minimum number of valid pixels of a region in the common map."""


class TraitFitError(ValueError):
    """Appearances from which no trait can be learned."""


@dataclass(frozen=True, slots=True, eq=False)
class TraitFit:
    """Fitted trait spaces with their faces and warnings.

    Attributes
    ----------
    library
        Trait spaces by part.
    faces, ignored
        Names of the faces, and labels without a face.
    rows
        Part, trait, faces with and without it, p value, expected cosine; one row per trait and
        part.
    warnings
        One sentence each.
    left_out
        Omitted parts with reasons.
    """

    library: TraitLibrary
    faces: tuple[str, ...]
    ignored: tuple[str, ...]
    rows: tuple[tuple[str, str, int, int, float, float], ...]
    warnings: tuple[str, ...]
    left_out: tuple[tuple[str, str], ...]


def fit_traits(
    appearances: Sequence[Path],
    labels: Path,
    *,
    out: Path,
    landmarks: Path | None = None,
    vectors: VectorKind = "quantiles",
    contrast: Contrast = "means",
    size: int | None = None,
    basis: Path | None = None,
    seed: int = 0,
    progress: Callable[[str], None] | None = None,
) -> TraitFit:
    """Learn traits from labeled faces and write them to `out`.

    Parameters
    ----------
    appearances
        APPEARANCE/ folders of dome sessions.
    labels
        Table of labels, see `trait_labels.read`.
    out
        File to write; an existing file is replaced atomically.
    landmarks
        Folder with a table ``NAME.csv`` per face; None: those of simulations.
    vectors
        Albedo feature vector, see `albedo_vectors`.
    contrast
        "means": difference of the means with and without a trait; "regression" on all traits.
    size
        Width and height of the common map, pixels; None: those of the coarsest texture.
    basis
        Folder of MERL and RGL files that the lobes were fitted with.
    seed
        Random seed of the permutation tests.
    progress
        Called with one line per step.

    Raises
    ------
    TraitFitError, FaceError, UnusableError, TraitError, ParameterizationError
        If an input is missing or inconsistent; the message names it.
    """
    report = progress or (lambda text: None)
    faces = read_faces(appearances, landmarks)
    table = trait_labels.read(labels, [face.name for face in faces])
    frame = face_textures.build_common_frame(faces, size)
    report(
        f"common map: {frame.size} pixels of {frame.pixel_mm:.2f} mm, {len(frame.names)} landmarks"
    )
    samples = []
    for face in faces:
        samples.append(sample_albedo(face, frame))
        report(f"{face.name}: {100 * samples[-1].valid.mean():.0f} % of the common map")
    left_out: list[tuple[str, str]] = []
    spaces = fit_albedo_spaces(
        samples, table, frame, vectors, contrast=contrast, seed=seed, left_out=left_out
    )
    texture = spaces.pop("texture")
    surface = _surface(faces, table, basis, contrast, seed, left_out)
    if surface is not None:
        spaces[regions.SURFACE_SPACE] = surface
    library = TraitLibrary(
        spaces,
        "measured" if all(f.appearance.source == "measured" for f in faces) else "simulated",
        regions.library_parameters(
            frame,
            vectors,
            contrast=contrast,
            seed=seed,
            faces=[face.name for face in faces],
            labels={
                n: v.astype(float).tolist() for n, v in {**table.binary, **table.continuous}.items()
            },
            landmarks=sorted({face.landmark_source for face in faces}),
            inputs={"labels": hash_file(labels)} | {f.name: hash_document(f.path) for f in faces},
            left_out=[list(row) for row in left_out],
            consent=consent.merge_consent(*(face.appearance for face in faces)),
        ),
        {regions.TEXTURE_SPACE_FILE: regions.texture_bytes(texture)},
    )
    if out.is_dir():
        raise TraitFitError(
            f"--out: {out} is a folder, expected a file such as traits.npz; name a file"
        )
    write_atomically(out, library.to_bytes())
    rows, warnings = summarize_traits(library)
    return TraitFit(
        library, tuple(f.name for f in faces), table.ignored, rows, warnings, tuple(left_out)
    )


def sample_albedo(face: Face, frame: CommonFrame) -> AlbedoSample:
    """Resample a face's albedo to the common map."""
    r_d = face.r_d
    image, valid = face.chart(frame).gather(r_d.values, face_textures.find_valid_texels(r_d))
    return AlbedoSample(image, valid)


def fit_albedo_spaces(
    samples: Sequence[AlbedoSample],
    labels: TraitLabels,
    frame: CommonFrame,
    vectors: VectorKind,
    *,
    contrast: Contrast = "means",
    seed: int = 0,
    left_out: list[tuple[str, str]],
) -> dict[str, Any]:
    """Learn the traits of albedo maps, region by region.

    Returns
    -------
    dict
        A `TraitSpace` by name, and "texture": the `TextureSpace` that all of them share.
    """
    encoded = [albedo_vectors.encode_albedo(one.r_d, vectors) for one in samples]
    texture = TextureSpace.fit(encoded, valid=[one.valid for one in samples])
    found: dict[str, Any] = {"texture": texture}
    for region in ("face", "beard", "no-beard"):
        inside = common_regions.region_mask(region, frame)
        fewest = min(int((inside & one.valid).sum()) for one in samples)
        if fewest < MIN_REGION_PIXELS:
            left_out.append((f"albedo of {region}", f"a face has only {fewest} valid pixels of it"))
            continue
        rows = [
            albedo_vectors.vector(
                one.r_d, texture, vectors, valid=one.valid, region=inside & one.valid
            )
            for one in samples
        ]
        found[regions.space_name(region)] = albedo_vectors.fit_albedo_traits(
            rows, labels.binary, labels.continuous, texture, vectors, contrast=contrast, seed=seed
        ).traits
    if len(found) == 1:
        raise TraitFitError(
            "r_d: no region of the face is valid in all appearances; omit incomplete faces"
        )
    return found


def summarize_traits(
    library: TraitLibrary,
) -> tuple[tuple[tuple[str, str, int, int, float, float], ...], tuple[str, ...]]:
    """Return a row per trait and part, and all warnings without duplicates."""
    rows = tuple(
        (
            part,
            name,
            trait.members,
            trait.others,
            trait.confidence.p_value,
            trait.confidence.expected_cosine,
        )
        for part, space in library.spaces.items()
        for name, trait in space.traits.items()
    )
    warnings = [f"{part}: {w}" for part, space in library.spaces.items() for w in space.warnings]
    return rows, tuple(dict.fromkeys(warnings))


def read_faces(appearances: Sequence[Path], landmarks: Path | None) -> list[Face]:
    """Read appearances with their landmarks.

    Raises
    ------
    skinrig.errors.UsageError
        If fewer than two appearances are given.
    TraitFitError
        If names are equal, or faces lack landmarks.
    """
    if len(appearances) < 2:
        raise UsageError(f"appearances: got {len(appearances)}, expected two or more faces")
    if landmarks is not None and not landmarks.is_dir():
        raise TraitFitError(
            f"--landmarks: got {landmarks}, expected a folder with NAME.csv per face"
        )
    faces: list[Face] = []
    for path in appearances:
        name = path.resolve().name.removeprefix("appearance-")
        table = None if landmarks is None else landmarks / f"{name}.csv"
        if table is not None and not table.is_file():
            raise TraitFitError(f"--landmarks: {table} is missing; add it")
        faces.append(face_textures.read(path, table))
    names = [face.name for face in faces]
    if len(set(names)) < len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise TraitFitError(
            f"appearances: got two named {twice!r}, expected different names; rename one"
        )
    _require_landmarks(faces)
    return faces


def _require_landmarks(faces: Sequence[Face]) -> None:
    bare = [face.name for face in faces if not face.landmarks]
    if bare:
        raise TraitFitError(
            f"landmarks: {', '.join(bare[:5])}{', ...' if len(bare) > 5 else ''} have none; mark "
            f"about 20 points of each face in a table name,x,y (texels of its maps) or name,x,y,z "
            f"(mm of its mesh), called {bare[0]}.csv, and name their folder: --landmarks DIR. "
            f"Usual points: {', '.join(list(common_regions.STANDARD_LANDMARKS_MM)[:6])}, ..."
        )


def _surface(
    faces: Sequence[Face],
    labels: TraitLabels,
    folder: Path | None,
    contrast: Contrast,
    seed: int,
    left_out: list[tuple[str, str]],
) -> TraitSpace | None:
    """Learn the traits of mean mixtures; append the reason to `left_out` if it is not possible."""
    try:
        found = [surface_mixtures.read(face.appearance) for face in faces]
    except SurfaceMixtureError as error:
        left_out.append(("surface", str(error)))
        return None
    first = found[0]
    for face, one in zip(faces, found, strict=True):
        if (one.materials, one.light_radius_rad) != (first.materials, first.light_radius_rad):
            left_out.append(
                ("surface", f"{face.name}: its basis BRDFs are mixtures of other materials")
            )
            return None
    tables = surface_mixtures.load_materials(first.materials, first.light_radius_rad, folder)
    strength = tables.strength()
    means = np.array([one.mean(strength) for one in found])
    products = tables.cosine_similarity() * np.outer(strength, strength)
    rank = min(MAX_SURFACE_RANK, len(means) - 1)
    # as in the paper, traits are directions in the space of a few non-negative basis BRDFs of the
    # population; the mean mixtures of faces are factorized for it
    mix = brdf_basis.reduce(means, rank, basis=tables, seed=seed)[1]
    return TraitSpace.fit(
        means,
        labels.binary,
        continuous=labels.continuous,
        space="nmf",
        basis=mix,
        metric=products,
        contrast=contrast,
        names=first.materials,
        seed=seed,
    )
