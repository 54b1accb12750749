"""How far maps are from the truth, and how honest their errors."""
