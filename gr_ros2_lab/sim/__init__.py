"""Simulated robots that publish the topics of the paper's table 4 while driving among obstacles.

We wrote our own simulator because the most similar maintained library, ir-sim 2.12.0, has several problems. It took 41
to 77 ms per simulated second, without any message, for two robots with 360 beams at 5 Hz in steps of 20 ms. Our
simulator takes 15 ms on the same machine, messages included. In five of six seeds the robots of ir-sim got stuck or
touched obstacles (4 to 15 m driven in 60 s). It tries GUI back-ends even when headless, and it brings scipy, shapely,
imageio and loguru.

Invariant: no input or output, except in ``publisher``. Time is simulated, and every random number comes from a seeded
generator.
"""
