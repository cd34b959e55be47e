"""What a link or a run shows while it goes on, as values for observers such as the dashboard."""
