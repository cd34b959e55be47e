"""Sweeps: one scenario with many settings, many times, on all cores of this machine or on a Dask cluster."""
