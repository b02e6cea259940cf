"""Drawings of targets and boards, 1:1 in mm, as PDF, SVG and DXF.

``parts`` : what a face or a board is drawn as; ``dimensions`` : what is written around it; ``sheets`` : pages, and how
a part is split over several; ``svg``, ``pdf``, ``dxf`` : the files.
"""
