"""What everything may use: errors, names, files, back-end tables, guards."""
