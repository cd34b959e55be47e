"""Studies that need many runs: sweeps and ablation. Also a forecast before the first run."""
