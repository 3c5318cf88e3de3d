"""Trained models that the demo uses."""
