"""The score test: every candidate, at every place and shape, against the residual of a fit."""
