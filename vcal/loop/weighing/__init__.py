"""Weighing: candidates refitted, and compared by evidence and on held-out readings.

`rivals` (refits of the best candidates), `weighing` (posterior odds, names that cannot be
distinguished), `subsets` (several effects together), `cross_validation` (held-out readings,
predictive density, check points). Knows `screening` and `empirical`. `search` and `outcome` stand
on it; `residuals` does not know it.
"""
