"""Registration of two instruments from corresponding points; read ``register.py`` first."""

from stcal.register.liu2017 import Liu2017Options
from stcal.register.pairs import Pairs, read_pairs
from stcal.register.register import register
from stcal.register.result import Alternative, HeldOut, Registration

__all__ = ["Alternative", "HeldOut", "Liu2017Options", "Pairs", "Registration", "read_pairs", "register"]
