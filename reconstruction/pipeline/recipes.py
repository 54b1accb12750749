"""Reconstruct maps from a session and calibrations, and record the assumptions."""

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
from reconstruction.pipeline.checkpoints import Checkpoints
from reconstruction.pipeline.diagnosed_images import FAULTS_NOTE, DiagnosedImages, mark_faults
from reconstruction.pipeline.inputs import DomeOptions, Inputs, InputsError
from reconstruction.pipeline.recipe import Recipe
from reconstruction.pipeline.run_progress import RunProgress


def light_list_recipe() -> Recipe:
    """Return the recipe of imported images under listed lights, without a rig."""
    from reconstruction.pipeline import light_stack

    return Recipe(light_stack.MAP_NAMES, light_stack.graph, diagnose=light_stack.diagnose_images)


def recipe_for_session(session: Session) -> Recipe:
    """Return the recipe for a session's rig kind.

    Raises
    ------
    InputsError
        When its plan has no step that shows a subject.
    """
    if "light_list" in session.manifest.extra:
        return light_list_recipe()
    kinds = {step.kind for step in session.plan.steps}
    for rig, kind in RIG_KINDS.items():
        if kind.subject_step in kinds:
            # importing a module compiles its kernels: each rig imports only its own
            recipe: Recipe = import_module(f"reconstruction.pipeline.{rig}.recipe").RECIPE
            return recipe
    shown = " or ".join(kind.subject_step for kind in RIG_KINDS.values())
    raise InputsError(
        f"{session.path}: got steps of kind {', '.join(sorted(kinds))}, expected "
        f"{shown}; use `skinrig calibrate` for sessions of targets"
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
    progress: Callable[[str, float | None], None] | None = None,
) -> stages.RunResult:
    """Compute the wanted maps of a session and write them to an APPEARANCE/ folder.

    Finished stages are kept in a work folder until the maps are written: the same call resumes an
    interrupted one, see `reconstruction.pipeline.checkpoints`.

    Parameters
    ----------
    session
        SESSION/ folder.
    want
        Names of maps, which depend on the rig, see docs/reference/maps.md.
    out
        APPEARANCE/ folder. Maps in it whose input hash is unchanged are kept.
    calibration
        CALIBRATION/ folder; without it assumptions replace the calibrations and are recorded.
    state
        Name of the subject's expression or condition.
    on_date
        Date on which the calibrations must be valid; None: that of the session.
    landmarks
        Table "name,x,y" of positions on a probe's translucency map, pixels from its top left; None:
        forehead, cheek and chin of the simulated heads' texture.
    dome
        Options that only sessions of the dome take; None: none of them.
    truth
        Name of the TRUTH/ folder in the same parent folder as ``out``, for the report.
    progress
        Called with a line of text and the estimated seconds that are left, None where unknown,
        before each stage and each tile that is computed.

    Returns
    -------
    RunResult
        Stages that ran, were reused or were omitted, each with the reason.

    Raises
    ------
    InputsError, stages.StageError, SessionError, CalibrationError
        When frames are missing, a wanted map is unknown, or a file is damaged, of another rig
        or out of date.
    BusyError
        When another process computes the same maps.
    """
    opened = Session.open(session)
    recipe = recipe_for_session(opened)
    store.require_free(out)
    options = dome or DomeOptions()
    _require_fitting_options(opened, recipe, options)
    for name, file in {"scan": options.scan, "landmarks": landmarks}.items():
        if file is not None and not Path(file).is_file():
            raise InputsError(f"{name}: got {file}, expected a file; correct the path")
    if options.rank is not None and recipe.maps_of_rank is not None:
        recipe = replace(recipe, maps=recipe.maps_of_rank(options.rank))
    _require_known(want, recipe.maps)
    inputs = Inputs.of(
        opened, calibration, state=state, on_date=on_date, landmarks=landmarks, dome=options
    )
    inputs.progress = RunProgress(progress, recipe.typical_seconds)
    graph = recipe.graph(inputs)
    products = _planned_products(graph, recipe, opened, want)
    previous = _Previous.of(Path(out))
    held = previous.current_products(graph)
    kept = {previous.keys[name]: contents for name, contents in held.items()}
    with Checkpoints.of_output(Path(out), inputs.options(), inputs.record()) as checkpoints:
        inputs.checkpoints = checkpoints
        outcome = stages.run_stages(
            graph, products, cache=kept, checkpoints=checkpoints, progress=inputs.progress
        )
        work = stages.record_run(graph, outcome, {name: previous.keys[name] for name in held})
        outcome = replace(outcome, assumed=tuple(inputs.assumed), work=work)
        # consent must go with the maps wherever they are copied
        consent = [opened.manifest.to_json()["subject"]] if opened.source == "measured" else []
        current = previous.exists and previous.parameters.get("consent", []) == consent
        if not outcome.ran and current and set(products) <= set(previous.contents):
            return outcome
        named = {
            "kind": "appearance",
            "session": Path(session).name,
            "state": state,
            "truth": truth,
        }
        made = {name: outcome.products[name] for name in products}
        store.write(
            out, _appearance(inputs, graph, outcome, made, previous, {**named, "consent": consent})
        )
    return outcome


def list_maps(session: str | Path) -> list[str]:
    """Return the names of the maps that a session yields, in the order of its recipe.

    Parameters
    ----------
    session
        SESSION/ folder.

    Raises
    ------
    InputsError, SessionError
        If the session shows no subject, or is damaged.
    """
    return list(recipe_for_session(Session.open(session)).maps)


def diagnose(session: str | Path) -> DiagnosedImages:
    """Find what is wrong with a session's images from their pixels.

    Parameters
    ----------
    session
        SESSION/ folder: images under listed lights, polarized pairs, or gradient patterns.

    Raises
    ------
    InputsError, SessionError
        If the session has no such images, or is damaged.
    PhotometricStereoError
        If its images cannot be judged: too few, or without light.
    """
    opened = Session.open(session)
    recipe = recipe_for_session(opened)
    if recipe.diagnose is None:
        raise InputsError(
            f"{opened.path}: got a session of the rig {opened.rig.name!r}, expected images under "
            "listed lights, polarized pairs or gradient patterns; other images have no rules"
        )
    assumed = opened.manifest.extra.get("assumed", [])
    lines = tuple(map(str, assumed)) if isinstance(assumed, list) else ()
    found = recipe.diagnose(opened)
    return replace(found, assumed=(*lines, *found.assumed))


def _require_fitting_options(session: Session, recipe: Recipe, dome: DomeOptions) -> None:
    options = {"hold-out": dome.hold_out, "rank": dome.rank, "scan": dome.scan, "basis": dome.basis}
    given = [name for name, value in options.items() if value is not None]
    if given and recipe.maps_of_rank is None:
        got = f"{', '.join(given)}: got a session of another rig, {session.path}"
        raise InputsError(f"{got}, expected one of the dome; omit the options of the dome")
    Checks(InputsError).within("rank", 1 if dome.rank is None else dome.rank, "[1, inf)")


def _require_known(want: Sequence[str], maps: Sequence[str]) -> None:
    check = Checks(InputsError)
    check.require(want, "want", "nothing", f"names out of {', '.join(maps)}; give some")
    for name in want:
        check.choice("want", name, maps)


def _planned_products(
    graph: Sequence[stages.PipelineStage], recipe: Recipe, session: Session, want: Sequence[str]
) -> list[str]:
    """Return all products of the stages that make a wanted one.

    The other maps of such a stage add no cost, and only whole stages can be reused.
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
    """Merge new products with those of an older folder that are still current."""
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
    faults = noted.get(FAULTS_NOTE, [])
    kept = mark_faults(kept, faults if isinstance(faults, list) else [])
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
    """Older APPEARANCE/ folder; empty where there is none."""

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
                f"{error}; nothing was written: remove {out} or choose another folder to recompute"
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
        """Return the folder's products of each stage whose input hash is unchanged."""
        of_stages: dict[str, Mapping[str, SkinMap | bytes]] = {}
        for stage in graph:
            held = {name: self.contents[name] for name in stage.makes if name in self.contents}
            if held and stage.name in self.keys:
                of_stages[stage.name] = held
        return of_stages
