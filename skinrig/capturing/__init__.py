"""Options of capture: addresses, acquisition, light safety and sequences."""
