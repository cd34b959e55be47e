"""The engines of version 0, the paper's."""
