"""Numerical methods that are independent of machines and measurements.

- `least_squares`, `gauss_newton`, `anderson`, `trust_region`: non-linear least squares, in a
  compiled program or step by step on the host;
- `spatial`, `rigid`: rotations and rigid motions, as arrays or by components;
- `compiled`, `identity_cache`, `arrays`, `record`: compilation, caches, and the base classes of
  what may be traced;
- `conformity`: the decision whether a quantity conforms with its tolerance (JCGM 106);
- `normal_draws`: normal numbers from explicit keys; `counter_draws`: many rows of random numbers,
  one key each;
- `differences`: derivatives from values alone, with their estimated error;
- `program_cache`: compiled programs from process to process;
- `processes`: jobs in processes of this computer.

This package knows only jax, equinox, optimistix, numpy and scipy, and no other package of vcal.
Every package above may use it.
"""
