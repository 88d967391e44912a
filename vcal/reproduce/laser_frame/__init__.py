"""A laser frame measures thermo-elastic errors: Brecher et al. (2022), MM Science Journal."""
