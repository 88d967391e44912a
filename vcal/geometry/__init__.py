"""Results about the machine's geometry: error motions, ISO 230-1 deviations, tool points.

Everything is computed from a fit; pictures, pages and tables only show it. Uses `identification`
and what lies below; `loop`, `design` and `uncertainty` stand on it.
"""
