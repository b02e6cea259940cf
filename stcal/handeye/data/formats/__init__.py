"""Readers of poses as other programs write them; the format of each file is recognised from its content. Read
:mod:`.recognise` first."""
