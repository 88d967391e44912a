"""The search: forward selection of effects, and its revision.

`initial_shapes` (where the fit of declared effects starts), `state` (model, fits, noise, outliers),
`round` (one round: refits and tests), `forward_selection` (rounds), `search` (pruning, replacement,
exchange), `certainty` (what keeps a name uncertain). Knows all other stages but `notes`. `notes`
and `close_loop` stand on it.
"""
