"""Results about the geometry of the machine, computed from a fit or a model.

- `error_motions`: error motions and location errors with their uncertainty, on a grid;
- `acceptance`, `straight_lines`: the deviations of geometric tests as defined in ISO 230-1;
- `compensated`: tool points of the identified machine, and their derivatives;
- `error_field`: the volumetric error on a grid over the travel, with its uncertainty;
- `volumetric`: errors in the work space as quadratic forms of the parameters;
- `declared_machine`: axes, senses, travels and instruments of the declared machine, for a picture.

It uses `identification` and the packages below it, and knows nothing of pictures and pages, which
only show these results. `loop`, `design` and `uncertainty` stand on it.
"""
