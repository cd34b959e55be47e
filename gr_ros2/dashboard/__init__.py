"""The live dashboard: a web page that shows a running link. The program that runs the link serves the page.

``state`` turns events into numbers (sans-IO), ``live_page`` draws them with Bokeh, ``server`` connects both to a run.
"""
