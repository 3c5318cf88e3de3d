"""see2act: does learning to see speed up learning to act?"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from see2act.prediction.predict import predict

__version__ = "0.1.0"
__all__ = ["__version__", "predict"]


def __getattr__(name: str) -> Any:
    """Functions that bring torch, which takes seconds, come when they are asked for."""
    if name == "predict":
        from see2act.prediction.predict import predict

        return predict
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
