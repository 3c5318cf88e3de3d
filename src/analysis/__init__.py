"""From folders of runs to a page that a person can judge them by. Reads files only: no torch, no robot."""
