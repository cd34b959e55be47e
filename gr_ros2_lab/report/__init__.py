"""Reports of runs for human readers: tables, figures, explanations and pages, made from the files of a run alone."""
