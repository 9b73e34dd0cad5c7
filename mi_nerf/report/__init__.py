"""Tables and plots about trained fields: ``mi-nerf report``."""

from .run import report

__all__ = ["report"]
