"""The uncertainty budget of a finished run, after the GUM (JCGM 100:2008)."""
