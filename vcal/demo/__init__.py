"""Studies that come with vcal: the demo, and one per instrument to start from (README.md)."""
