"""Sweeps: one scenario at many settings, many times, on all cores of this machine or on a Dask cluster."""
