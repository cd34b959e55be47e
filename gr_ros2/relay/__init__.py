"""Relaying: which messages of other robots a robot sends on, so that those it hears directly are up to date.

Sans-IO: the engines are told what was heard, and say what is worth sending.
"""
