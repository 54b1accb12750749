"""Benchmark of table 2: sigma_tr over people, from simulated and fitted probe sessions."""

import json
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np

from model.translucency_population import CHANNEL_NAMES, SITE_OF_LABEL, weyrich_2005
from reconstruction.pipeline.probe.stages import SUBSURFACE_FILE
from rigsim.fiber.probe_tissue import phantom_certificate
from rigsim.population.population import Member
from skinrig.benchmarks.intervals.trials import reconstruct_maps, resimulate
from skinrig.benchmarks.people import PeopleValues, choose_members
from skinrig.benchmarks.results import Timing
from skinrig.benchmarks.stage import BenchmarkStage
from skinrig.calibrating.calibrate import calibrate
from skinrig.evaluating import subsurface as evaluation
from skinrig.simulating.simulation import simulate_session

PROBED_SITES: Final = ("forehead", "cheek", "chin")
"""Sites of table 2; its neck is measured below the chin."""
TOY_PEOPLE: Final = 2
N_TOY_SITES: Final = 2


def measure_people(stage: BenchmarkStage) -> None:
    """Measure mean and deviation of sigma_tr over members of the population."""
    members = choose_members(1)[: TOY_PEOPLE if stage.toy else None]
    sites = PROBED_SITES[: N_TOY_SITES if stage.toy else None]
    began = time.perf_counter()
    with tempfile.TemporaryDirectory() as place:
        people = probe_people(Path(place), members, sites)
    timing = Timing.single((time.perf_counter() - began) / len(members))
    published = weyrich_2005()
    worst = 0.0
    for k in range(people.true.shape[1]):
        s, c = divmod(k, len(CHANNEL_NAMES))
        site = SITE_OF_LABEL.get(sites[s], sites[s])
        p = published.sites.index(site)
        extra = people.describe(k) | {
            "published mean": float(published.mean_per_mm[p, c]),
            "published deviation": float(published.deviation_per_mm[p, c]),
        }
        knobs = {"site": site, "channel": CHANNEL_NAMES[c]}
        worst = max(worst, stage.add(knobs, timing, people.error(k), extra).error)
    stage.limits = {
        "error": worst,
        "pull": people.largest_pull(),
        "exchange": people.exchange_probability(np.arange(people.true.shape[1])),
    }


def probe_people(
    folder: Path, members: Sequence[Member], sites: Sequence[str] = PROBED_SITES
) -> PeopleValues:
    """Simulate and fit probe sessions of people; return sigma_tr in 1/mm, site by site.

    Parameters
    ----------
    folder
        Empty folder of the sessions. One calibration serves all people.
    members
        Members of the population.
    sites
        Sites of table 2 that are probed.
    """
    phantom, paper = folder / "session-phantom", folder / "block.json"
    simulate_session("probe", phantom, target="phantom", seed=1)
    paper.write_text(json.dumps(dict(phantom_certificate())), encoding="utf-8")
    calibrate("fiber", [phantom], folder / "calibration", phantom=paper)
    shape = (len(members), len(sites), len(CHANNEL_NAMES))
    estimated, stderr, true = np.full((3, *shape), np.nan)
    for row, member in enumerate(members):
        done = resimulate("probe", folder, subject=member.name, seed=row, sites=tuple(sites))
        fits, known = reconstruct_maps(folder, done, ["subsurface"])
        document = evaluation.read_document(fits, SUBSURFACE_FILE)
        for one in [] if document is None else evaluation.site_measurements(member.name, document):
            at = row, sites.index(one.site)
            estimated[at], stderr[at] = one.sigma_tr_per_mm, one.stderr_per_mm
        for entry in evaluation.true_profiles(known).values():
            true[row, sites.index(str(entry["site"]))] = entry["sigma_tr_per_mm"]
    return PeopleValues(
        tuple(members), *(v.reshape(len(members), -1) for v in (estimated, stderr, true))
    )
