"""The pages of `vcal effects`: page, picture and writer."""
