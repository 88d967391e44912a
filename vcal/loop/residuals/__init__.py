"""Tests of residuals: what a fit leaves, and whether that is noise.

`outliers`, `variance_components` (noise per kind of reading), `autocorrelation` (noise correlated
in time), `dependence` (on covariates), `vibration`, `confounded` (covariates that cannot be
separated). Each takes a fit. Knows `screening` and `empirical`; does not know `weighing`. `search`,
`outcome` and `notes` stand on it.
"""
