"""Appearance metrics, one per file (to come)."""
