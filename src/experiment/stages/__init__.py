"""The stages of a run, a file each. Their order is in ``experiment/run.py``."""
