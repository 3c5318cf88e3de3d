"""see2act: does learning to see speed up learning to act?"""

__version__ = "0.1.0"
