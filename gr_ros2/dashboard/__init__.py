"""The live dashboard: what a running link does, on a web page served by the program that runs it.

``state`` turns events into numbers (sans-IO), ``page`` draws them with Bokeh, ``server`` ties both to a run.
"""
