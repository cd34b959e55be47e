"""Questions that take many runs: sweeps, ablation, and a forecast before the first."""
