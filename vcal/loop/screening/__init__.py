"""Screening: the score test of every candidate effect against the residual of a fit.

`candidates` (what could be missing, and what cannot be tested), `responses` (what candidates do to
the readings), `score_test` (the statistic and its null distribution), `significance` (tails,
look-elsewhere correction), `size_evidence` (evidence of an effect of unknown size), `screening`
(the best of every kind, corrected). Knows a fit and the settings, nothing of refits. `residuals`
and `weighing` stand on it.
"""
