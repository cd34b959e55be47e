"""Checks what a machine has and lacks for a link. Each check is one small function; a table gives their order."""
