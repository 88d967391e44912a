"""Identification: the parameters of a model from readings, with their covariance.

- `identify`, `robust`, `shape_steps`, `linearised`: one measurement, by non-linear least squares;
- `batch`: many draws of one nominal problem, in one compiled program;
- `fit`: the result, with covariance, degrees of freedom, evidence and undetermined directions;
- `posterior`, `rank`: covariance and observability of a plan, before any measurement;
- `model_averaging`, `family_sizes`: competing models, and prior sizes estimated from the data.

It uses `model` and the packages below it. `geometry` and `dynamics`, and above them `loop`,
`design` and `uncertainty`, stand on it. It knows nothing of candidates, searches, study files and
reports.
"""
