"""Flat boards and tags of other makers: chessboards, ChArUco boards, AprilGrids, ArUco and AprilTag markers.

``design`` : the boards; ``file``, ``kalibr``, ``several`` : their files; ``chessboard``, ``tags``, ``aprilgrid`` :
detection of their corners in an image. Dot boards are ``stcal.design.BoardDesign`` and are detected by ``stcal.sfm``.
"""
