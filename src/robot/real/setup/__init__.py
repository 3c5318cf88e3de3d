"""From unboxing to a station that can pick: what `real.py` does, a module a command."""
