"""Drawings of targets and boards, 1:1 in mm, as PDF and SVG.

``parts`` : the drawing of a face or a board; ``dimensions`` : annotations around it; ``sheets`` : pages, and the
splitting of a part over several; ``svg``, ``pdf`` : the files.
"""
