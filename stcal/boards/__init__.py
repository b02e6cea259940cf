"""Flat boards and tags as other makers print them: chessboards, ChArUco boards, ArUco and AprilTag markers.

What they are (``design``), their files (``board_file``), and where their corners lie in an image (``chessboard``,
``tags``). Dot boards are ``stcal.design.BoardDesign`` and are found by ``stcal.sfm``.
"""
