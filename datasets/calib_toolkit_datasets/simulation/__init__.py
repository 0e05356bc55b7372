"""Simulated drives whose truth is exact: a vehicle in a made-up street, and what its sensors record there."""
