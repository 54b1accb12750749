"""Run a graph of stages: compute the wanted products, reuse current ones, record omissions."""

import hashlib
import json
import math
from collections.abc import Callable, Iterable, Mapping, MutableMapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any, Final

import numpy as np

from reconstruction.pipeline.checkpoints import Checkpoints
from reconstruction.pipeline.run_progress import RunProgress

UNWANTED_REASON: Final = "no wanted product depends on it"
"""Reason for which a stage is omitted that was not requested."""


class StageError(ValueError):
    """Wanted products that the graph cannot compute."""


@dataclass(frozen=True, slots=True)
class PipelineStage:
    """One stage of a reconstruction.

    Attributes
    ----------
    name
        Unique name.
    needs
        Names of the products that the stage reads.
    makes
        Names of the products that the stage writes; two stages never make the same product.
    run
        Called with the needed products by name; returns the products made.
    parameters
        Further dependencies of the result as JSON values: settings, hashes of inputs that are
        not products, and a revision that grows when the code changes its result.
    refused
        Reason why the stage cannot run, if known beforehand; empty: the stage can run.
    """

    name: str
    needs: tuple[str, ...]
    makes: tuple[str, ...]
    run: Callable[..., Mapping[str, Any]]
    parameters: Mapping[str, Any] = field(default_factory=dict)
    refused: str = ""


def make_stage_factory(base: Mapping[str, Any]) -> Callable[..., PipelineStage]:
    """Return a factory for the stages of one graph, whose parameters begin with ``base``.

    The factory takes a stage's name, its needs and its products as names separated by spaces, and
    the function to run; then the reason for a refusal, and more parameters by name. The function
    returns the product itself if there is one, else a mapping of products.

    Examples
    --------
    >>> stage = make_stage_factory({"revision": 1})("double", "x", "y", lambda x: 2 * x, gain=2)
    >>> stage.run(x=3), stage.parameters
    ({'y': 6}, {'revision': 1, 'gain': 2})
    """

    def stage(
        name: str, needs: str, makes: str, run: Callable[..., Any], refused: str = "", **more: Any
    ) -> PipelineStage:
        products = tuple(makes.split())

        def made(**needed: Any) -> Mapping[str, Any]:
            found: Any = run(**needed)
            return found if len(products) > 1 else {products[0]: found}

        return PipelineStage(name, tuple(needs.split()), products, made, {**base, **more}, refused)

    return stage


@dataclass(frozen=True, slots=True)
class RunResult:
    """Result of one run of the graph."""

    products: Mapping[str, Any]
    """The wanted products, by name."""
    ran: tuple[str, ...]
    reused: tuple[str, ...]
    omitted: tuple[tuple[str, str], ...]
    """Stages that no wanted product needs, each with the reason."""
    keys: Mapping[str, str]
    """Input hash of each stage that was needed."""
    assumed: tuple[str, ...] = ()
    """Assumptions that replaced missing calibrations."""
    work: tuple[Mapping[str, str], ...] = ()
    """Outcome of each stage with the reason, see `record_run`."""


def order_stages(stages: Sequence[PipelineStage], want: Iterable[str]) -> list[PipelineStage]:
    """Order the stages that ``want`` depends on, each after those it needs.

    Parameters
    ----------
    stages
        The whole graph.
    want
        Names of products.

    Raises
    ------
    StageError
        When no stage makes a wanted or needed product, two stages make the same product, or
        stages need each other in a circle.

    Examples
    --------
    >>> a = PipelineStage("a", (), ("x",), dict)
    >>> b = PipelineStage("b", ("x",), ("y",), dict)
    >>> [stage.name for stage in order_stages([b, a], ["y"])]
    ['a', 'b']
    """
    maker: dict[str, PipelineStage] = {}
    for stage in stages:
        for product in stage.makes:
            if product in maker:
                both = f"stages {maker[product].name!r} and {stage.name!r}, expected one of them"
                raise StageError(f"product {product!r}: made by {both}; rename one product")
            maker[product] = stage
    ordered: list[PipelineStage] = []
    visiting: list[str] = []

    def visit(product: str, by: str) -> None:
        if product not in maker:
            raise StageError(
                f"{by}: {product!r} is not a map that can be made here; "
                f"expected one of {', '.join(sorted(maker))}; choose one [SR-REC-002]"
            )
        stage = maker[product]
        if stage in ordered:
            return
        if stage.name in visiting:
            chain = " -> ".join([*visiting, stage.name])
            raise StageError(f"stages need each other: {chain}; remove one of these needs")
        visiting.append(stage.name)
        for needed in stage.needs:
            visit(needed, f"stage {stage.name}")
        visiting.pop()
        ordered.append(stage)

    for product in want:
        visit(product, "wanted")
    return ordered


def input_hashes(ordered: Iterable[PipelineStage]) -> dict[str, str]:
    """Hash everything that each stage's products depend on, by the name of the stage.

    Parameters
    ----------
    ordered
        As `order_stages` returns them.
    """
    made_by = {product: stage.name for stage in ordered for product in stage.makes}
    keys: dict[str, str] = {}
    for stage in ordered:
        needed = [keys[made_by[product]] for product in stage.needs]
        text = json.dumps([stage.name, stage.makes, needed, dict(stage.parameters)], sort_keys=True)
        keys[stage.name] = hashlib.sha256(text.encode("utf-8")).hexdigest()
    return keys


def run_stages(
    stages: Sequence[PipelineStage],
    want: Sequence[str],
    *,
    cache: MutableMapping[str, Mapping[str, Any]] | None = None,
    checkpoints: Checkpoints | None = None,
    progress: RunProgress | None = None,
) -> RunResult:
    """Compute the wanted products, and only the stages that they need.

    A stage is skipped when its input hash is in the cache; stages that only it needs are skipped
    too. A stage that an interrupted run finished counts as run, as if nothing had interrupted it.

    Parameters
    ----------
    stages
        The graph.
    want
        Names of products, in any order.
    cache
        Products kept from earlier runs, by the input hash of their stage; all of a stage's
        products or some. New products are added.
    checkpoints
        Stages and tiles that an interrupted run finished; the others are added. None: none.
    progress
        Receives the names of the stages that run, and the beginning of each.

    Returns
    -------
    RunResult
        Products, with the stages that ran, were reused or were omitted.
    """
    needed = order_stages(stages, want)
    made_by = {product: stage for stage in needed for product in stage.makes}
    keys = input_hashes(needed)
    cache = {} if cache is None else cache
    for stage in needed:  # refuse before any stage runs
        if stage.refused and keys[stage.name] not in cache:
            raise StageError(stage.refused)
    products: dict[str, Any] = {}
    running: list[PipelineStage] = []
    reused: list[str] = []
    settled: set[str] = set()

    def settle(product: str) -> None:
        """Take a product from the cache, or list its stage after those that it needs."""
        if product in settled:
            return
        stage = made_by[product]
        kept = cache.get(keys[stage.name], {})
        if product in kept:
            products.update({name: kept[name] for name in kept if name not in products})
            settled.update(kept)
            if stage.name not in reused:
                reused.append(stage.name)
            return
        for needed_product in stage.needs:
            settle(needed_product)
        running.append(stage)
        settled.update(stage.makes)
        # the cache can hold a stage's maps but lack the products that only other stages need
        if stage.name in reused:
            reused.remove(stage.name)
        for name in stage.makes:
            products.pop(name, None)

    def provide(product: str) -> Any:
        """Return a product; one of a finished stage is loaded when it is needed."""
        if product not in products:
            stage = made_by[product]
            found = checkpoints.load(keys[stage.name]) if checkpoints is not None else None
            products.update(run(stage, again=True) if found is None else found)
        return products[product]

    def run(stage: PipelineStage, *, again: bool = False) -> Mapping[str, Any]:
        needed = {product: provide(product) for product in stage.needs}
        if progress is not None:
            progress.begin_stage(stage.name)
        call = partial(_run_stage, stage, needed)
        if checkpoints is None:
            return call()
        compute = checkpoints.compute_again if again else checkpoints.compute
        return compute(keys[stage.name], call)

    for product in want:
        settle(product)
    todo = [s for s in running if checkpoints is None or not checkpoints.recall(keys[s.name])]
    if progress is not None:
        progress.plan(stage.name for stage in todo)
    for stage in todo:
        made = cache[keys[stage.name]] = run(stage)
        products.update(made)
    for product in want:
        provide(product)
    ran = [stage.name for stage in running]
    left_out = [(s.name, UNWANTED_REASON) for s in stages if s not in needed]
    idle = [s.name for s in needed if s.name not in ran and s.name not in reused]
    left_out += [(name, "the stages that depend on it were reused") for name in idle]
    wanted = {product: products[product] for product in want}
    return RunResult(wanted, tuple(ran), tuple(reused), tuple(left_out), keys)


def _run_stage(stage: PipelineStage, needed: Mapping[str, Any]) -> Mapping[str, Any]:
    made = stage.run(**needed)
    if set(made) != set(stage.makes):
        both = f"made {sorted(made)}, expected {sorted(stage.makes)}"
        raise StageError(f"stage {stage.name}: {both}; correct its makes or its run")
    return made


def record_run(
    graph: Sequence[PipelineStage], outcome: RunResult, before: Mapping[str, str]
) -> tuple[dict[str, str], ...]:
    """Describe a run, stage by stage in the order of the graph.

    Parameters
    ----------
    graph
        All stages.
    outcome
        Result of one run of it.
    before
        Input hash of each stage in the previous run, by name; empty: there was none.

    Returns
    -------
    tuple of dict
        ``stage``; ``done``: "run", "reused" or "skipped"; ``why``; ``inputs``: the stage's input
        hash, see `input_hashes`, empty where no stage needed it.

    Examples
    --------
    >>> a = PipelineStage("a", (), ("x",), dict)
    >>> outcome = RunResult({}, ("a",), (), (), {"a": "12"})
    >>> record_run([a], outcome, {"a": "34"})[0]["why"]
    'its inputs have changed'
    """
    skipped = dict(outcome.omitted)

    def entry(name: str) -> dict[str, str]:
        key = outcome.keys.get(name, "")
        done, why = "skipped", skipped.get(name, UNWANTED_REASON)
        if name in outcome.reused:
            done, why = "reused", "its inputs are the same"
        elif name in outcome.ran:
            done, why = "run", "its products are not all in the cache"
            if before.get(name) != key:
                why = "its inputs have changed" if name in before else "it was not made before"
        return {"stage": name, "done": done, "why": why, "inputs": key}

    return tuple(entry(stage.name) for stage in graph)


def select_attributes(record: Any, names: str) -> dict[str, Any]:
    """Return attributes of a record by their names, which are separated by spaces.

    Examples
    --------
    >>> select_attributes(3 + 4j, "real imag")
    {'real': 3.0, 'imag': 4.0}
    """
    return {name: getattr(record, name) for name in names.split()}


def serialize_document(document: Mapping[str, Any]) -> bytes:
    """Encode a document as JSON text, UTF-8; arrays become lists, non-finite numbers null.

    Examples
    --------
    >>> serialize_document({"r_mm": np.array([1.0, np.nan])}).split()
    [b'{', b'"r_mm":', b'[', b'1.0,', b'null', b']', b'}']
    """
    return json.dumps(_plain(document), indent=1, allow_nan=False).encode("utf-8")


def _plain(value: Any) -> Any:
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    if isinstance(value, Mapping):
        return {key: _plain(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(entry) for entry in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
