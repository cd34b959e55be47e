"""Where a link was good: what a robot measured while it drove, as a table, and the path loss that fits it."""
