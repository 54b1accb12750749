"""Sessions of simulated rigs, through the drivers of real ones."""
