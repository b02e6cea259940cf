"""A planar target of several tags: its calibration, where it is under any light, and whether that may be trusted."""

from stcal.front import front

front(__name__, __file__)
