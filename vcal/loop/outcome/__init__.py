"""What closing the loop returns: the closure, and what no effect explains."""
