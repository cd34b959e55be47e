"""What a person reads of runs: tables, figures, explanations, pages. Made from the files of a run alone."""
