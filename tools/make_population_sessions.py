"""Make skinrig/data/population_sessions.npz: simulated dome sessions of the population.

    python tools/make_population_sessions.py WORK [--people N] [--table]

One member under each of seven conditions, then members of the simulated population pass through the
simulator of the light dome with sensor noise, through its calibration and through the
reconstruction. One calibration serves all. WORK keeps the estimates of each session, so that an
interrupted run continues; ``--people 0`` only collects them. People are captured in a random order:
those of an unfinished run are a random sample. A session takes 23 to 37 s of processor time.
``--table`` prints the tables of the validation pages from the stored file and runs nothing.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import sys
import time
from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np

from model.brdf import tables as brdf_tables
from model.traits.storage import load_packaged_traits
from reconstruction.correspondence.common_parameterization import CommonFrame
from rigsim.population.conditions import CONDITION_NAMES
from rigsim.population.population import draw_population, get_member
from skinrig.analysing.brdf import read_weights
from skinrig.analysing.brdf_space_datasets import DATASET_A_MEMBER
from skinrig.analysing.population_sessions import (
    SESSIONS_FILE,
    PopulationSessions,
    encode_r_d,
    load_population_sessions,
)
from skinrig.appearances import face_textures
from skinrig.benchmarks.dome import people as dome
from skinrig.benchmarks.people import PeopleValues
from skinrig.fitting.traits import sample_albedo
from skinrig.traits.truth import CommonFaces, lobe_changes

TARGET = Path(__file__).resolve().parents[1] / "skinrig" / SESSIONS_FILE
SEED = 0
DOME = {"lights": 36, "views": 4, "width_px": 320}
POINTS, CONDITION_POINTS = 60, 300
"""Points of a person, and of the one person under a condition."""
COMMON = {"size": 256, "common": 192}
"""Texels per side of a face and of the common map of R_d."""


@cache
def common_frame() -> CommonFrame:
    """Return the common map of the population's heads."""
    return CommonFaces.of(draw_population(), **COMMON).frame


def keep(path: Path, make: Callable[[], dict[str, np.ndarray]]) -> None:
    """Make a file of arrays unless it exists."""
    if path.is_file():
        return
    begun, part = time.process_time(), path.with_suffix(".part.npz")
    np.savez(part, **make())
    part.rename(path)
    print(f"{path.stem}: {time.process_time() - begun:.0f} s", file=sys.stderr, flush=True)


def capture(folder: Path, name: str, points: int, **worn: object) -> dict[str, np.ndarray]:
    """Return what a dome session estimates of a member."""
    found, truth = dome.capture_face(folder, DOME, subject=name, **worn)
    rng = np.random.default_rng([SEED, 1, *map(ord, name)])
    basis = brdf_tables.default_basis()
    weights, lost, _ = read_weights(folder / "maps", basis, points, rng)
    regions = np.stack([*dome.estimate_regions(found, truth), dome.true_regions(truth)])
    albedo = sample_albedo(face_textures.read(folder / "maps"), common_frame())
    return {
        "weights": weights,
        "lost": np.array(lost),
        "regions": regions,
        "r_d": albedo.r_d.astype(np.float16),
        "valid": albedo.valid,
    }


def run(work: Path, people: int) -> None:
    """Capture conditions and people, one after the other."""
    folder, members = work / "dome", draw_population()
    if not (folder / "calibration").exists():
        folder.mkdir(parents=True, exist_ok=True)
        dome.calibrate_dome(folder, DOME)
    one = members[DATASET_A_MEMBER].name
    for worn in CONDITION_NAMES:
        given = {"conditions": {} if worn == "normal" else {worn: 1.0}}
        keep(
            work / f"condition-{worn}.npz",
            lambda g=given: capture(folder, one, CONDITION_POINTS, **g),
        )
    for k in np.random.default_rng(SEED).permutation(len(members))[:people]:
        name = members[k].name
        keep(work / f"dome-{name}.npz", lambda n=name: capture(folder, n, POINTS))


def collect(work: Path) -> None:
    """Write the packaged file from the sessions of the work folder."""
    order = [member.name for member in draw_population()]
    faces = {n: np.load(p) for n in order if (p := work / f"dome-{n}.npz").is_file()}
    worn = {n: np.load(work / f"condition-{n}.npz") for n in CONDITION_NAMES}
    stored: dict[str, np.ndarray] = {
        "captured": np.array(list(faces)),
        "regions": np.array([one["regions"] for one in faces.values()], np.float32),
        "lobes": np.array(dome.N_BASIS_BRDFS),
        "condition_names": np.array(list(worn)),
    }
    stored["r_d"] = np.array([encode_r_d(one["r_d"], one["valid"]) for one in faces.values()])
    half = dataclasses.replace(common_frame(), size=COMMON["common"] // 2)
    stored["frame"] = np.array(json.dumps(half.to_document()))
    for key, sessions in (("people", faces), ("conditions", worn)):
        weights = [one["weights"] for one in sessions.values()]
        stored[f"{key}_weights"] = np.concatenate(weights).astype(np.float16)
        stored[f"{key}_points"] = np.array([len(one) for one in weights], np.int32)
        stored[f"{key}_lost"] = np.array(sum(int(one["lost"]) for one in sessions.values()))
    np.savez_compressed(TARGET, **stored)
    print(f"{TARGET.name}: {len(faces)} people, {TARGET.stat().st_size} bytes")


def print_regions(sessions: PopulationSessions) -> None:
    """Print mean and deviation of each quantity over people, next to the ground truth."""
    estimated, stderr, true = (
        sessions.regions[:, k].reshape(len(sessions.captured), -1) for k in range(3)
    )
    people = PeopleValues(tuple(map(get_member, sessions.captured)), estimated, stderr, true)
    print(f"{len(sessions.captured)} people")
    columns = np.arange(true.shape[1]).reshape(len(dome.REGION_LANDMARKS), -1)
    for q, quantity in enumerate(dome.QUANTITY_NAMES):
        for k, region in zip(columns[:, q].tolist(), dome.REGION_LANDMARKS, strict=True):
            one = people.describe(k, digits=4)
            print(
                f"| {quantity}, {region} | {one['mean']} ± {one['mean, standard error']}; "
                f"{one['deviation']} ± {one['deviation, standard error']} | "
                f"{one['true mean']}; {one['true deviation']} | {people.error(k).error:.1f} |"
            )
        print(f"    exchanged people: p {people.exchange_probability(columns[:, q]):.4f}")
    print("    largest mean error: {:.2f}, bound {:.2f}".format(*people.largest_pull()))


def print_conditions(sessions: PopulationSessions) -> None:
    """Print cosines of each condition's change of the surface with the ground truth."""
    data, basis = sessions.conditions, brdf_tables.default_basis()
    mean = {n: data.weights[data.label == k].mean(axis=0) for k, n in enumerate(data.labels)}
    bare = dataclasses.replace(draw_population()[DATASET_A_MEMBER], applied=())
    worn = {n: [dataclasses.replace(bare, applied=((n, 1.0),))] for n in CONDITION_NAMES[1:]}
    changes = lobe_changes([bare], worn, rng=np.random.default_rng([SEED, 5]))
    packaged = load_packaged_traits().spaces["surface"]
    for name, true in changes.items():
        session = true.cosine(mean[name] - mean["normal"], basis)
        trait = true.cosine(packaged.trait(name).vector, basis)
        print(f"| {name} | {session:.3f} | {trait:.3f} |")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("work", type=Path, help="folder that keeps the estimates of each session")
    parser.add_argument("--people", type=int, default=87, help="people, in random order")
    parser.add_argument("--table", action="store_true", help="print tables of the stored file")
    given = parser.parse_args()
    if not given.table:
        if given.people:
            run(given.work, given.people)
        collect(given.work)
    sessions = load_population_sessions()
    print_regions(sessions)
    print_conditions(sessions)


if __name__ == "__main__":
    main()
