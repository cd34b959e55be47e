"""The engines of version 1."""
