"""Trait spaces: reduced spaces, trait vectors and edits."""

from model.traits.space import EditOutcome as EditOutcome
from model.traits.space import TraitSpace as TraitSpace
from model.traits.space import cosine as cosine
