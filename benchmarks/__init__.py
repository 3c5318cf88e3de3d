"""Measurements that are too long for a test: each is a command, `python -m benchmarks.NAME --help`."""
