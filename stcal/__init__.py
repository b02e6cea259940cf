"""stcal: calibration of stereo targets from photographs of a single camera, and the use of them.

See :func:`stcal.sfm.run` for the main job and ``README.md`` for conventions.
"""

__version__ = "0.1.0"
