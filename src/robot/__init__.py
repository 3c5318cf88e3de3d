"""The robot: observation in, pick out, outcome back. NumPy and PyBullet only, no torch."""
