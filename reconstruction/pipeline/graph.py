"""A graph of stages: compute only what is wanted, reuse what is current, say what was left out."""

import hashlib
import json
import math
from collections.abc import Callable, Iterable, Mapping, MutableMapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np


class StageError(ValueError):
    """What is wanted cannot be computed."""


@dataclass(frozen=True, slots=True)
class PipelineStage:
    """One step of a reconstruction.

    Attributes
    ----------
    name
        Unique.
    needs
        Names of products that it reads.
    makes
        Names of products that it writes; no two stages make the same.
    run
        Called with the products needed, by name; returns the products made.
    parameters
        What else its result depends on, as JSON values: settings, hashes of the inputs that
        are no products, and a number that grows when the code changes its result.
    refused
        Why it cannot run, where that is known beforehand; empty: it can.
    """

    name: str
    needs: tuple[str, ...]
    makes: tuple[str, ...]
    run: Callable[..., Mapping[str, Any]]
    parameters: Mapping[str, Any] = field(default_factory=dict)
    refused: str = ""


def make_stage_factory(base: Mapping[str, Any]) -> Callable[..., PipelineStage]:
    """Return what makes the stages of one graph, whose parameters begin with those of ``base``.

    It takes a stage's name, its needs and what it makes as names parted by spaces, and what runs
    it; then why it is refused, and more parameters by name. What makes a single product returns
    that, what makes several a mapping.

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
    """What a run of the graph did."""

    products: Mapping[str, Any]
    """The wanted products, by name."""
    ran: tuple[str, ...]
    reused: tuple[str, ...]
    omitted: tuple[tuple[str, str], ...]
    """Stages that nothing wanted needs, each with the reason."""
    keys: Mapping[str, str]
    """Input hash of each stage that was needed."""
    assumed: tuple[str, ...] = ()
    """What was taken for granted for want of a calibration."""
    work: tuple[Mapping[str, str], ...] = ()
    """What became of each stage and why, see `record_run`."""


def order_stages(stages: Sequence[PipelineStage], want: Iterable[str]) -> list[PipelineStage]:
    """Return the stages that ``want`` depends on, each after those it needs.

    Parameters
    ----------
    stages
        The whole graph.
    want
        Names of products.

    Raises
    ------
    StageError
        When a wanted or needed product is made by no stage, two stages make the same
        product, or stages need each other in a circle.

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
                both = f"{maker[product].name!r} and {stage.name!r}"
                raise StageError(f"product {product!r}: made by {both}")
            maker[product] = stage
    ordered: list[PipelineStage] = []
    visiting: list[str] = []

    def visit(product: str, by: str) -> None:
        if product not in maker:
            raise StageError(
                f"{by}: {product!r} is not a map that can be made here; "
                f"got {product!r}, expected one of {', '.join(sorted(maker))}"
            )
        stage = maker[product]
        if stage in ordered:
            return
        if stage.name in visiting:
            raise StageError(f"stages need each other: {' -> '.join([*visiting, stage.name])}")
        visiting.append(stage.name)
        for needed in stage.needs:
            visit(needed, f"stage {stage.name}")
        visiting.pop()
        ordered.append(stage)

    for product in want:
        visit(product, "wanted")
    return ordered


def input_hashes(ordered: Iterable[PipelineStage]) -> dict[str, str]:
    """Return the hash of all that a stage's products depend on, by the name of the stage.

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
    progress: Callable[[str], None] | None = None,
) -> RunResult:
    """Compute the wanted products and nothing else.

    A stage whose input hash is in the cache is not run; neither are the stages that only it
    needed.

    Parameters
    ----------
    stages
        The graph.
    want
        Names of products, in any order.
    cache
        Products kept from earlier runs, by the input hash of their stage: all of a stage or some.
        What is made is added.
    progress
        Called with a line of text before each stage that runs.

    Returns
    -------
    Outcome
    """
    needed = order_stages(stages, want)
    made_by = {product: stage for stage in needed for product in stage.makes}
    keys = input_hashes(needed)
    cache = {} if cache is None else cache
    for stage in needed:  # before anything is computed in vain
        if stage.refused and keys[stage.name] not in cache:
            raise StageError(stage.refused)
    products: dict[str, Any] = {}
    ran: list[str] = []
    reused: list[str] = []

    def provide(product: str) -> None:
        if product in products:
            return
        stage = made_by[product]
        kept = cache.get(keys[stage.name], {})
        if product in kept:
            products.update({name: kept[name] for name in kept if name not in products})
            if stage.name not in reused:
                reused.append(stage.name)
            return
        for needed_product in stage.needs:
            provide(needed_product)
        if progress is not None:
            progress(stage.name)
        made = stage.run(**{product: products[product] for product in stage.needs})
        if set(made) != set(stage.makes):
            both = f"made {sorted(made)}, expected {sorted(stage.makes)}"
            raise StageError(f"stage {stage.name}: {both}")
        products.update(made)
        ran.append(stage.name)
        if stage.name in reused:  # its maps were at hand, but not what only other stages need
            reused.remove(stage.name)
        cache[keys[stage.name]] = made

    for product in want:
        provide(product)
    left_out = [(s.name, "nothing wanted depends on it") for s in stages if s not in needed]
    idle = [s.name for s in needed if s.name not in ran and s.name not in reused]
    left_out += [(name, "what depends on it was reused") for name in idle]
    wanted = {product: products[product] for product in want}
    return RunResult(wanted, tuple(ran), tuple(reused), tuple(left_out), keys)


def record_run(
    graph: Sequence[PipelineStage], outcome: RunResult, before: Mapping[str, str]
) -> tuple[dict[str, str], ...]:
    """Return what a run did, stage by stage in the order of the graph.

    Parameters
    ----------
    graph
        All stages.
    outcome
        What a run of it did.
    before
        Input hash of each stage of the run before, by name; empty: there was none.

    Returns
    -------
    tuple of dict
        ``stage``; ``done``: "run", "reused" or "skipped"; ``why``; ``inputs``: the hash of all that
        the stage's products depend on, empty where nothing needed it.

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
        done, why = "skipped", skipped.get(name, "nothing wanted depends on it")
        if name in outcome.reused:
            done, why = "reused", "its inputs are the same"
        elif name in outcome.ran:
            done, why = "run", "what it made is not kept, or not all of it"
            if before.get(name) != key:
                why = "its inputs have changed" if name in before else "it was not made before"
        return {"stage": name, "done": done, "why": why, "inputs": key}

    return tuple(entry(stage.name) for stage in graph)


def select_attributes(record: Any, names: str) -> dict[str, Any]:
    """Return attributes of a record by their names, which are parted by spaces.

    Examples
    --------
    >>> select_attributes(3 + 4j, "real imag")
    {'real': 3.0, 'imag': 4.0}
    """
    return {name: getattr(record, name) for name in names.split()}


def serialize_document(document: Mapping[str, Any]) -> bytes:
    """Return a document as JSON text, UTF-8; arrays become lists, what is not finite null.

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
