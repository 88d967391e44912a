"""Closing the loop: which effect the declared model lacks, and what adding it gains.

The stages, each a folder: `screening` (score test of every candidate), `weighing` (refits,
evidence, cross-validation), `search` (forward selection and its revision), `residuals` (tests of
what is left), `empirical` (descriptions without a physical name), `outcome` (what is returned).
`close_loop` runs them, `notes` words what a user should know. Uses `identification` and `geometry`;
knows nothing of `design`, `uncertainty` and `dynamics`.
"""
