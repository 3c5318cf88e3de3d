"""The robot: it gives observations, executes picks and returns outcomes. Only NumPy and PyBullet, no torch."""
