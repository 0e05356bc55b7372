"""Formats of calibrations, one per file, and what they share: text that can be trusted, poses, clocks."""
