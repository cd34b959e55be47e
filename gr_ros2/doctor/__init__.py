"""What a machine has and lacks for a link: one small function per question, asked in the order of a table."""
