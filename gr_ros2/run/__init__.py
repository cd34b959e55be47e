"""Experiments as they run: a scenario, its flowgraphs or its simulated time, and what is told on the way."""
