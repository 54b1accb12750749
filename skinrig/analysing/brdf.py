"""Analyze the number of basis BRDFs that surfaces of faces need (figures 14 and 15)."""

import dataclasses
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from model import store
from model.brdf import tables as brdf_tables
from model.brdf.tables import BrdfBasis
from reconstruction.brdf_basis import space as brdf_space
from reconstruction.brdf_basis.space import SpaceCurve
from skinrig import consent
from skinrig.analysing import brdf_space_figures
from skinrig.analysing.brdf_space_datasets import Dataset
from skinrig.analysing.population_sessions import load_population_sessions
from skinrig.appearances.face_textures import find_valid_texels
from skinrig.arrays import BoolArray, Float64Array
from skinrig.editing import surface_mixtures
from skinrig.editing.surface_mixtures import SurfaceMixtureError
from skinrig.errors import UnusableError
from skinrig.next_steps import shell_quote
from skinrig.traits import labels as trait_labels
from skinrig.unit_format import format_csv

SCHEMA: Final = "skinrig.analyse-brdf/1"
SESSIONS_DATA: Final = "sessions of the light dome"
N_POINTS_PER_FACE: Final = 2_000
MAX_TRAINING_POINTS: Final = 5_000
"""Maximum number of points from which common mixtures are factored."""
MAX_HELD_OUT_POINTS: Final = 5_000
"""Maximum number of held-out points."""
HELD_OUT_FRACTION: Final = 0.3
"""Fraction of the points, or of the people, that is held out."""


class AnalysisError(ValueError):
    """Appearances whose surface cannot be analyzed."""


@dataclass(frozen=True, slots=True, eq=False)
class BrdfRankAnalysis:
    """One curve of fig. 15, and the mean BRDFs of fig. 14."""

    data: Dataset
    curve: SpaceCurve
    held_out: str
    """Held-out units: "points" or "people"."""
    means: Mapping[str, Float64Array]
    """Mean weights of the materials by label, (K,) each."""

    @property
    def above_noise(self) -> int | None:
        """First rank with an error below that of noise alone; None: none, or noise is unknown."""
        below = np.flatnonzero(self.curve.error <= self.data.noise)
        return self.curve.ranks[int(below[0])] if len(below) else None

    def document(self) -> dict[str, Any]:
        """Return the curve and its means as JSON values."""
        found = self.curve
        tops = [rank for rank in (8, 12, 16) if rank in found.ranks]
        return {
            "name": self.data.name,
            "points": found.points,
            "held_out_points": found.held_out_points,
            "held_out": self.held_out,
            "ranks": list(found.ranks),
            "error": found.error.tolist(),
            "normalized": found.normalized().tolist(),
            "held_out_error": _numbers(found.held_out),
            "held_out_stderr": _numbers(found.held_out_stderr),
            "noise": _numbers([self.data.noise])[0],
            "plateau": found.plateau_rank(),
            "plateau_by_share": {
                f"{share:g}": found.plateau_rank(fraction=share)
                for share in brdf_space.PLATEAU_FRACTIONS
            },
            "plateau_by_largest_rank": {
                str(most): found.plateau_rank(max_rank=most) for most in tops
            },
            "rank_at_noise": self.above_noise,
            "points_lost": self.data.lost,
            "left_out": [list(row) for row in found.omitted],
        }


def analyze(
    data: Dataset,
    basis: BrdfBasis,
    *,
    by_label: bool,
    groups: Mapping[str, BoolArray] | None = None,
    ranks: Sequence[int] = brdf_space.CURVE_RANKS,
    method: brdf_space.Method = "shares",
    rng: np.random.Generator,
) -> BrdfRankAnalysis:
    """Compute the error curve and the mean BRDFs of one dataset.

    Parameters
    ----------
    data
        Dataset of points.
    basis
        Basis BRDFs of the materials.
    by_label
        True holds out all points of some labels (people), False some of all points.
    groups
        Labels to average together, by name, (labels,) bool each; None: each label separately.
    ranks, method
        See `reconstruction.brdf_basis.space.compute_error_curve`.
    rng
        Generator that samples the points.

    Raises
    ------
    AnalysisError
        With fewer than two points with weights.
    """
    count = len(data.weights)
    if count < 2:
        raise AnalysisError(
            f"{data.name}: got {count} points with specular reflection, expected 2 or more; "
            "use more points"
        )
    present = np.unique(data.label)
    if by_label and len(present) > 2:
        kept = rng.permutation(present)[: max(1, round(HELD_OUT_FRACTION * len(present)))]
        out = np.isin(data.label, kept)
    else:
        by_label = False
        out = np.zeros(count, np.bool_)
        out[rng.permutation(count)[: round(HELD_OUT_FRACTION * count)]] = True
    trained = rng.permutation(np.flatnonzero(~out))[:MAX_TRAINING_POINTS]
    tried = rng.permutation(np.flatnonzero(out))[:MAX_HELD_OUT_POINTS]
    curve = brdf_space.compute_error_curve(
        data.weights[trained],
        basis,
        ranks=ranks,
        held_out=data.weights[tried],
        groups=data.label[tried] if by_label else None,
        method=method,
        seed=int(rng.integers(2**31)),
    )
    chosen = groups or {
        name: np.arange(len(data.labels)) == k for k, name in enumerate(data.labels)
    }
    means = {}
    for name, members in chosen.items():
        among = members[data.label]
        if among.any():
            means[name] = data.weights[among].mean(axis=0)
    return BrdfRankAnalysis(data, curve, "people" if by_label else "points", means)


def analyze_simulated(
    out: Path,
    *,
    points_each: int = N_POINTS_PER_FACE,
    method: brdf_space.Method = "shares",
    seed: int = 0,
) -> tuple[BrdfRankAnalysis, ...]:
    """Analyze one simulated person, dataset A and dataset B, and write the figures.

    All three come from packaged sessions of the simulated dome, see
    `skinrig.analysing.population_sessions`.

    Parameters
    ----------
    out
        Folder for ``figure-14.png``, ``figure-15.png``, ``curves.csv``, ``analysis.json``.
    points_each
        Maximum number of points per person and condition.
    method
        See `reconstruction.brdf_basis.space.compute_error_curve`.
    seed
        Seed of points and factorizations.
    """
    basis = brdf_tables.default_basis()
    # one generator per dataset, so that a change of one leaves the others' results as they are
    alone_rng, a_rng, b_rng = (np.random.default_rng([seed, 70, k]) for k in range(3))
    sessions = load_population_sessions()
    dataset_a = _sample(sessions.conditions, points_each, a_rng)
    dataset_b = _sample(sessions.people, points_each, b_rng)
    bare = dataset_a.label == dataset_a.labels.index("normal")
    alone = np.zeros(np.count_nonzero(bare), np.int64)
    one = Dataset("one person", dataset_a.weights[bare], alone, ("normal",), np.nan, 0)
    found = (
        _analyze_face(one, basis, sessions.lobes, method=method, rng=alone_rng),
        analyze(dataset_a, basis, by_label=False, method=method, rng=a_rng),
        analyze(dataset_b, basis, by_label=True, method=method, rng=b_rng),
    )
    _write(out, found, basis, spheres=found[1], method=method, source="simulated")
    return found


def _sample(data: Dataset, count: int, rng: np.random.Generator) -> Dataset:
    """Return at most `count` random points of each label."""
    order = rng.permutation(len(data.label))
    at = np.concatenate([order[data.label[order] == k][:count] for k in range(len(data.labels))])
    return dataclasses.replace(data, weights=data.weights[at], label=data.label[at])


def analyze_measured(
    out: Path,
    folders: Sequence[Path],
    *,
    labels: Path | None = None,
    basis: Path | None = None,
    points_each: int = N_POINTS_PER_FACE,
    method: brdf_space.Method = "shares",
    seed: int = 0,
) -> tuple[BrdfRankAnalysis, ...]:
    """Analyze the basis BRDFs of measured faces, and write the figures.

    Parameters
    ----------
    out
        Output folder, see `analyze_simulated`.
    folders
        APPEARANCE/ folders of dome sessions with lobes.
    labels
        Table ``name,TRAIT,...``, see `skinrig.traits.labels.read`: fig. 14 then shows the mean BRDF
        of each trait's faces; None: of each folder.
    basis
        Folder of the MERL files of the fit; None: the built-in materials.
    points_each
        Texels per face.
    method, seed
        See `analyze_simulated`.

    Raises
    ------
    AnalysisError
        If a folder has no lobes, or lobes of other materials.
    skinrig.errors.UnusableError
        If the table does not match the folders.

    Notes
    -----
    The rank of a face's weights is at most that of its reconstruction, so its curve ends there.
    `skinrig reconstruct --rank 24` keeps more.
    """
    names = [folder.name.removeprefix("appearance-") for folder in folders]
    if len(set(names)) < len(names):
        raise UnusableError(
            f"appearances: got {', '.join(names)}, one of them twice; name each folder once"
        )
    table = None if labels is None else trait_labels.read(labels, names)
    materials = brdf_tables.default_basis() if basis is None else brdf_tables.load(basis)
    rng = np.random.default_rng([seed, 71])
    found = [read_weights(folder, materials, points_each, rng) for folder in folders]
    sets = [
        Dataset(name, shares, np.zeros(len(shares), np.int64), (name,), np.nan, lost)
        for name, (shares, lost, _) in zip(names, found, strict=True)
    ]
    lobes = [kept for _, _, kept in found]
    if len(sets) > 1:
        label = np.concatenate([np.full(len(s.weights), k) for k, s in enumerate(sets)])
        every = np.concatenate([s.weights for s in sets])
        lost = sum(s.lost for s in sets)
        sets.append(Dataset("all", every, label, tuple(names), np.nan, lost))
    groups = None if table is None else dict(table.binary)
    how: dict[str, Any] = {"method": method, "rng": rng}
    done = tuple(
        _analyze_face(data, materials, kept, **how) for data, kept in zip(sets, lobes, strict=False)
    )
    for data in sets[len(lobes) :]:
        done += (analyze(data, materials, by_label=True, groups=groups, **how),)
    documents = [store.read_document(folder) for folder in folders]
    source = "measured" if any(one.source == "measured" for one in documents) else "simulated"
    agreed = consent.merge_consent(*documents)
    _write(out, done, materials, spheres=done[-1], method=method, source=source, agreed=agreed)
    return done


def _analyze_face(
    data: Dataset, materials: BrdfBasis, lobes: int, **options: Any
) -> BrdfRankAnalysis:
    """Analyze one face up to the rank of its reconstruction, and record why higher ranks lack."""
    ranks = [rank for rank in brdf_space.CURVE_RANKS if rank <= lobes]
    one = analyze(data, materials, by_label=False, ranks=ranks, **options)
    why = f"the face has {lobes} lobes; `skinrig reconstruct --rank 24` keeps more"
    beyond = tuple((rank, why) for rank in brdf_space.CURVE_RANKS if rank > lobes)
    curve = dataclasses.replace(one.curve, omitted=(*one.curve.omitted, *beyond[:1]))
    return dataclasses.replace(one, curve=curve)


def read_weights(
    folder: Path, materials: BrdfBasis, count: int, rng: np.random.Generator
) -> tuple[Float64Array, int, int]:
    """Return material weights at random texels, the count of invalid ones, and of the lobes.

    Parameters
    ----------
    folder
        APPEARANCE/ folder of a dome session with lobes.
    materials
        Basis BRDFs of the fit, K materials.
    count
        Number of texels.
    rng
        Generator of the texels.

    Returns
    -------
    weights : ndarray of float64, shape (P, K)
    invalid : int
        Texels without specular reflection; P is smaller by these.
    lobes : int

    Raises
    ------
    AnalysisError
        If the folder has no lobes, or lobes of other materials.
    """
    appearance = store.read(folder)
    try:
        lobes = surface_mixtures.read(appearance)
    except SurfaceMixtureError as error:
        want = "--maps r_d,basis_weight_0 --rank 24"
        how = f"skinrig reconstruct SESSION {want} --out {shell_quote(folder)}"
        raise AnalysisError(f"{folder}: holds no lobes ({error}); make them by `{how}`") from error
    if lobes.materials != materials.names:
        raise AnalysisError(
            f"{folder}: its {len(lobes.mix)} lobes are of {len(lobes.materials)} materials "
            f"({lobes.materials[0]}, ...), expected {materials.size} ({materials.names[0]}, ...); "
            "name the files of the fit with --merl-basis DIR"
        )
    known = np.logical_and.reduce([find_valid_texels(one) for one in lobes.maps])
    at = rng.permutation(np.flatnonzero(known))[:count]
    if not len(at):
        raise AnalysisError(
            f"{folder}: got no texel with valid lobes; reconstruct it with more lights"
        )
    mixed = lobes.weights().reshape(-1, len(lobes.mix))[at] @ lobes.mix
    kept_rows = brdf_space.is_constrained(mixed, materials)
    return mixed[kept_rows], int(np.count_nonzero(~kept_rows)), len(lobes.mix)


def _write(
    out: Path,
    found: Sequence[BrdfRankAnalysis],
    basis: BrdfBasis,
    *,
    spheres: BrdfRankAnalysis,
    method: str,
    source: str,
    agreed: Sequence[Mapping[str, Any]] = (),
) -> None:
    out.mkdir(parents=True, exist_ok=True)
    document = {
        "schema": SCHEMA,
        "source": source,
        "data": SESSIONS_DATA,
        consent.CONSENT_KEY: [dict(one) for one in agreed],
        "method": method,
        "rule": "plateau: the first rank whose error exceeds the least one by no more than 5 % of "
        "the fall from the first rank to the least; normalized: errors over that of the first rank",
        "datasets": [one.document() for one in found],
    }
    (out / "analysis.json").write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")
    rows: list[Sequence[object]] = [
        ("dataset", "rank", "error", "normalized", "held_out", "held_out_stderr")
    ]
    for one in found:
        curve = one.curve
        for k, rank in enumerate(curve.ranks):
            values = (curve.error, curve.normalized(), curve.held_out, curve.held_out_stderr)
            rows.append((one.data.name, rank, *(f"{v[k]:.6g}" for v in values)))
    (out / "curves.csv").write_text(format_csv(rows), encoding="utf-8")
    curves = {one.data.name: one.curve for one in found}
    (out / "figure-15.png").write_bytes(brdf_space_figures.curves(curves))
    (out / "figure-14.png").write_bytes(brdf_space_figures.draw_spheres(spheres.means, basis))


def _numbers(values: Sequence[float] | Float64Array) -> list[float | None]:
    return [float(v) if np.isfinite(v) else None for v in values]
