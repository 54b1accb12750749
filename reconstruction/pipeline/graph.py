"""A graph of stages: compute only what is wanted, reuse what is current, say what was left out."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np


class StageError(ValueError):
    """What is wanted cannot be computed."""


@dataclass(frozen=True, slots=True)
class Stage:
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


class Cache(Protocol):
    """Keeps products between runs, by the hash of everything they depend on."""

    def load(self, key: str) -> Mapping[str, Any] | None:
        """Return the products kept under ``key``, all of them or some, or None."""

    def save(self, key: str, products: Mapping[str, Any]) -> None:
        """Keep ``products`` under ``key``."""


@dataclass(frozen=True, slots=True)
class Outcome:
    """What a run of the graph did."""

    products: Mapping[str, Any]
    """The wanted products, by name."""
    ran: tuple[str, ...]
    reused: tuple[str, ...]
    left_out: tuple[tuple[str, str], ...]
    """Stages that nothing wanted needs, each with the reason."""
    keys: Mapping[str, str]
    """Input hash of each stage that was needed."""
    assumed: tuple[str, ...] = ()
    """What was taken for granted for want of a calibration."""
    work: tuple[Mapping[str, str], ...] = ()
    """What became of each stage and why, see `reconstruction.pipeline.record.record`."""


def order(stages: Sequence[Stage], want: Iterable[str]) -> list[Stage]:
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
    >>> a = Stage("a", (), ("x",), dict)
    >>> b = Stage("b", ("x",), ("y",), dict)
    >>> [stage.name for stage in order([b, a], ["y"])]
    ['a', 'b']
    """
    maker: dict[str, Stage] = {}
    for stage in stages:
        for product in stage.makes:
            if product in maker:
                raise StageError(
                    f"product {product!r}: made by {maker[product].name!r} and {stage.name!r}"
                )
            maker[product] = stage
    ordered: list[Stage] = []
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


def input_hash(stage: Stage, keys_of_inputs: Sequence[str]) -> str:
    """Return the hash of all that a stage's products depend on."""
    text = json.dumps(
        [stage.name, stage.makes, list(keys_of_inputs), dict(stage.parameters)], sort_keys=True
    )
    return hashlib.sha256(text.encode("utf-8")).hexdigest()


def run(
    stages: Sequence[Stage],
    want: Sequence[str],
    *,
    cache: Cache | None = None,
    progress: Callable[[str], None] | None = None,
) -> Outcome:
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
        Where products are kept between runs; None keeps nothing.
    progress
        Called with a line of text before each stage that runs.

    Returns
    -------
    Outcome
    """
    needed = order(stages, want)
    made_by = {product: stage for stage in needed for product in stage.makes}
    keys: dict[str, str] = {}
    for stage in needed:
        keys[stage.name] = input_hash(stage, [keys[made_by[p].name] for p in stage.needs])
    for stage in needed:  # before anything is computed in vain
        kept = cache.load(keys[stage.name]) if cache is not None else None
        if stage.refused and kept is None:
            raise StageError(stage.refused)
    products: dict[str, Any] = {}
    ran: list[str] = []
    reused: list[str] = []

    def provide(product: str) -> None:
        if product in products:
            return
        stage = made_by[product]
        kept = cache.load(keys[stage.name]) if cache is not None else None
        if kept is not None and product in kept:
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
            raise StageError(
                f"stage {stage.name}: made {sorted(made)}, expected {sorted(stage.makes)}"
            )
        products.update(made)
        ran.append(stage.name)
        if stage.name in reused:  # its maps were at hand, but not what only other stages need
            reused.remove(stage.name)
        if cache is not None:
            cache.save(keys[stage.name], made)

    for product in want:
        provide(product)
    left_out = [
        (stage.name, "nothing wanted depends on it") for stage in stages if stage not in needed
    ]
    left_out += [
        (stage.name, "what depends on it was reused")
        for stage in needed
        if stage.name not in ran and stage.name not in reused
    ]
    return Outcome(
        products={product: products[product] for product in want},
        ran=tuple(ran),
        reused=tuple(reused),
        left_out=tuple(left_out),
        keys=keys,
    )


def document_bytes(document: Mapping[str, Any]) -> bytes:
    """Return a document as JSON text, UTF-8; arrays become lists, what is not finite null.

    Examples
    --------
    >>> document_bytes({"r_mm": np.array([1.0, np.nan])}).split()
    [b'{', b'"r_mm":', b'[', b'1.0,', b'null', b']', b'}']
    """
    return json.dumps(_plain(document), indent=1, allow_nan=False).encode("utf-8")


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {key: _plain(entry) for key, entry in value.items()}
    if isinstance(value, np.ndarray):
        return _plain(value.tolist())
    if isinstance(value, list | tuple):
        return [_plain(entry) for entry in value]
    if isinstance(value, np.generic):
        return _plain(value.item())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
