"""Tests of residuals: dependence, autocorrelation, vibration, variance components, outliers."""
