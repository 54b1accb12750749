"""The report's section on people: sigma_tr in table 2's layout, measured, simulated, published."""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from model import store
from model.skin import SkinAppearance
from model.translucency_population import (
    PopulationTable,
    SiteMeasurement,
    summarize,
    table,
    weyrich_2005,
)
from reconstruction.pipeline.probe.stages import CHANNEL_NAMES, SUBSURFACE_FILE
from skinrig.evaluating.subsurface import document_of, number
from skinrig.reporting import page

POPULATION_SIZE = 87
"""As many as Weyrich et al. 2005 measured."""
MEDIUM_PREFIXES = ("homogeneous:", "anisotropic:")
"""How simulated subjects that are media are named."""


def section(
    appearances: Mapping[str, SkinAppearance], truths: Mapping[str, Path] | None = None
) -> Iterator[page.Block]:
    """Yield the tables of sigma_tr over people; empty where nobody's skin was probed.

    Parameters
    ----------
    appearances
        By name; each that holds fits of a fibre probe counts as a person, unless its truth says
        that it is a medium.
    truths
        Folders of truths by name.
    """
    people = {
        name: fits
        for name, appearance in appearances.items()
        if (fits := document_of(appearance, SUBSURFACE_FILE)) is not None
        and not _is_medium(appearance, truths or {})
    }
    if not people:
        return
    published = weyrich_2005()
    drawn = table(
        published.sample(POPULATION_SIZE, rng=np.random.default_rng(0)), sites=published.sites
    )
    yield page.Heading("sigma_tr over people, 1/mm", level=2)
    yield page.note(
        "Deviations are over people. The publication heads its second column "
        "“Var.”; as variances its numbers would contradict the extremes that it shows, so that "
        "they are read as standard deviations. The smallest sigma_tr is the most translucent "
        "skin."
    )
    rows: list[tuple[object, ...]] = []
    for c, channel in enumerate(CHANNEL_NAMES):
        pairs = zip(published.mean_per_mm[:, c], published.deviation_per_mm[:, c], strict=True)
        cells = (float(one) for pair in pairs for one in pair)
        rows.append(("published (Weyrich et al. 2005, table 2)", channel, *cells))
    rows += _rows(f"simulated, {POPULATION_SIZE} people drawn from it", drawn, published.sites)
    measured = [one for name, fits in people.items() for one in _measured(name, fits)]
    if measured:
        found = summarize(measured)
        many = "session" if len(people) == 1 else "sessions"
        rows += _rows(f"measured here, {len(people)} {many}", found, published.sites)
    columns = [f"{site}, {word}" for site in published.sites for word in ("mean", "deviation")]
    head = ("who", "channel", *columns)
    yield page.table(
        head, rows, caption="Mean and standard deviation over people, red, green and blue light"
    )


def _is_medium(appearance: SkinAppearance, truths: Mapping[str, Path]) -> bool:
    """Tell a simulated medium of given coefficients, which is nobody's skin."""
    folder = truths.get(str(appearance.parameters.get("truth", "")))
    if folder is None:
        return False
    subject = str(store.read_document(folder).parameters.get("subject", ""))
    return subject.startswith(MEDIUM_PREFIXES)


def _rows(who: str, found: PopulationTable, sites: tuple[str, ...]) -> list[tuple[object, ...]]:
    rows: list[tuple[object, ...]] = []
    for c, channel in enumerate(found.channels):
        row: list[object] = [who, channel]
        for site in sites:
            s = found.sites.index(site) if site in found.sites else None
            count = 0 if s is None else int(found.count[s, c])
            row.append(float(found.mean_per_mm[s, c]) if count else float("nan"))
            row.append(float(found.deviation_per_mm[s, c]) if count > 1 else float("nan"))
        rows.append(tuple(row))
    return rows


def _measured(name: str, fits: Mapping[str, Any]) -> list[SiteMeasurement]:
    """Return the sites of a person that are known in every channel."""
    by_site: dict[str, list[Mapping[str, Any]]] = {}
    for entry in fits["sites"]:
        by_site.setdefault(entry["site"], []).append(entry)
    return [
        SiteMeasurement(
            name,
            site,
            tuple(number(entry["sigma_tr_per_mm"]) for entry in own),
            tuple(number(entry["sigma_tr_stderr"]) for entry in own),
        )
        for site, own in by_site.items()
        if all(entry["sigma_tr_stderr"] is not None for entry in own)
    ]
