"""The report of `vcal design`: page, pictures, record and writer."""
