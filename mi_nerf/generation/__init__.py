"""Path-traced datasets from Mitsuba scenes: ``mi-nerf generate``."""

from .plan import Plan
from .planning import make_plan
from .protocol import PROTOCOLS, Options, Protocol
from .run import generate, preview

__all__ = ["PROTOCOLS", "Options", "Plan", "Protocol", "generate", "make_plan", "preview"]
