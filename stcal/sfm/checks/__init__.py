"""Checks that residuals cannot fake; ``suite.py`` runs them all."""
