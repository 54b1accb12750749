"""Benchmark of table 2: sigma_tr over people, from simulated and fitted probe sessions."""

import json
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np

from model.translucency_population import CHANNEL_NAMES, SiteMeasurement, summarize, weyrich_2005
from reconstruction.pipeline.probe.stages import SUBSURFACE_FILE
from rigsim.fiber.probe_tissue import phantom_certificate
from rigsim.population.population import draw_population
from skinrig.benchmarks.intervals.trials import reconstruct_maps, resimulate
from skinrig.benchmarks.resampling import mean_error
from skinrig.benchmarks.results import Timing
from skinrig.benchmarks.stage import BenchmarkStage
from skinrig.calibrating.calibrate import calibrate
from skinrig.evaluating import subsurface as evaluation
from skinrig.simulating.simulation import simulate_session

PROBED_SITES: Final = ("forehead", "cheek", "chin")
"""Sites of table 2; its neck is measured below the chin."""


def measure_people(stage: BenchmarkStage) -> None:
    """Measure mean and deviation of sigma_tr over members of the population."""
    members = draw_population()[:: 44 if stage.toy else 16]
    began = time.perf_counter()
    with tempfile.TemporaryDirectory() as place:
        found, truth = _probe_people(Path(place), [member.name for member in members])
    seconds = (time.perf_counter() - began) / len(members)
    published = weyrich_2005()
    table = summarize(found)
    worst = 0.0
    for s, site in enumerate(table.sites):
        p = published.sites.index(site)
        for c, channel in enumerate(CHANNEL_NAMES):
            here = [one for one in found if _site(one) == site]
            measured = np.array([one.sigma_tr_per_mm[c] for one in here])
            true = np.array([truth[one.subject, one.site][c] for one in here])
            errors = 100.0 * np.abs(measured / true - 1.0)
            extra = {
                "people": int(table.count[s, c]),
                "mean, 1/mm": round(float(table.mean_per_mm[s, c]), 3),
                "deviation, 1/mm": round(float(table.deviation_per_mm[s, c]), 3),
                "published mean, 1/mm": float(published.mean_per_mm[p, c]),
                "published deviation, 1/mm": float(published.deviation_per_mm[p, c]),
            }
            knobs = {"site": site, "channel": channel}
            stage.add(knobs, Timing.single(seconds), mean_error(errors.tolist()), extra)
            worst = max(worst, float(np.median(errors)))
    stage.limits = {"error": worst}


def _site(measurement: SiteMeasurement) -> str:
    return "neck" if measurement.site == "chin" else measurement.site


def _probe_people(
    folder: Path, names: Sequence[str]
) -> tuple[list[SiteMeasurement], dict[tuple[str, str], list[float]]]:
    """Return the fitted sites of people, and the true sigma_tr by person and site."""
    phantom, paper = folder / "session-phantom", folder / "block.json"
    simulate_session("probe", phantom, target="phantom", seed=1)
    paper.write_text(json.dumps(dict(phantom_certificate())), encoding="utf-8")
    calibrate("fiber", [phantom], folder / "calibration", phantom=paper)
    found: list[SiteMeasurement] = []
    truth: dict[tuple[str, str], list[float]] = {}
    for seed, name in enumerate(names):
        done = resimulate("probe", folder, subject=name, seed=seed, sites=PROBED_SITES)
        fits, known = reconstruct_maps(folder, done, ["subsurface"])
        document = evaluation.read_document(fits, SUBSURFACE_FILE)
        if document is not None:
            found += evaluation.site_measurements(name, document)
        for entry in evaluation.true_profiles(known).values():
            truth[name, str(entry["site"])] = list(entry["sigma_tr_per_mm"])
    return found, truth
