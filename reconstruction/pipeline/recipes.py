"""Sessions and calibrations to maps: computes what is wanted, and records what it assumed."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import date
from importlib import import_module, metadata
from pathlib import Path

from capture.plan.rig_kinds import RIG_KINDS
from capture.session import Session
from model import store
from model.checks import Checks
from model.skin import SkinAppearance, SkinMap
from reconstruction.pipeline import graph as stages
from reconstruction.pipeline.inputs import DomeOptions, Inputs, InputsError
from reconstruction.pipeline.recipe import Recipe


def light_list_recipe() -> Recipe:
    """Return the recipe of images under listed lights, imported without a rig."""
    from reconstruction.pipeline import light_stack

    return Recipe(light_stack.MAP_NAMES, light_stack.graph)


def recipe_for_session(session: Session) -> Recipe:
    """Return what can be made of a session.

    Raises
    ------
    InputsError
        When no step of its plan shows a subject.
    """
    if "light_list" in session.manifest.extra:
        return light_list_recipe()
    kinds = {step.kind for step in session.plan.steps}
    for rig, kind in RIG_KINDS.items():
        if kind.subject_step in kinds:
            # kernels are compiled when a module is first imported: each rig imports its own only
            recipe: Recipe = import_module(f"reconstruction.pipeline.{rig}.recipe").RECIPE
            return recipe
    shown = " or ".join(kind.subject_step for kind in RIG_KINDS.values())
    raise InputsError(
        f"{session.path}: shows {', '.join(sorted(kinds))}, expected steps of kind "
        f"{shown}; `skinrig calibrate` takes sessions of targets"
    )


def reconstruct(
    session: str | Path,
    *,
    want: Sequence[str],
    out: str | Path,
    calibration: str | Path | None = None,
    state: str = "neutral",
    on_date: date | None = None,
    landmarks: str | Path | None = None,
    dome: DomeOptions | None = None,
    truth: str = "",
    progress: Callable[[str], None] | None = None,
) -> stages.RunResult:
    """Make the wanted maps of a session and write them to an APPEARANCE/ folder.

    Parameters
    ----------
    session
        SESSION/ folder.
    want
        Names of maps; which there are depends on the rig, see docs/reference/maps.md.
    out
        The folder. Maps in it that are still current, by the hash of all that they depend on,
        are kept and not computed again.
    calibration
        CALIBRATION/ folder; without it assumptions take its place and are recorded.
    state
        Which state of the subject.
    on_date
        The date the calibrations must be valid on; None: that of the session.
    landmarks
        Table "name,x,y" of places on a probe's translucency map, pixels from its top left; None:
        forehead, cheek and chin of the simulated heads' texture.
    dome
        What only sessions of the dome take; None: nothing of it.
    truth
        Name of the TRUTH/ folder beside ``out``, for the report.
    progress
        Called with one line before each stage that runs.

    Returns
    -------
    stages.Outcome
        With what ran, what was reused, and what was left out and why.

    Raises
    ------
    InputsError, stages.StageError, SessionError, CalibrationError
        When frames are missing, a wanted map is unknown, or a file is damaged, of another rig
        or out of date.
    """
    opened = Session.open(session)
    recipe = recipe_for_session(opened)
    store.require_free(out)
    options = dome or DomeOptions()
    _require_fitting_options(opened, recipe, options)
    for name, file in {"scan": options.scan, "landmarks": landmarks}.items():
        if file is not None and not Path(file).is_file():
            raise InputsError(f"{name}: {file} is no file")
    if options.rank is not None and recipe.maps_of_rank is not None:
        recipe = replace(recipe, maps=recipe.maps_of_rank(options.rank))
    _require_known(want, recipe.maps)
    inputs = Inputs.of(
        opened, calibration, state=state, on_date=on_date, landmarks=landmarks, dome=options
    )
    inputs.progress = progress
    graph = recipe.graph(inputs)
    products = _planned_products(graph, recipe, opened, want)
    previous = _Previous.of(Path(out))
    held = previous.current_products(graph)
    kept = {previous.keys[name]: contents for name, contents in held.items()}
    outcome = stages.run_stages(graph, products, cache=kept, progress=progress)
    work = stages.record_run(graph, outcome, {name: previous.keys[name] for name in held})
    outcome = replace(outcome, assumed=tuple(inputs.assumed), work=work)
    # what the subject agreed to goes wherever the maps go
    consent = [opened.manifest.to_json()["subject"]] if opened.source == "measured" else []
    current = previous.exists and previous.parameters.get("consent", []) == consent
    if not outcome.ran and current and set(products) <= set(previous.contents):
        return outcome
    named = {"kind": "appearance", "session": Path(session).name, "state": state, "truth": truth}
    made = {name: outcome.products[name] for name in products}
    store.write(
        out, _appearance(inputs, graph, outcome, made, previous, {**named, "consent": consent})
    )
    return outcome


def _require_fitting_options(session: Session, recipe: Recipe, dome: DomeOptions) -> None:
    options = {"hold-out": dome.hold_out, "rank": dome.rank, "scan": dome.scan, "basis": dome.basis}
    given = [name for name, value in options.items() if value is not None]
    if given and recipe.maps_of_rank is None:
        hint = "leave out what only it takes"
        raise InputsError(f"{', '.join(given)}: {session.path} is no session of the dome; {hint}")
    Checks(InputsError).within("rank", 1 if dome.rank is None else dome.rank, "[1, inf)")


def _require_known(want: Sequence[str], maps: Sequence[str]) -> None:
    check = Checks(InputsError)
    check.require(want, "want", "nothing", f"names out of {', '.join(maps)}")
    for name in want:
        check.choice("want", name, maps)


def _planned_products(
    graph: Sequence[stages.PipelineStage], recipe: Recipe, session: Session, want: Sequence[str]
) -> list[str]:
    """Return the products of all stages that make something wanted.

    A stage's other maps cost nothing more, and only whole stages can be reused.
    """
    kept_names = recipe.expand(session, (*recipe.maps, *recipe.files))
    wanted = set(recipe.expand(session, (*want, *recipe.required)))
    made = [name for stage in graph if wanted.intersection(stage.makes) for name in stage.makes]
    return [name for name in made if name in kept_names]


def _appearance(
    inputs: Inputs,
    graph: Sequence[stages.PipelineStage],
    outcome: stages.RunResult,
    made: Mapping[str, SkinMap | bytes],
    previous: _Previous,
    parameters: Mapping[str, object],
) -> SkinAppearance:
    """Return what was made, with what an older folder holds that is still current."""
    keys = stages.input_hashes(stages.order_stages(graph, [p for s in graph for p in s.makes]))
    kept = dict(made)
    for stage, held in previous.current_products(graph).items():
        if previous.keys[stage] == keys[stage]:
            kept |= {name: value for name, value in held.items() if name not in kept}
    noted = dict(inputs.noted)
    if previous.exists and previous.inputs == inputs.hashes:
        names = previous.parameters.get("noted", [])
        texts = [str(name) for name in names] if isinstance(names, list) else []
        noted |= {n: previous.parameters.get(n) for n in texts if n not in noted}
    return SkinAppearance(
        maps={name: value for name, value in kept.items() if isinstance(value, SkinMap)},
        source=inputs.session.source,
        parameters={
            **parameters,
            "stages": {stage.name: keys[stage.name] for stage in graph},
            "work": [dict(entry) for entry in outcome.work],
            "assumed": inputs.assumed,
            "noted": sorted(noted),
            **noted,
        },
        inputs=inputs.hashes,
        versions={name: metadata.version(name) for name in ("skinrig", "numpy", "scipy", "numba")},
        left_out=outcome.omitted,
        files={name: value for name, value in kept.items() if isinstance(value, bytes)},
        seed=inputs.session.seed,
    )


@dataclass(frozen=True, slots=True)
class _Previous:
    """An older APPEARANCE/ folder; empty where there is none."""

    exists: bool
    contents: Mapping[str, SkinMap | bytes]
    """Maps and files by name."""
    parameters: Mapping[str, object]
    inputs: Mapping[str, str]
    keys: Mapping[str, str]
    """Input hash of each stage, as recorded."""

    @classmethod
    def of(cls, out: Path) -> _Previous:
        if not (out / store.DOCUMENT_FILE).is_file():
            return cls(False, {}, {}, {}, {})
        try:
            found = store.read(out)
        except store.StoreError as error:
            raise InputsError(
                f"{error}; nothing was written: remove {out}, or name another, to make all anew"
            ) from error
        recorded = found.parameters.get("stages", {})
        keys = recorded.items() if isinstance(recorded, dict) else ()
        return cls(
            True,
            {**found.maps, **found.files},
            found.parameters,
            dict(found.inputs),
            {str(name): str(key) for name, key in keys},
        )

    def current_products(
        self, graph: Sequence[stages.PipelineStage]
    ) -> dict[str, Mapping[str, SkinMap | bytes]]:
        """Return what the folder holds of each stage that it has the input hash of."""
        of_stages: dict[str, Mapping[str, SkinMap | bytes]] = {}
        for stage in graph:
            held = {name: self.contents[name] for name in stage.makes if name in self.contents}
            if held and stage.name in self.keys:
                of_stages[stage.name] = held
        return of_stages
