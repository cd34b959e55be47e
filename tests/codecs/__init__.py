"""What every codec of a topic keeps, and each codec by itself."""
