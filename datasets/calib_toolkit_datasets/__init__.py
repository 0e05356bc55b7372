"""Built-in readers of recordings, one per file."""
