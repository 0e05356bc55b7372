"""Appearance metrics, one per file, and what they share: a scan as a camera sees it, pictures of both."""
