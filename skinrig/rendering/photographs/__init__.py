"""Compare renderings with held-out photographs."""
