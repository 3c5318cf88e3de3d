"""A run and a sweep of runs: configuration, stages, evaluation, and the files that they leave."""
