"""Running experiments: a scenario, its flowgraphs or its simulated time, and the observers of a run."""
