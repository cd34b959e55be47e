"""Every setting: its fields, its texts and files, the registry of topics, and the choice of topics."""
