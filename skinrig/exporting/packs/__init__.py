"""Export map packs."""
