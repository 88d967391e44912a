"""The report of `vcal uncertainty`: page, pictures, record and writer."""
