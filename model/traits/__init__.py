"""Trait spaces: reduced spaces, trait vectors and edits."""

from model.traits.space import EditOutcome, TraitSpace, cosine

__all__ = ["EditOutcome", "TraitSpace", "cosine"]
