"""Registration of two instruments from corresponding points; read ``register.py`` first."""

from stcal.register.register import register
from stcal.register.result import Alternative, HeldOut, Registration

__all__ = ["Alternative", "HeldOut", "Registration", "register"]
