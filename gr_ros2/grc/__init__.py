"""Descriptions of the blocks for GNU Radio Companion, and how it finds them."""
