"""The page of `vcal check --out`: what was read, and the declared machine."""
