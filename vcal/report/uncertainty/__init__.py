"""The report of the uncertainty that a plan will give."""
