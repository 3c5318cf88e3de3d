"""The configuration tree, importable so that Hydra finds it wherever the package is installed."""
