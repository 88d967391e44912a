"""The forward selection: rounds that add an effect, and what is revised afterwards."""
