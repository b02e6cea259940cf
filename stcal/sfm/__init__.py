"""From a folder of images to the calibrated target; read ``pipeline.py`` first."""

from stcal.front import front

front(__name__, __file__)
