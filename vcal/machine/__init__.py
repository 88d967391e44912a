"""A machine: its kinematic chain, the ports at which errors enter, plans and parameters.

- `chain`: serial chains of linear and rotary axes and of arm joints, with their errors;
- `ports`: the names of everything that can disturb one observation;
- `plan`, `circles`: commanded positions and recorded conditions, one row per observation;
- `parameters`, `error_functions`: named parameters with unit and prior, and the families of
  functions of error motions.

It uses `distributions`, `units` and `numerics`. `effects`, `instruments` and `model` stand on it.
It knows nothing of effects, instruments and data files.
"""
