"""Pages of the effects catalogue."""
