"""The folder that `vcal compensate` writes."""
