"""The report's table of what simulated scenes built and left out, and why."""

import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from skinrig.reporting import page
from skinrig.simulating.leaving_out import may_be_left_out

VERDICT_ORDER = ("asked", "negligible", "unmodeled", "absent", "built")
"""In which verdicts are listed, see `rigsim.needs.effects.VERDICT_MEANINGS`."""

VERDICT_WORDS = {
    "asked": "left out as asked",
    "negligible": "left out, too small",
    "unmodeled": "not modeled",
    "absent": "not there",
    "built": "built",
}

SESSION_FILE = "session.json"


def effects_of(session: Path) -> list[Mapping[str, Any]]:
    """Return the effects that a session's manifest holds; none where it was measured.

    Parameters
    ----------
    session
        SESSION/ folder.
    """
    manifest = session / SESSION_FILE
    if not manifest.is_file():
        return []
    document = json.loads(manifest.read_text(encoding="utf-8"))
    found = document.get("extra", {}).get("effects", [])
    return [entry for entry in found if isinstance(entry, dict)]


def section(sessions: Sequence[Path]) -> Iterator[page.Block]:
    """Yield what the scenes of simulated sessions hold; empty where no session tells.

    Parameters
    ----------
    sessions
        SESSION/ folders. Those whose scenes are alike share a table.

    Yields
    ------
    Block
        HTML, the same for the same sessions in any order.
    """
    alike: dict[str, list[str]] = {}
    for session in sorted(sessions):
        found = effects_of(session)
        if found:
            alike.setdefault(json.dumps(found, sort_keys=True), []).append(session.name)
    if not alike:
        return
    yield page.Heading("What simulated scenes leave out", level=2)
    yield page.view("omissions")
    for text, names in alike.items():
        effects = json.loads(text)
        rows = sorted((_row(effect) for effect in effects), key=lambda row: _place(row[1]))
        out = sum(not effect["verdict"] == "built" for effect in effects)
        title = f"{', '.join(names)}: of {len(effects)} effects {len(effects) - out} built"
        head = ("effect", "what became of it", "why", "change over noise", "--leave-out")
        table = page.table(head, rows, caption="Effects of light in the scene")
        yield page.Folded(title, [table])


def _row(effect: Mapping[str, Any]) -> tuple[str, str, str, str, str]:
    over, switch = effect.get("over_noise"), str(effect.get("switch", ""))
    return (
        str(effect["name"]),
        VERDICT_WORDS.get(str(effect["verdict"]), str(effect["verdict"])),
        str(effect["reason"]),
        "" if over is None else f"{over:.3g}",
        switch if may_be_left_out(switch) else "",
    )


def _place(words: str) -> int:
    told = [VERDICT_WORDS[verdict] for verdict in VERDICT_ORDER]
    return told.index(words) if words in told else len(told)
