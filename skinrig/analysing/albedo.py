"""Analyze the albedo of faces: color histograms of groups (fig. 16), and principal components."""

import dataclasses
import json
import os
import shutil
import uuid
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from model.texture_statistics import histograms as texture_histograms
from model.texture_statistics.histograms import GroupHistograms
from model.texture_statistics.space import TextureSpace
from reconstruction.correspondence import common_regions
from reconstruction.correspondence.common_parameterization import CommonFrame
from rigsim.population.population import get_member
from skinrig import consent
from skinrig.analysing.brdf_space_figures import encode_figure, new_figure
from skinrig.analysing.population_sessions import load_population_sessions
from skinrig.appearances import face_textures
from skinrig.arrays import BoolArray, Float64Array
from skinrig.fitting import traits
from skinrig.fitting.traits import TraitFitError
from skinrig.traits import albedo_vectors
from skinrig.traits import labels as trait_labels
from skinrig.traits.albedo_vectors import AlbedoSample
from skinrig.traits.truth import label_members
from skinrig.unit_format import format_csv

HISTOGRAM_BINS: Final = 128
ALL_GROUPS: Final = "all"
VECTOR_KIND: Final = "quantiles"
"""Kind of the vectors that are decomposed, see `albedo_vectors`."""
CHANNEL_NAMES: Final = ("red", "green", "blue")
OUTPUT_FILES: Final = ("figure-16.png", "histograms.csv", "components.csv", "analysis.json")


@dataclass(frozen=True, slots=True, eq=False)
class AlbedoAnalysis:
    """Albedo histograms by group and region, and principal components of the albedo vectors.

    Attributes
    ----------
    histograms
        Histograms of R_d by region.
    explained
        Fraction of the vectors' variance in each component by region, descending.
    scores
        Scores of the faces on the first components by region, (n, k), in standard deviations.
    names
        Names of the faces.
    left_out
        Omitted analyses, each with the reason.
    source
        "measured" if any face is measured, otherwise "simulated".
    consent
        Consent of the subjects of measured faces, see `skinrig.consent.merge_consent`.
    """

    histograms: Mapping[str, GroupHistograms]
    explained: Mapping[str, Float64Array]
    scores: Mapping[str, Float64Array]
    names: tuple[str, ...]
    left_out: tuple[tuple[str, str], ...]
    source: str = "simulated"
    consent: tuple[Mapping[str, Any], ...] = ()

    def document(self) -> dict[str, Any]:
        """Return the analysis without its histograms as JSON values."""
        return {
            "source": self.source,
            "consent": [dict(one) for one in self.consent],
            "faces": list(self.names),
            "groups": {
                name: int(n)
                for one in list(self.histograms.values())[:1]
                for name, n in zip(one.names, one.members, strict=True)
            },
            "mean_r_d": {
                region: {
                    group: (one.mean[k] @ (0.5 * (one.edges[1:] + one.edges[:-1]))).tolist()
                    for k, group in enumerate(one.names)
                }
                for region, one in self.histograms.items()
            },
            "explained": {region: share.tolist() for region, share in self.explained.items()},
            "components_for_90_percent": {
                region: int(np.searchsorted(np.cumsum(share), 0.9) + 1)
                for region, share in self.explained.items()
            },
            "left_out": [list(row) for row in self.left_out],
        }


def analyze_measured(
    out: Path,
    appearances: Sequence[Path],
    *,
    labels: Path | None = None,
    landmarks: Path | None = None,
    size: int | None = None,
    progress: Callable[[str], None] | None = None,
) -> AlbedoAnalysis:
    """Analyze the albedo maps of fitted faces in a common map, aligned by landmarks.

    Parameters
    ----------
    out
        Folder for `OUTPUT_FILES`.
    appearances
        APPEARANCE/ folders of dome sessions.
    labels
        Table, see `skinrig.traits.labels.read`; each binary column gives two groups.
    landmarks, size
        See `fitting_traits.fit_traits`.
    progress
        Called with one line per step.

    Raises
    ------
    TraitFitError, FaceError, UnusableError, ParameterizationError
        For missing or mismatched inputs.
    """
    report = progress or (lambda text: None)
    faces = traits.read_faces(appearances, landmarks)
    frame = face_textures.build_common_frame(faces, size)
    names = tuple(face.name for face in faces)
    groups = {ALL_GROUPS: np.ones(len(names), np.bool_)}
    if labels is not None:
        table = trait_labels.read(labels, names)
        groups |= add_complement_groups(table.binary)
    samples = []
    for face in faces:
        report(face.name)
        samples.append(traits.sample_albedo(face, frame))
    seen = [face.appearance for face in faces]
    found = dataclasses.replace(
        analyze(samples, names, groups, frame),
        source="measured" if any(one.source == "measured" for one in seen) else "simulated",
        consent=tuple(consent.merge_consent(*seen)),
    )
    return _write(out, found)


def analyze_simulated(out: Path, *, people: int | None = None, seed: int = 0) -> AlbedoAnalysis:
    """Analyze members of the simulated population, each from a session of the simulated dome.

    Their maps are packaged, see `skinrig.analysing.population_sessions`.

    Parameters
    ----------
    out
        Folder for `OUTPUT_FILES`.
    people
        Number of people, at least 2, sampled at random from the captured; None: all.
    seed
        Seed of the sample.
    """
    sessions = load_population_sessions()
    count = len(sessions.captured) if people is None else people
    if not 2 <= count <= len(sessions.captured):
        raise TraitFitError(f"people: got {count}, expected 2 to {len(sessions.captured)}")
    chosen = sorted(np.random.default_rng([seed, 1]).permutation(len(sessions.captured))[:count])
    some = [get_member(sessions.captured[k]) for k in chosen]
    known = sorted({label for person in some for label in person.labels})
    binary = {
        name: flags
        for name, flags in label_members(some, known).items()
        if 0 < flags.sum() < len(some)
    }
    groups = {ALL_GROUPS: np.ones(len(some), np.bool_)} | binary
    names = tuple(person.name for person in some)
    return _write(out, analyze([sessions.r_d[k] for k in chosen], names, groups, sessions.frame))


def add_complement_groups(binary: Mapping[str, BoolArray]) -> dict[str, BoolArray]:
    """Return the nonempty groups, and for each trait also the group without it."""
    out = {}
    for name, flags in binary.items():
        for group, members in ((name, flags), (f"no {name}", ~flags)):
            if members.any():
                out[group] = members
    return out


def analyze(
    samples: Sequence[AlbedoSample],
    names: tuple[str, ...],
    groups: Mapping[str, BoolArray],
    frame: CommonFrame,
) -> AlbedoAnalysis:
    """Analyze albedo maps in one common map."""
    images = [one.r_d for one in samples]
    texture = TextureSpace.fit(
        [albedo_vectors.encode_albedo(image, VECTOR_KIND) for image in images],
        valid=[one.valid for one in samples],
    )
    histograms, explained, scores = {}, {}, {}
    left_out: list[tuple[str, str]] = []
    for region in ("face", "beard", "no-beard"):
        inside = common_regions.region_mask(region, frame)
        masks = [inside & one.valid for one in samples]
        fewest = min(int(mask.sum()) for mask in masks)
        if fewest < traits.MIN_REGION_PIXELS:
            left_out.append((region, f"one face has only {fewest} pixels of it"))
            continue
        most = max(np.quantile(i[m], 0.999) for i, m in zip(images, masks, strict=True))
        reach = (0.0, float(np.ceil(10 * most) / 10))
        histograms[region] = texture_histograms.rgb_histograms(
            images, groups, valid=masks, reach=reach, bins=HISTOGRAM_BINS
        )
        rows = np.array(
            [
                albedo_vectors.vector(one.r_d, texture, VECTOR_KIND, valid=one.valid, region=mask)
                for one, mask in zip(samples, masks, strict=True)
            ]
        )
        left, size, _ = np.linalg.svd(rows - rows.mean(axis=0), full_matrices=False)
        total = float((size**2).sum())
        if total == 0.0:
            left_out.append((f"components of {region}", "all faces are the same"))
            continue
        explained[region] = (size**2 / total)[: len(rows) - 1]
        scores[region] = (left * np.sqrt(len(rows) - 1))[:, : min(5, len(rows) - 1)]
    return AlbedoAnalysis(histograms, explained, scores, names, tuple(left_out))


def _write(out: Path, found: AlbedoAnalysis) -> AlbedoAnalysis:
    """Write the files into a folder, all or none; other files in it are kept."""
    document = {"schema": "skinrig.analyse-albedo/1", **found.document()}
    contents = (
        _figure(found),
        format_csv(_histogram_rows(found)).encode(),
        format_csv(_component_rows(found)).encode(),
        (json.dumps(document, indent=1) + "\n").encode(),
    )
    part = out.with_name(f".{out.name}.{uuid.uuid4().hex}.part")
    part.mkdir(parents=True)
    try:
        for name, content in zip(OUTPUT_FILES, contents, strict=True):
            (part / name).write_bytes(content)
        out.mkdir(parents=True, exist_ok=True)
        for name in OUTPUT_FILES:
            os.replace(part / name, out / name)
    finally:
        shutil.rmtree(part, ignore_errors=True)
    return found


def _histogram_rows(found: AlbedoAnalysis) -> Iterator[Sequence[object]]:
    yield "region", "group", "members", "channel", "r_d_low", "r_d_high", "share", "stderr"
    for region, one in found.histograms.items():
        for g, group in enumerate(one.names):
            for c, channel in enumerate(CHANNEL_NAMES):
                rows = zip(one.edges, one.edges[1:], one.mean[g, c], one.stderr[g, c], strict=False)
                for low, high, share, error in rows:
                    numbers = (f"{low:.6g}", f"{high:.6g}", f"{share:.6g}")
                    error_text = f"{error:.3g}" if np.isfinite(error) else ""
                    yield region, group, int(one.members[g]), channel, *numbers, error_text


def _component_rows(found: AlbedoAnalysis) -> Iterator[Sequence[object]]:
    yield "region", "face", *(f"component_{k}" for k in range(5))
    for region, places in found.scores.items():
        for name, place in zip(found.names, places, strict=True):
            yield region, name, *(f"{x:.5g}" for x in place)


def _figure(found: AlbedoAnalysis) -> bytes:
    """Plot the histograms of the whole face, one panel per group."""
    region, one = next(iter(found.histograms.items()))
    columns = min(4, len(one.names))
    lines = -(-len(one.names) // columns)
    figure, panels = new_figure(2.9 * columns, 2.1 * lines + 0.3, lines, columns)
    middle = 0.5 * (one.edges[1:] + one.edges[:-1])
    top = float(one.mean.max()) * 1.05
    for g, axes in enumerate(panels.flat):
        if g >= len(one.names):
            axes.remove()
            continue
        for c, color in enumerate(("tab:red", "tab:green", "tab:blue")):
            mean, error = one.mean[g, c], np.nan_to_num(one.stderr[g, c])
            axes.plot(middle, mean, color=color, lw=1.0)
            axes.fill_between(middle, mean - error, mean + error, color=color, alpha=0.25, lw=0)
        axes.set_ylim(0, top)
        axes.set_xlim(one.edges[0], one.edges[-1])
        axes.set_title(f"{one.names[g]} ({one.members[g]})", fontsize=9)
        axes.tick_params(labelsize=7)
    figure.suptitle(f"R_d, camera RGB, {region}: mean histograms with standard errors", fontsize=9)
    return encode_figure(figure, dpi=110)
