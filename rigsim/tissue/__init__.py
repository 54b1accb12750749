"""Monte Carlo transport in layered tissue, and tables made with it."""
