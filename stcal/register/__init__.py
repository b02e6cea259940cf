"""Registration of two instruments from corresponding points; read ``pipeline.py`` first."""

from stcal.front import front

front(__name__, __file__)
