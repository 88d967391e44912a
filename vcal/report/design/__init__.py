"""The report of a designed plan, and of what to measure next."""
