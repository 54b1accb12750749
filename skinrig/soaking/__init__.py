"""Soak tests: simulated rigs, hosts and disks under seeded faults, and what must hold in them."""
