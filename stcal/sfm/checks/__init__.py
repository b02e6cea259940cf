"""Checks that a wrong result with small residuals does not pass; ``suite.py`` runs them all."""
