"""Closing the loop: what is missing from a model, by name, and what adding it gains."""
